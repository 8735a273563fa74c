"""The method and the budget that were requested, and those that frames get.

A budget is milliseconds of modelled work (`field_fit.Budget`). Recordings hold what was effective,
so that a replay gives the same on any machine. For use by the pipeline thread; others may read.

Where many scans are left out because this thread did not get the processor that it asked for,
frames get half of their work, then a quarter, and so on, and twice as much again when few have been
left out for a while. Every skin of a busy computer does so; that each gets a fair share of the
processor is the system's scheduler's work.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from tactomo_models import Reconstructor
from tactomo_models.reconstruct import DEFAULT_BUDGET_S

from tactomo.errors import CommandError


class Effort(NamedTuple):
    """How much model a frame gets."""

    method: str
    budget_ms: float | None  # of modelled work; None for the method's own


class MethodInForce:
    """Tells the reconstructor its method and budget."""

    def __init__(self, reconstructor: Reconstructor) -> None:
        self.share = 1.0  # of the work that was asked for, what frames get
        self._reconstructor = reconstructor
        budget_s = reconstructor.budget_s
        # what was asked for; what frames get
        self.requested = self.effective = Effort(
            reconstructor.method, None if budget_s is None else budget_s * 1e3
        )
        self._request(self.requested)

    def request_method(self, method: str) -> None:
        """Have frames made by another method.

        Raises CommandError where it cannot be set up; what was in force stays so.
        """
        try:
            self._request(self.requested._replace(method=method))
        except Exception as error:  # somebody else's method: anything may go wrong in it
            raise CommandError(
                f"the method {method} cannot be set up: {type(error).__name__}: {error}",
                "ask for another method",
                "no_network",
            ) from error

    def request_budget(self, budget_ms: float | None) -> None:
        """Have frames take as much work; None for the method's own."""
        self._request(self.requested._replace(budget_ms=budget_ms))

    def give_share(self, share: float) -> None:
        """Have frames take that share of the work that was asked for, or of the method's own."""
        self.share = share
        self._request(self.requested)

    def obey(self, recorded: Effort) -> None:
        """Give frames what was effective when they were recorded."""
        if recorded != self.effective:
            self.put_in_force(recorded)
            self.requested = recorded

    def _request(self, requested: Effort) -> None:
        budget_ms = requested.budget_ms
        if self.share < 1:
            budget_ms = self.share * (budget_ms or DEFAULT_BUDGET_S * 1e3)
        self.put_in_force(Effort(requested.method, budget_ms))
        self.requested = requested

    def lengthen(self, budget_ms: float) -> None:
        """Give frames at least so much modelled work, until `put_in_force` is called."""
        effective = self.effective
        if effective.budget_ms is None or effective.budget_ms < budget_ms:
            self.put_in_force(effective._replace(budget_ms=budget_ms))

    def put_in_force(self, effective: Effort) -> None:
        """Give frames this method and this much modelled work."""
        # Milliseconds are what is recorded: live and replay must come to the same seconds.
        budget_ms = effective.budget_ms
        self._reconstructor.method = effective.method
        self._reconstructor.budget_s = None if budget_ms is None else budget_ms * 1e-3
        self.effective = effective


TAKEN: Final = 0.75
"""Share of a core while it computes below which a thread has lost time to others; alone it has more
than 0.9."""
WINDOW_S: Final = 0.5
"""Computing over which the share is averaged: ten frames of 50 ms at half a core take one."""
LOOK_S: Final = 1.0
MANY: Final = 1 / 3
"""Scans left out for each frame: a contact that lands costs three of twenty by itself."""
LEAST: Final = 1 / 8
"""Of the usual 50 ms: the network (correlation 0.97) fits in; a linear map (0.67) saves little."""
HOLD_S: Final = 5.0
"""Until more is tried; twice as long each time that it was too much, up to MAX_HOLD_S: a switch of
method costs a cold start."""
MAX_HOLD_S: Final = 80.0


class ProcessorShare:
    """For use by one thread."""

    def __init__(self) -> None:
        # the share of a core that the thread got of late while it computed; and the share of its
        # work that a frame is left: 1, 1/2, ... LEAST
        self.of_core = self.of_work = 1.0
        self._cpu_s = self._wall_s = 0.0
        self._dropped = self._frames = 0
        self._noted_s = self._looked_s = self._changed_s = self._raised_s = float("-inf")
        self._hold_s = HOLD_S

    def note(
        self,
        cpu_s: float,  # processor time that the frame took
        wall_s: float,  # time that passed meanwhile
        dropped: int,  # dual scans left out since the start
        now_s: float,  # monotonic seconds
    ) -> bool:
        """Take note of a frame in which something presses; return whether `of_work` has changed."""
        # What was left out while nothing pressed; not while this frame waited for the processor.
        if now_s - wall_s - self._noted_s > LOOK_S:
            self._dropped, self._frames, self._looked_s = dropped, 0, now_s
        self._noted_s = now_s
        self._frames += 1
        kept = max(0.0, 1 - wall_s / WINDOW_S)
        self._cpu_s, self._wall_s = kept * self._cpu_s + cpu_s, kept * self._wall_s + wall_s
        self.of_core = min(1.0, self._cpu_s / self._wall_s) if self._wall_s else 1.0
        if now_s - self._looked_s < LOOK_S:
            return False
        is_late = dropped - self._dropped > MANY * self._frames
        self._dropped, self._frames, self._looked_s = dropped, 0, now_s
        before = self.of_work
        if is_late and self.of_core < TAKEN:
            self.of_work = max(LEAST, before / 2)
            if now_s - self._raised_s < 2 * self._hold_s:
                self._hold_s, self._raised_s = min(2 * self._hold_s, MAX_HOLD_S), float("-inf")
        elif before < 1 and not is_late and now_s - self._changed_s > self._hold_s:
            self.of_work = min(1.0, 2 * before)
            self._raised_s = now_s
        if self.of_work != before:
            self._changed_s = now_s
        return self.of_work != before

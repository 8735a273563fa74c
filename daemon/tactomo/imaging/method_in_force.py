"""The method and the budget that were requested, and those that frames get.

A budget is milliseconds of this machine; the machine's speed turns it into milliseconds of modelled
work, less of it where others take the processor. Recordings hold what was effective, so that a
replay gives the same on any machine. For use by the pipeline thread; others may read.
"""

from __future__ import annotations

from typing import NamedTuple

from tactomo_models import Reconstructor
from tactomo_models.methods.machine_speed import MachineSpeed
from tactomo_models.reconstruct import DEFAULT_BUDGET_S

from tactomo.errors import CommandError


class Effort(NamedTuple):
    """How much model a frame gets."""

    method: str
    budget_ms: float | None  # None for the method's own


class MethodInForce:
    """Tells the reconstructor its method and budget."""

    def __init__(self, reconstructor: Reconstructor, machine_speed: MachineSpeed) -> None:
        self.share = 1.0  # of the time that was asked for, what frames get
        self.source = machine_speed.source  # where the machine's speed is known from, in words
        self._reconstructor = reconstructor
        self._machine_speed = machine_speed
        budget_s = reconstructor.budget_s
        # what was asked for, in milliseconds of this machine; what frames get, of modelled work
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
        """Have frames take as much time; None for the method's own."""
        self._request(self.requested._replace(budget_ms=budget_ms))

    def give_share(self, share: float) -> None:
        """Have frames take that share of the time that was asked for, or of the method's own."""
        self.share = share
        self._request(self.requested)

    def obey(self, recorded: Effort) -> None:
        """Give frames what was effective when they were recorded."""
        if recorded != self.effective:
            self.put_in_force(recorded)
            self.requested = recorded

    def _request(self, requested: Effort) -> None:
        time_s = None if requested.budget_ms is None else requested.budget_ms * 1e-3
        if self.share < 1:
            time_s = self.share * (time_s or DEFAULT_BUDGET_S)
        modelled_ms = None if time_s is None else self._machine_speed.budget_s(time_s) * 1e3
        self.put_in_force(Effort(requested.method, modelled_ms))
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

"""What a recording's frames lack, named and counted while they are written for another program."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Final

from tactomo.cli.files.recorded_frames import Moment

CLOCK_STEP_S: Final = 0.1
"""A wall clock that leaves the steady one by more between two frames was set: time daemons slew
what is less (ntpd up to 0.128 s, and by at most 0.5 ms a second)."""


class Gaps:
    """Counts what is missing or odd among frames that pass by; nothing is filled in."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._first_s: dict[str, float] = {}
        self._flags: Counter[str] = Counter()
        self.first_step_s = 0.0  # by how much the wall clock was set first, s; 0 where it was not
        self._last: Moment | None = None

    def watch(self, moments: Iterator[Moment]) -> Iterator[Moment]:
        """Yield the moments as they are."""
        for moment in moments:
            self._add(moment)
            self._last = moment
            yield moment

    def lines(self) -> list[str]:
        """Return what there was, a sentence each."""
        flags = ", ".join(f"{flag} {count}" for flag, count in sorted(self._flags.items()))
        sentences = {
            "lost": "frames were published that the recording does not hold",
            "left out": "dual scans were taken but not reconstructed",
            "set": f"steps of the wall clock, the first by {self.first_step_s:+.3f} s; times here "
            "go by the steady clock",
            "back": "frames are not later than the one before",
            "restart": "restarts of the daemon: contact identities begin anew",
            "no map": "frames have no map",
            "unknown": f"frames where a press may be missing: {flags or 'stale'}",
        }
        return [
            f"{self._counts[what]} {sentence} (the first at {self._first_s[what]:.3f} s)"
            for what, sentence in sentences.items()
            if self._counts[what]
        ]

    def _count(self, what: str, moment: Moment, count: int = 1) -> None:
        if count > 0:
            self._counts[what] += count
            self._first_s.setdefault(what, moment.time_s)

    def _add(self, moment: Moment) -> None:
        frame, last = moment.frame, self._last
        lost = missing(last, moment, "sequence")
        self._count("lost", moment, lost)
        self._count("left out", moment, missing(last, moment, "scan_counter") - lost)
        if frame.x_mm is not None and frame.map is None and frame.structure is None:
            self._count("no map", moment)
        if not frame.is_known:
            self._count("unknown", moment)
            self._flags.update(frame.flags)
        if last is None:
            return
        self._count("back", moment, moment.time_s <= last.time_s)
        if frame.session != last.frame.session:
            self._count("restart", moment)
        elif abs(step_s := _wall_less_steady_s(moment) - _wall_less_steady_s(last)) > CLOCK_STEP_S:
            self.first_step_s = self.first_step_s or step_s
            self._count("set", moment)


def missing(last: Moment | None, moment: Moment, counter: str) -> int:
    """Return how many a frame's counter has left out since the frame before of the same run."""
    if last is None or last.frame.session != moment.frame.session:
        return 0
    step = getattr(moment.frame, counter) - getattr(last.frame, counter)
    return int(max(0, step - 1))


def _wall_less_steady_s(moment: Moment) -> float:
    return (moment.frame.acquired_realtime_ns - moment.frame.acquired_monotonic_ns) * 1e-9

"""The wall clock, watched: people and time servers set it, and dates in messages jump with it.

Nothing here goes by it: ages, waits and timeouts are on the monotonic clock, which nobody sets.
"""

from __future__ import annotations

import time
from typing import Final

from tactomo.events import OnEvent
from tactomo.timing import LATEST_NS, wall_clock_ns

JUMP_S: Final = 0.5
"""A time server that corrects less than this does so bit by bit, by at most 0.5 ms a second."""


class WallClock:
    """Compares the wall clock with the monotonic one whenever `check` is called.

    For use by one thread; others may read.
    """

    def __init__(self, on_event: OnEvent) -> None:
        self.jumps = 0  # how often it was set
        # by how much the last time, positive if forwards; None if never
        self.last_jump_s: float | None = None
        self._on_event = on_event
        self._ahead_ns = _ahead_ns()

    def check(self) -> None:
        """Notice a jump since the last call."""
        before_ns, self._ahead_ns = self._ahead_ns, _ahead_ns()
        jump_s = (self._ahead_ns - before_ns) * 1e-9
        if abs(jump_s) < JUMP_S:
            return
        self.jumps += 1
        self.last_jump_s = jump_s
        self._on_event(
            "wall_clock_jumped",
            f"the computer's clock was set {abs(jump_s):.1f} s "
            f"{'ahead' if jump_s > 0 else 'back'}, or the computer slept",
            "nothing, unless you compare dates across it: use monotonic times",
        )


def _ahead_ns() -> int:
    now_ns = wall_clock_ns()
    return now_ns - time.monotonic_ns() if 0 < now_ns < LATEST_NS else now_ns  # stands at the ends

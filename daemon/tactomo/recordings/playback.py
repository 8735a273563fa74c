"""The time of a replay: when recorded bytes are due, and who may pause, move and pace it.

All ports of one replay share a `Playback`. Its position is on the recording's steady clock. Moving
it begins another *pass*: ports go on reading elsewhere, and what they read before is left out.
"""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass
from typing import Any, Final

MAX_LAG_S: Final = 0.25
"""How late bytes may be read before the replay waits for whoever reads them."""


@dataclass(eq=False)
class Playback:
    """Where a replay is, for any thread; speed 0 is as fast as it is taken."""

    start_ns: int  # of the recording
    _end_ns: int  # likewise
    _speed: float
    _last_ns: int  # from where something still comes
    is_exact: bool = False  # whether it goes by what was recorded of each frame
    passes = 0  # how often it was moved
    maps_before = 0  # how many maps were published before this pass
    loops = False  # whether the end is followed by the beginning
    waits_for_page = False  # whether it is paused until somebody looks
    _is_paused = _is_stepping = False

    def __post_init__(self) -> None:
        self.begin_ns = self.start_ns  # of this pass
        self.steered_ns = time.monotonic_ns()  # when somebody last steered it
        self._position_ns = self.start_ns  # when it was last paused, moved or paced otherwise
        self._since_ns: int | None = None  # when that was, monotonic; None before anything is read
        self._changed = threading.Condition(threading.RLock())

    @property
    def is_paused(self) -> bool:
        """Whether it goes on by steps alone, of which every dual scan is to be shown."""
        return self._is_paused

    @property
    def _stands(self) -> bool:
        return self._is_paused and not self._is_stepping

    @property
    def position_ns(self) -> int:
        """How far it is."""
        with self._changed:
            played_ns = 0
            if self._since_ns is not None and not self._stands:
                played_ns = round((time.monotonic_ns() - self._since_ns) * self._pace)
            return self._position_ns + played_ns

    def fields(self) -> dict[str, Any]:
        """Return what `status` says of it."""
        with self._changed:
            return {
                "position_s": (min(self.position_ns, self._end_ns) - self.start_ns) * 1e-9,
                "duration_s": (self._end_ns - self.start_ns) * 1e-9,
                "speed": self._speed,
                "paused": self.is_paused,
                "loop": self.loops,
                "waits_for_page": self.waits_for_page,
                "exact": self.is_exact,
                "maps_before": self.maps_before,
            }

    def wait_until_due(self, clock_ns: int | None, timeout_s: float, number: int) -> bool:
        """Wait until bytes are due, and return whether they are.

        Args:
            clock_ns: when they came, on the recording's clock; None where there are no more.
            timeout_s: how long to wait at most, seconds.
            number: the pass that they are of; in another one they are not due.
        """
        with self._changed:
            # Counted from the first read on, not from opening, so that two ports of one recording,
            # opened one after the other and then read together, keep time with each other.
            if self._since_ns is None:
                self._since_ns = time.monotonic_ns()
            wait_s = self._due_in_s(clock_ns)
            if wait_s > 0 and number == self.passes:
                self._changed.wait(min(wait_s, timeout_s))
            if number != self.passes or self._due_in_s(clock_ns) > 0:
                return False
            if clock_ns is not None:
                self._keep_up(clock_ns)
            return True

    def steer(self, paused: bool | None, speed: float | None, loop: bool | None) -> None:
        """Change what is given."""
        with self._changed:
            self._settle()
            if paused is not None:
                self._is_paused, self._is_stepping, self.waits_for_page = paused, False, False
            self._speed = self._speed if speed is None else speed
            self.loops = self.loops if loop is None else loop
            self.steered_ns = time.monotonic_ns()
            self._changed.notify_all()

    def step(self) -> None:
        """Go on, paced, until a dual scan is let through."""
        with self._changed:
            self._settle()
            self._is_paused = self._is_stepping = True
            self.waits_for_page = False
            self._changed.notify_all()

    def lets_through(self) -> bool:
        """Return whether a dual scan may be made a frame now; one that may ends a step."""
        with self._changed:
            may = not self._stands
            if self._is_stepping:
                self._settle()
                self._is_stepping = False
            return may

    def move(self, position_s: float) -> dict[str, Any]:
        """Go on `position_s` seconds after the beginning; while paused, by one dual scan.

        Returns the fields as they are before anything goes on.
        """
        with self._changed:
            ahead_ns = min(position_s * 1e9, self._last_ns - self.start_ns)
            self.begin_ns = self._position_ns = self.start_ns + round(ahead_ns)
            self._since_ns = None
            self._is_stepping = self._is_paused
            self.passes += 1
            self._changed.notify_all()
            return self.fields()

    @property
    def _pace(self) -> float:
        """Recorded seconds a second; a step goes at the recorded speed at most."""
        return min(self._speed or 1.0, 1.0) if self._is_stepping else self._speed

    def _keep_up(self, clock_ns: int) -> None:
        """Have the position follow bytes that are read as fast as possible, or late.

        Those that are read late are shown late: the position must not run ahead of the map.
        """
        if not self._pace:
            self._position_ns = max(self._position_ns, clock_ns)
        elif clock_ns >= self.begin_ns and -self._due_in_s(clock_ns) > MAX_LAG_S:
            self._position_ns, self._since_ns = clock_ns, time.monotonic_ns()

    def _settle(self) -> None:
        self._position_ns = self.position_ns
        self._since_ns = None if self._since_ns is None else time.monotonic_ns()

    def _due_in_s(self, clock_ns: int | None) -> float:
        if clock_ns is None or self._stands:
            return math.inf
        ahead_ns = clock_ns - self.position_ns
        return 0.0 if not self._pace else ahead_ns * 1e-9 / self._pace

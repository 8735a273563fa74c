"""Events: what happened, told at the same time to the log and to whoever subscribes.

Who comes late finds in `status` how often each one happened, and the last troubles (`EventBook`).
The log is told less often than the stream: a bad cable must not fill a robot's disk in a year.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from typing import Any, Final, Protocol

from tactomo_client.schema import EVENTS

from tactomo.timing import wall_clock_ns

EVENT_PERIOD_S: Final = 1.0
LONGEST_PERIOD_S: Final = 60.0
"""Between two events of one trouble that goes on: it must not bury all others."""
LOGGED_AT_ONCE: Final = 5
"""Lines of one event that the log takes in a row; then one in `LOG_PERIOD_S`."""
LOG_PERIOD_S: Final = 300.0
TROUBLES_KEPT: Final = 8
RECORDED: Final = "so it was recorded"
"""The next step in a replay of what was the recorded skin's, where nothing is to be mended."""
ENDS: Final = frozenset(kind.end for kind in EVENTS.values())


class OnEvent(Protocol):
    """Called with what happens, as often as it is seen; never waits, and for any thread."""

    def __call__(
        self,
        name: str,  # one of `EVENTS`, which says how often it is told
        detail: str,  # for people, as is `next_step`
        next_step: str = "",
        about: str = "",  # which port or channel, where there are several
        reason: str = "",  # what has not ended is told again with another one
    ) -> bool | None:
        """Tell it, if it is to be told now; return whether it was."""


def times(count: int) -> str:
    """Return "once", "2 times" and so on."""
    return "once" if count == 1 else f"{count} times"


class RateLimit:
    """Lets one event of a kind pass per period; for use by one thread.

    While one comes whenever it may, the period doubles each time, up to `LONGEST_PERIOD_S`; after
    as long without any it is the first one again.
    """

    def __init__(self, period_s: float = EVENT_PERIOD_S) -> None:
        self._first_s = self._period_s = period_s
        self._passed_s = -LONGEST_PERIOD_S - period_s

    def allows(self) -> bool:
        """Whether an event may be told now; if so, the next one waits."""
        now_s = time.monotonic()
        since_s = now_s - self._passed_s
        if since_s < self._period_s:
            return False
        goes_on = since_s < 2 * self._period_s
        longest_s = max(LONGEST_PERIOD_S, self._first_s)
        self._period_s = min(2 * self._period_s, longest_s) if goes_on else self._first_s
        self._passed_s = now_s
        return True


class Rises:
    """Tells which counts have risen since it was asked last; for use by one thread."""

    def __init__(self) -> None:
        self._seen: dict[str, int] = {}

    def __call__(self, name: str, count: int) -> bool:
        """Whether the count of that name, now at this, has risen."""
        before, self._seen[name] = self._seen.get(name, 0), count
        return count > before


class EventBook:
    """Says what is to be told, counts that by name, and keeps the last troubles.

    For any thread. What it holds is bounded by the number of names.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        # the last of each name, with when that was, the newest at the end
        self._troubles: dict[str, tuple[float, dict[str, Any]]] = {}
        self._allowance: dict[str, _Allowance] = {}
        self._limits: dict[tuple[str, str], RateLimit] = {}  # by name and what it is about
        self._lasting: dict[tuple[str, str], str] = {}  # what has not ended, with its reason

    def is_due(self, name: str, about: str = "", reason: str = "") -> bool:
        """Whether what is seen is told now: the end of what was told, news, and not too often."""
        kind, key = EVENTS[name], (name, about)
        with self._lock:
            over = [each for each in self._lasting if EVENTS[each[0]].end == name]
            over = [each for each in over if each[1] == about]
            if self._lasting.get(key) == reason or (name in ENDS and not over):
                return False
            if not self._limits.setdefault(key, RateLimit(kind.period_s)).allows():
                return False
            for each in over:
                del self._lasting[each]
            if kind.end:
                self._lasting[key] = reason
            return True

    def note(self, name: str, detail: str, next_step: str) -> int | None:
        """Take note of an event; return how many the log was spared before, None for one more."""
        now_s, severity = time.monotonic(), EVENTS[name].severity
        with self._lock:
            self._counts[name] += 1
            if severity != "info":
                self._troubles.pop(name, None)
                told: dict[str, Any] = {"name": name, "severity": severity, "detail": detail}
                told |= {"next_step": next_step, "realtime_ns": wall_clock_ns()}
                self._troubles[name] = now_s, told
            return self._allowance.setdefault(name, _Allowance(now_s)).take(now_s)

    def fields(self) -> dict[str, Any]:
        """Return what `status` says of events."""
        now_s = time.monotonic()
        with self._lock:
            newest = list(reversed(self._troubles.values()))[:TROUBLES_KEPT]
            counts = dict(self._counts)
        troubles = [{**told, "age_s": now_s - at_s} for at_s, told in newest]
        return {"counts": counts, "troubles": troubles}


class _Allowance:
    """A few log lines of one event at once, then one a period."""

    def __init__(self, now_s: float) -> None:
        self._lines = float(LOGGED_AT_ONCE)
        self._at_s = now_s
        self._spared = 0

    def take(self, now_s: float) -> int | None:
        grown = self._lines + (now_s - self._at_s) / LOG_PERIOD_S
        self._lines, self._at_s = min(grown, float(LOGGED_AT_ONCE)), now_s
        if self._lines < 1:
            self._spared += 1
            return None
        self._lines -= 1
        spared, self._spared = self._spared, 0
        return spared

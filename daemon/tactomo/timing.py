"""Small measures of how long things take and how often they come, kept while the daemon runs.

Each is written by one thread and may be read by any other: a reader sees a few values old or new,
which a percentile does not mind.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from statistics import median_low
from typing import Final

import numpy as np

RING: Final = 256
"""Of each measure: at 20 Hz 13 s, long enough for a 99th percentile to hold two values."""
RATE_WINDOW_NS: Final = 3_000_000_000  # three hellos of a device; a rate that falls shows within it
WAITS: Final = 5  # A median of five bears two waits that were long by chance
LATE_PERIODS: Final = 3.0  # as many of its own periods late, and something has stopped
LONGEST_PERIOD_S: Final = 60.0
MINUTE_S: Final = 60.0
LOOK_S: Final = 1.0
LATEST_NS: Final = 2**63 - 2**58
"""In the year 2253: dates are of 63 bits, and a recording may go on for years."""


def wall_clock_ns() -> int:
    """Now on the computer's wall clock, ns since 1970; the nearest that can be told, if far off."""
    try:
        return min(max(time.time_ns(), 0), LATEST_NS)
    except OverflowError:  # from the year 2262 on
        return LATEST_NS


class Durations:
    """The last 256 durations of one thing."""

    def __init__(self) -> None:
        self.count = 0  # how many there were in all
        self.total_s = 0.0  # and how long they took together
        self._seconds = np.full(RING, np.nan)

    def add(self, seconds: float) -> None:
        """Take note of one."""
        self._seconds[self.count % RING] = seconds
        self.total_s += seconds
        self.count += 1

    def percentiles_ms(self) -> dict[str, float] | None:
        """Return p50 and p99 in milliseconds; None before the first one."""
        known = self._seconds[: min(self.count, RING)]
        if not known.size:
            return None
        p50, p99 = np.percentile(known, (50, 99)) * 1e3
        return {"p50": float(p50), "p99": float(p99)}


class Pace:
    """How long the next of something takes to come: the median of the last few waits.

    So what is slow by nature is given its time, and one long pause is nobody's pace.
    """

    def __init__(self) -> None:
        # seconds after which it is late: a few of its periods. 0 before the first one
        self.few_s = 0.0
        self._waits_s: deque[float] = deque(maxlen=WAITS)

    def add(self, wait_s: float) -> None:
        """Take note of how long one was waited for."""
        self._waits_s.append(wait_s)
        self.few_s = LATE_PERIODS * min(median_low(self._waits_s), LONGEST_PERIOD_S)

    def clear(self) -> None:
        """Forget it: something else comes from now on."""
        self._waits_s.clear()
        self.few_s = 0.0


class Rate:
    """How often something comes, over the last seconds, or a few periods of what is slower."""

    def __init__(self) -> None:
        self.count = 0  # how often it came in all
        self.pace = Pace()  # how long the next one usually takes
        self._times_ns = np.zeros(RING, dtype=np.int64)

    def add(self, monotonic_ns: int) -> None:
        """Take note of one that came at that time."""
        if self.count:
            self.pace.add((monotonic_ns - int(self._times_ns[(self.count - 1) % RING])) * 1e-9)
        self._times_ns[self.count % RING] = monotonic_ns
        self.count += 1

    def per_second(self) -> float:
        """Return the rate in Hz; 0 when nothing came for a while."""
        window_ns = max(RATE_WINDOW_NS, int(self.pace.few_s * 1e9))
        since_ns = time.monotonic_ns() - window_ns
        recent = self._times_ns[self._times_ns > since_ns]
        if recent.size < 2:
            return 0.0
        span_ns = int(recent.max() - recent.min())
        return (recent.size - 1) / span_ns * 1e9 if span_ns else 0.0


class LastMinute:
    """How far counts have risen within the last minute, if they are looked at each second.

    So what was damaged or left out an hour ago is not taken for present. For any thread.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._seen: deque[tuple[float, Mapping[str, int]]] = deque([(time.monotonic(), {})])

    def rise(self, counts: Mapping[str, int]) -> dict[str, int]:
        """Return by how much each count, now at this, is above what it was a minute ago."""
        now_s = time.monotonic()
        with self._lock:
            if now_s - self._seen[-1][0] >= LOOK_S:
                self._seen.append((now_s, counts))
            while len(self._seen) > 1 and now_s - self._seen[1][0] >= MINUTE_S:
                self._seen.popleft()
            before = self._seen[0][1]
        return {name: count - before.get(name, 0) for name, count in counts.items()}

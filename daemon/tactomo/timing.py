"""Small measures of how long things take and how often they come, kept while the daemon runs.

Each is written by one thread and may be read by any other: a reader sees a few values old or new,
which a percentile does not mind.
"""

from __future__ import annotations

import time
from typing import Final

import numpy as np

RING: Final = 256
RATE_WINDOW_NS: Final = 3_000_000_000


class Durations:
    """The last 256 durations of one thing.

    Attributes:
        count: how many there were in all.
        total_s: and how long they took together.

    """

    def __init__(self) -> None:
        self.count = 0
        self.total_s = 0.0
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


class Rate:
    """How often something comes, over the last seconds.

    Attributes:
        count: how often it came in all.

    """

    def __init__(self) -> None:
        self.count = 0
        self._times_ns = np.zeros(RING, dtype=np.int64)

    def add(self, monotonic_ns: int) -> None:
        """Take note of one that came at that time."""
        self._times_ns[self.count % RING] = monotonic_ns
        self.count += 1

    def per_second(self) -> float:
        """Return the rate in Hz; 0 when nothing came for a while."""
        since_ns = time.monotonic_ns() - RATE_WINDOW_NS
        recent = self._times_ns[self._times_ns > since_ns]
        if recent.size < 2:
            return 0.0
        span_ns = int(recent.max() - recent.min())
        return (recent.size - 1) / span_ns * 1e9 if span_ns else 0.0

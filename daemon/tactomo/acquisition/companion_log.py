"""What the companions of one port read, held against the port's scans by the device's own clock.

A scan is held against the readings that came before it on the line, so that a replay of the same
bytes comes to the same. What a reading tells is of some time before: of its dead time, and of the
time constants that a lag needs to follow. The sheets must have been still since; the reconstructor
knows whether they were.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from tactomo_models import SensorDescription
from tactomo_protocol import CompanionReading, ScanFlag

from tactomo.protocols.interface import KEPT_READINGS
from tactomo.scans import Felt

STALE_US: Final = 500_000
STALE_PERIODS: Final = 3
"""A companion that was silent for longer than both has no reading."""
FROZEN_TIMES: Final = 10
"""One that reads the very same for so much longer than ever, and for STALE_US, is frozen."""
KNOWN_CHANGES: Final = 100
"""Of a companion's readings, that tell for how long it may read the very same."""
LAGS: Final = 4.0
"""Time constants after which a first-order lag has followed, to 2 %."""


class _Reading(NamedTuple):
    device_us: int
    value: float  # NaN where the device clipped, or repeats itself


@dataclass
class _Run:
    """Readings of one companion that are the very same: such as a frozen converter repeats."""

    value: float
    begin_us: int
    end_us: int
    longest_us: int = 0  # of those before
    changes: int = 0

    @property
    def is_frozen(self) -> bool:
        patience_us = max(STALE_US, FROZEN_TIMES * self.longest_us)
        return self.changes >= KNOWN_CHANGES and self.end_us - self.begin_us > patience_us

    def take(self, value: float, device_us: int) -> None:
        if value == self.value and device_us >= self.end_us:
            self.end_us = device_us
            return
        if not self.is_frozen:
            self.longest_us = max(self.longest_us, self.end_us - self.begin_us)
            self.changes += 1
        self.value, self.begin_us, self.end_us = value, device_us, device_us


class CompanionLog:
    """The newest readings of each companion. For use by one thread."""

    def __init__(self, description: SensorDescription) -> None:
        self._names = description.companion_indices
        self._companions = description.companion
        self._kept: dict[str, deque[_Reading]] = {}
        self._runs: dict[str, _Run] = {}

    def forget(self) -> None:
        """Forget all readings: what comes does not go on from them."""
        self._kept.clear()
        self._runs.clear()

    def take(self, packet: CompanionReading) -> bool:
        """Keep a reading; return whether the description knows its companion.

        One that comes again changes nothing; a clock that has gone back begins anew. A device
        without a clock takes all readings at the same time: the last one counts.
        """
        name = self._names.get(packet.index)
        if name is None:
            return False
        kept = self._kept.setdefault(name, deque(maxlen=KEPT_READINGS))
        value = math.nan if packet.flags & ScanFlag.SATURATED else packet.value
        if kept and packet.device_us <= kept[-1].device_us:
            if packet.device_us == kept[-1].device_us:
                kept.pop()
            elif any(packet.device_us == one.device_us for one in kept):
                return True
            else:
                kept.clear()
        run = self._runs.setdefault(name, _Run(value, packet.device_us, packet.device_us))
        run.take(value, packet.device_us)
        if run.is_frozen:
            value = math.nan
        kept.append(_Reading(packet.device_us, value))
        return True

    def at(self, scan_us: int) -> tuple[Felt, ...]:
        """Return what the companions say of a scan of this time, by the device's clock."""
        felt = (self._felt(name, scan_us) for name in self._kept)
        return tuple(each for each in felt if each is not None)

    def _felt(self, name: str, scan_us: int) -> Felt | None:
        times_us, values = zip(*self._kept[name], strict=True)
        oldest_us, newest_us = times_us[0], times_us[-1]
        period_us = newest_us - times_us[-2] if len(times_us) > 1 else 0
        patience_us = max(STALE_US, STALE_PERIODS * period_us)
        if scan_us - newest_us > patience_us or oldest_us - scan_us > patience_us:
            return None
        companion = self._companions[name]
        dead_us = round(1e6 * companion.dead_time_s)
        at_us = min(max(scan_us + dead_us, oldest_us), newest_us)
        since_us = scan_us + dead_us - at_us + round(1e6 * LAGS * companion.lag_s)
        # From here on by differences: 53 bits of a clock are more than a double adds up well.
        offsets = [time_us - at_us for time_us in times_us]
        return Felt(name, float(np.interp(0, offsets, values)), since_us)

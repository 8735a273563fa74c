"""The twin's companions: load cells and the like, which feel what presses the skin.

Their truth is the pressure on the simulated skin; noise, the gain's error, lag and dead time are
those of the sensor description. Noise depends on nothing but the seed, the companion and the scan's
counter; the gain's error on seed and companion.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from tactomo_models import SensorDescription
from tactomo_models.sensor.companion import Companion
from tactomo_protocol import CompanionReading, ScanFlag


class SimulatedCompanions:
    """All companions of a sensor. For use by one thread; time only goes on."""

    def __init__(self, description: SensorDescription, seed: int) -> None:
        self._each = {
            name: _SimulatedCompanion(index, description.companion[name], seed)
            for index, name in description.companion_indices.items()
        }

    def read(
        self, forces_n: Mapping[str, float], time_s: float, counter: int
    ) -> list[CompanionReading]:
        """Return what each reads at a scan; `forces_n` are what presses on each then."""
        return [each.read(forces_n[name], time_s, counter) for name, each in self._each.items()]


@dataclass(eq=False)
class _SimulatedCompanion:
    _index: int
    _companion: Companion
    _seed: int

    def __post_init__(self) -> None:
        off = np.random.default_rng([self._seed, self._index, 8]).standard_normal()
        self._gain = 1 + self._companion.relative_error * float(off)
        self._to_come: deque[tuple[float, float]] = deque()  # forces within the dead time
        self._through_n = 0.0  # the force that has come through the dead time
        self._seen_n, self._seen_s = 0.0, 0.0  # the force behind the lag, and when

    def read(self, force_n: float, time_s: float, counter: int) -> CompanionReading:
        companion = self._companion
        noise = np.random.default_rng([self._seed, self._index, counter, 3]).standard_normal()
        felt_n = self._gain * self._behind(force_n, time_s) + companion.noise_n * float(noise)
        value = companion.reading_of(felt_n)
        flags = ScanFlag.SIMULATED
        if not companion.may_read(value):
            flags |= ScanFlag.SATURATED
        return CompanionReading(self._index, flags, round(1e6 * time_s), value)

    def _behind(self, force_n: float, time_s: float) -> float:
        """Return the force as it is seen behind dead time and lag."""
        self._to_come.append((time_s, force_n))
        while self._to_come and self._to_come[0][0] <= time_s - self._companion.dead_time_s:
            _, self._through_n = self._to_come.popleft()
        lag_s, passed_s = self._companion.lag_s, time_s - self._seen_s
        share = 1.0 if lag_s == 0 else -math.expm1(-passed_s / lag_s)
        self._seen_n += share * (self._through_n - self._seen_n)
        self._seen_s = time_s
        return self._seen_n

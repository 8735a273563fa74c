"""The converter: what amplifier and ADC make of the volts that the skin puts out.

Four things happen to a voltage, in this order, and each can be set to nothing: a gain that drifts
slowly, noise of the same size in volts on every measurement, rounding to counts, and clipping at
the converter's range (the scan is then flagged as saturated).

Noise and drift come from seeded generators and depend on nothing but the channel, the scan's
counter and the device's time: the same seed gives the same skin again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tactomo_models.arrays import FloatArray
from tactomo_protocol import Channel

ADC_BITS = 24


@dataclass(frozen=True, slots=True)
class Drift:
    """How a channel's gain wanders: a random walk and a creep towards a new level.

    Attributes:
        walk: relative standard deviation that the gain gathers in one second; after ``n`` seconds
            it is ``walk * sqrt(n)``.
        creep: relative change of the gain after a long time.
        creep_s: time constant of the creep, in seconds.
    """

    walk: float = 2e-6
    creep: float = 2e-5
    creep_s: float = 120.0


class DriftingGain:
    """One channel's gain as a function of device time."""

    def __init__(self, seed: int, channel: Channel) -> None:
        self._steps = np.random.default_rng([seed, channel.number])
        self._walk = np.zeros(1)

    def at(self, time_s: float, drift: Drift) -> float:
        """Return the gain ``time_s`` seconds after power-up; 1 at power-up."""
        creep = drift.creep * -np.expm1(-time_s / drift.creep_s)
        return float(1.0 + creep + drift.walk * self._walk_at(time_s))

    def _walk_at(self, time_s: float) -> float:
        """Unit random walk on a grid of one second, straight lines in between."""
        while len(self._walk) < time_s + 2.0:
            block = self._walk[-1] + np.cumsum(self._steps.standard_normal(60))
            self._walk = np.concatenate([self._walk, block])
        second = int(time_s)
        before, after = self._walk[second : second + 2]
        return float(before + (time_s - second) * (after - before))


class Converter:
    """Turns volts into counts. `noise_v` and `drift` may be changed between scans.

    Args:
        full_scale_v: volts at the end of the converter's range, either sign.
        noise_v: standard deviation of the noise in volts, the same on every measurement.
        drift: how the gain wanders.
        seed: equal seeds give equal noise and drift.
    """

    def __init__(
        self, full_scale_v: float, noise_v: float, drift: Drift | None = None, seed: int = 0
    ) -> None:
        self.full_scale_v = full_scale_v
        self.noise_v = noise_v
        self.drift = drift or Drift()
        self._seed = seed
        self._gains: dict[Channel, DriftingGain] = {}

    @property
    def volts_per_count(self) -> float:
        """Size of one count, in volts."""
        return float(self.full_scale_v / 2 ** (ADC_BITS - 1))

    def convert(
        self, volts: FloatArray, *, channel: Channel, counter: int, time_s: float
    ) -> tuple[NDArray[np.int32], bool]:
        """Return the counts of one scan, (M,), and whether any of them hit the end of the range."""
        gain = self._gains.setdefault(channel, DriftingGain(self._seed, channel))
        noise = np.random.default_rng([self._seed, channel.number, counter, 1])
        seen_v = volts * gain.at(time_s, self.drift)
        seen_v = seen_v + self.noise_v * noise.standard_normal(len(volts))
        top = 2 ** (ADC_BITS - 1) - 1
        counts = np.rint(seen_v / self.volts_per_count)
        saturated = bool(np.any(np.abs(counts) > top))
        return np.clip(counts, -top, top).astype(np.int32), saturated

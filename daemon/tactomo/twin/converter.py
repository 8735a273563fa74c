"""The converter: what amplifier and ADC make of the volts that the skin puts out.

Three things happen to a voltage, in this order: noise of the same size in volts on every
measurement, rounding to counts, and clipping at the converter's range (the scan is then flagged as
saturated).

Noise depends on nothing but the seed, the channel and the scan's counter: the same seed gives the
same skin again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tactomo_models.arrays import FloatArray
from tactomo_protocol import Channel

ADC_BITS = 24


@dataclass
class Converter:
    """Turns volts into counts. `noise_v` may be changed between scans."""

    full_scale_v: float  # volts at the end of the converter's range, either sign
    noise_v: float  # standard deviation of the noise in volts, the same on every measurement
    seed: int = 0  # equal seeds give equal noise

    @property
    def volts_per_count(self) -> float:
        """Size of one count, in volts."""
        return float(self.full_scale_v / 2 ** (ADC_BITS - 1))

    def convert(
        self, volts: FloatArray, *, channel: Channel, counter: int
    ) -> tuple[NDArray[np.int32], bool]:
        """Return the counts of one scan, (M,), and whether any of them hit the end of the range."""
        noise = np.random.default_rng([self.seed, channel.number, counter, 1])
        seen_v = volts + self.noise_v * noise.standard_normal(len(volts))
        top = 2 ** (ADC_BITS - 1) - 1
        counts = np.rint(seen_v / self.volts_per_count)
        saturated = bool(np.any(np.abs(counts) > top))
        return np.clip(counts, -top, top).astype(np.int32), saturated

"""The noise of the scan at hand, by reciprocity, and what noise alone stays below.

Any sheet obeys V(k, m) = V(m, k), whatever presses, and so does any model of it. A device breaks
that by the same share in every scan (its channels' gains), which the tare tells. What reciprocal
voltages differ by beyond that share is noise of the scan and of the reference.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.robust import HUBER_EFFICIENCY, huber_sigma
from tactomo_models.scans.plausibility import TINY, Wiring, asymmetry_of

FALSE_ALARM = 1e-6  # chance that an unpressed frame of pure noise is taken for a pressed one
CERTAIN = 1.645  # standard deviations that 95 % of a normal distribution are below


class FrameNoise(NamedTuple):
    """Noise of one scan's changes."""

    variance_ratio: float  # over the variance that the tare tells
    freedom: float  # degrees of freedom that the ratio is known with; inf where the tare tells it


AS_TARED = FrameNoise(1.0, np.inf)


class FrameNoiseEstimator:
    """Holds what reciprocal voltages of a scan differ by against what the tare leads to expect."""

    def __init__(
        self,
        wiring: Wiring,  # of the sensor
        reference: FloatArray,  # (M,) volts of the unpressed sheet; 0 where there are none
        noise: FloatArray,  # (M,) standard deviation of scan less reference, volts
        *,
        is_bound: bool,  # whether the noise is an upper bound alone, so that a scan may have less
    ) -> None:
        self._first, self._second = wiring.reciprocal.T
        self._asymmetry = asymmetry_of(wiring, reference)
        self._sigma = np.hypot(noise[self._first], noise[self._second]) + TINY
        self._is_bound = is_bound

    def estimate(self, scan: FloatArray, usable: BoolArray) -> FrameNoise:
        """Estimate the noise of a scan (M,), volts, from the pairs that are `usable` (M,).

        Where the tare has measured the noise, a scan has more only if chance does not explain it.
        """
        both = usable[self._first] & usable[self._second]
        one, other = scan[self._first[both]], scan[self._second[both]]
        freedom = HUBER_EFFICIENCY * len(one)
        if freedom < 1:
            return AS_TARED
        error = one - other - self._asymmetry[both] * (one + other)
        ratio = huber_sigma(error / self._sigma[both]) ** 2
        is_chance = ratio * freedom < noise_limit(freedom)
        return AS_TARED if is_chance and not self._is_bound else FrameNoise(ratio, freedom)


def hides_press(
    squares: float,  # sum over the independent ways in which pressing changes voltages
    ways: int,  # how many these are
    variance: float,  # of one of them by the scan's noise; by the tare's it is 1
    freedom: float,  # degrees of freedom that this variance is known with
    told: float,  # sum of squares that a press adds which is told half of the time after the tare
) -> bool:
    """Tell whether such a press may be in a scan: whether it would leave more in 95 of 100."""
    by_noise = 2 * ways * variance**2 + 2 * (ways * variance) ** 2 / freedom
    spread = np.sqrt(by_noise + 4 * told * variance)
    return bool(squares > ways * variance + told - CERTAIN * spread)


def is_noise(squares: FloatArray, freedom: float = np.inf) -> bool:
    """Whether noise alone explains squares over their variance; see `noise_limit`."""
    return bool(squares.sum() < noise_limit(squares.size, freedom))


@cache
def noise_limit(
    count: float,  # voltages, or degrees of freedom that they have
    freedom: float = np.inf,  # degrees of freedom that their variance is known with
) -> float:
    """Sum of squares over their variance that noise alone stays below, but for false alarms."""
    from scipy.special import chdtri, fdtri  # a third of the start of `tactomo info`

    if np.isinf(freedom):
        return float(chdtri(count, FALSE_ALARM))
    return count * float(fdtri(count, freedom, 1 - FALSE_ALARM))

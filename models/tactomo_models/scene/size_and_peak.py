"""How sure a peak is where a small hard contact looks like a larger, lighter one.

Voltages tell what a small contact conducts more by than the bare sheet, area times reflection, and
its size far less: that is the next term, which goes by the radius squared (Ammari & Kang, Springer
2004, polarisation tensors). So peaks and sizes that data leave possible lie along a bend, which the
covariance at its likeliest point cuts short. Here the data are quadratic in those two terms, the
prior stays as it is, and both weight points along the bend.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactomo_models.arrays import FloatArray

ALONG, MAX_SIGMAS = 61, 6.0  # points along the bend, and how far
ACROSS = np.linspace(-3, 3, 9)  # likewise across, in standard deviations


@dataclass(frozen=True)
class SizeAndPeak:
    """What is known of a contact's logarithm of size, and of its peak: (2,) each."""

    found: FloatArray  # the likeliest
    covariance: FloatArray  # (2, 2) there, the prior included
    likely: FloatArray  # what is likely before any data
    precision: FloatArray  # inverse variances of that
    size_limits: FloatArray  # least and largest logarithm of size


@dataclass(frozen=True)
class ReflectionTable:
    """How discs under peaks reflect a field."""

    peaks: FloatArray  # (n,) between their limits
    logarithm: FloatArray  # (n,) of the reflection
    slope: FloatArray  # (n,) of that by the peak

    @classmethod
    def of(cls, peaks: FloatArray, relative_change: FloatArray) -> ReflectionTable:
        """The table where the conductivity changes so (n,) under peaks (n,)."""
        reflection = np.abs(relative_change / (2 + relative_change))
        logarithm = np.log(np.maximum(reflection, 1e-9))
        return cls(peaks, logarithm, np.gradient(logarithm, peaks))


@dataclass(frozen=True)
class Bend:
    """What peaks and sizes along the bend come to."""

    peaks: FloatArray  # (2,) that the true one exceeds, and stays below, with 95 %
    # Root mean squares of relative distances from the likeliest: of the peak, the area, the force.
    peak_spread: float
    area_spread: float
    force_spread: float


def along_bend(known: SizeAndPeak, table: ReflectionTable) -> Bend:
    """What a contact's peak and force may be."""
    least, largest = known.size_limits
    size, peak = known.found
    at_found, slope = (
        float(np.interp(peak, table.peaks, each)) for each in (table.logarithm, table.slope)
    )
    certain = np.linalg.inv(known.covariance)
    data = certain - np.diag(known.precision)
    pull = known.precision * (known.found - known.likely)
    reach = MAX_SIGMAS * np.sqrt(known.covariance[0, 0])
    away = np.linspace(max(-reach, least - size), min(reach, largest - size), ALONG)[:, None]
    by_size = np.expm1(2 * away) / 2  # to first order the change of size, of the radius squared
    by_peak = (ACROSS / np.sqrt(certain[1, 1])) - by_size * certain[0, 1] / certain[1, 1]
    wanted = at_found + slope * by_peak + 2 * (by_size - away)
    peaks = np.interp(wanted, table.logarithm, table.peaks)
    cost = (data[0, 0] * by_size**2 + data[1, 1] * by_peak**2) / 2
    cost += data[0, 1] * by_size * by_peak - pull[0] * by_size - pull[1] * by_peak
    cost += known.precision[0] * (size + away - known.likely[0]) ** 2 / 2
    cost += known.precision[1] * (peaks - known.likely[1]) ** 2 / 2
    width = 1 / np.maximum(np.interp(peaks, table.peaks, table.slope), 1e-6)
    share = np.exp(cost.min() - cost) * width
    share /= share.sum()
    order = np.argsort(peaks, axis=None)
    bounds = np.interp([0.05, 0.95], share.flat[order].cumsum(), peaks.flat[order])
    times, area = peaks / peak, np.exp(2 * away)
    spreads = [float(np.sqrt((share * (x - 1) ** 2).sum())) for x in (times, area, times * area)]
    return Bend(np.asarray(bounds), *spreads)

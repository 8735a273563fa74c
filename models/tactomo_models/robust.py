"""Statistics that a few outliers do not move."""

from __future__ import annotations

import numpy as np

from tactomo_models.arrays import FloatArray


def robust_sigma(deviations: FloatArray) -> float:
    """Return the standard deviation of normal noise whose deviations (any shape) these are.

    It goes by the median of their sizes: half of a normal distribution lies within 0.6745 standard
    deviations (Rousseeuw & Croux, "Alternatives to the median absolute deviation", 1993).
    """
    return float(np.median(np.abs(deviations))) / 0.6745

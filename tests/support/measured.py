"""Changes of one channel for tests that begin there: no reference, no scan."""

from __future__ import annotations

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.scans.changes import Changes


def measured(change: FloatArray, weight: FloatArray | float = 1.0) -> Changes:
    """Relative changes (M,) with the inverse standard deviations of independent errors."""
    weights = np.broadcast_to(weight, change.shape).astype(float)
    with np.errstate(divide="ignore"):
        variance = np.where(weights > 0, 1 / weights**2, 0.0)
    even = np.ones(change.shape)
    none, modes = np.zeros(change.shape), np.eye(len(change), len(change) // 2)
    return Changes(
        change, weights, even, False, 1.0, weights**2, variance + (weights == 0), none, modes
    )

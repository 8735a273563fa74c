"""The test that every derivative has to pass."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from tactomo_models.arrays import FloatArray

STEPS = np.array([3e-4, 3e-5, 3e-6])


def taylor_orders(
    values: Callable[[FloatArray], FloatArray],
    at: FloatArray,
    slope: FloatArray,
    direction: FloatArray,
    steps: FloatArray = STEPS,
) -> FloatArray:
    """Orders with which |f(p + e d) - f(p) - e f'(p) d| falls: 2 where the slope is right.

    Args:
        values: f, of parameters (N,).
        at: (N,) p.
        slope: f'(p) d, of the values' shape.
        direction: (N,) d.
        steps: falling e.
    """
    here = values(at)
    errors = [np.linalg.norm(values(at + e * direction) - here - e * slope) for e in steps]
    return np.asarray(np.diff(np.log(errors)) / np.diff(np.log(steps)))

"""Contacts of a pressure field, for tests that begin there."""

from __future__ import annotations

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.scene.pressure_field import (
    COLUMNS,
    E1,
    EDGE,
    HARMONIC,
    HOLE,
    PEAK,
    SIZE,
    UNIT_M,
    X,
    Y,
)


def contact(
    x_m: float = 0.004,
    y_m: float = 0.0,
    radius_m: float = 0.008,
    *,
    peak: float = 0.8,
    e: tuple[float, float] = (0.0, 0.0),
    waves: tuple[float, ...] = (),
    edge: float = 0.0,
    hole: float = 0.0,
) -> FloatArray:
    """Parameters (COLUMNS,) of a contact; its peak is a share of the table's end."""
    each = np.zeros(COLUMNS)
    each[[X, Y, SIZE]] = x_m / UNIT_M, y_m / UNIT_M, np.log(radius_m)
    each[E1 : E1 + 2] = e
    each[HARMONIC : HARMONIC + len(waves)] = waves
    each[[PEAK, EDGE, HOLE]] = peak, edge, hole
    return each


def contacts(*each: FloatArray) -> FloatArray:
    """Parameters (K, COLUMNS) of all."""
    return np.array(each).reshape(-1, COLUMNS)

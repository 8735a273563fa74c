"""A pressure field drawn on nodes, and the smoothed step that outlines have."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from tactomo_models.arrays import FloatArray, IntArray

GRADED_WIDTH = 0.7

Slopes: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True)
class Drawing:
    """A field on the nodes that it presses."""

    nodes: IntArray  # (n,) pressable nodes where something presses
    # (n,) share of each within outlines, 0 to 1 (-1 to 1 of `objects`): what a saturated sheet
    # shows, since a good conductor hides the hole of a ring
    enclosed: FloatArray
    enclosed_kpa: FloatArray  # (n,) pressure there
    # (n,) share of each that is pressed, as drawn on a graded sheet: without holes, and above 1 for
    # the mesh's blur
    share: FloatArray
    pressure_kpa: FloatArray  # (n,) pressure on that share
    slopes: Callable[[], Slopes]  # makes the derivatives (n, N) of the four by the parameters


def heaviside(t: FloatArray) -> FloatArray:
    """Smoothed step of compact support: 0 below -1, 1 above 1."""
    t = np.clip(t, -1, 1)
    # Rounding must not leave a trace of 1e-17: outside the support every such node would be solved,
    # and below 0 one would pass for a node that conducts worse than the bare sheet.
    return np.where(t > -1, np.maximum(0.5 * (1 + t + np.sin(np.pi * t) / np.pi), 0.0), 0.0)


def heaviside_slope(t: FloatArray) -> FloatArray:
    """Derivative of `heaviside`."""
    return np.asarray((1 + np.cos(np.pi * np.clip(t, -1, 1))) / 2)

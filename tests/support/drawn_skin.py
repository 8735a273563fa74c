"""A skin of unknown make: voltages depend smoothly on a press's place, by no model."""

from __future__ import annotations

import numpy as np
from tactomo_models.arrays import FloatArray


def presses_on(
    seed: int, count: int, *, noise: float = 0.02, half: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Changes (count, 40) under presses of uneven strength, and their places (count, 2) in mm.

    Args:
        seed: of the presses; the skin is always the same one, 80 mm wide.
        count: how many.
        noise: of a voltage, over the largest at that strength.
        half: on the left half only.
    """
    skin, rng = np.random.default_rng(0), np.random.default_rng([seed, 1])
    centres, widths = skin.uniform(-45, 45, (40, 2)), skin.uniform(12, 30, 40)
    signs = skin.choice([-1.0, 1.0], 40)
    xy_mm = rng.uniform(-40, 40, (count, 2))
    if half:
        xy_mm[:, 0] = -np.abs(xy_mm[:, 0])
    squared = ((xy_mm[:, None] - centres) ** 2).sum(axis=2)
    clean = signs * np.exp(-squared / (2 * widths**2))
    strength = rng.uniform(100, 1000, (count, 1))
    return strength * (clean + noise * rng.standard_normal(clean.shape)), xy_mm

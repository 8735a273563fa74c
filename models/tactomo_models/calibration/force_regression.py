"""How hard a press is, learnt on one skin from presses of known force.

The physics' load, magnitude times area, grows with the force. On logarithms the dependence is a
straight line; what is left depends on the place, where a Gaussian process learns it. A cover that
takes part of the load, and a table of another sheet, are in the line.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from tactomo_models.arrays import FloatArray
from tactomo_models.calibration.press_regression import MIN_PRESSES, Correction
from tactomo_models.errors import DataError

MIN_SPREAD: Final = 0.02
"""Standard deviation of the loads' logarithms, below which no line can be told."""


class ForceRegression:
    """Tells forces on the skin whose presses it was made of.

    Raises DataError where there are too few presses, or all are of one load.
    """

    def __init__(
        self,
        loads: FloatArray,  # (N,) magnitude times area of each contact, on any one scale
        xy_mm: FloatArray,  # (N, 2) where each was
        force_n: FloatArray,  # (N,) newtons
    ) -> None:
        seen, known = np.log(loads), np.log(force_n)
        if len(seen) < MIN_PRESSES or seen.std() < MIN_SPREAD:
            raise DataError(f"give {MIN_PRESSES} presses of known force, or more, of various ones")
        self._line = np.polyfit(seen, known, 1)
        rest = known - np.polyval(self._line, seen)
        self._rest = Correction(xy_mm, rest[:, None])

    def force(self, loads: FloatArray, xy_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Forces (T,) of loads (T,) at places (T, 2), and their standard uncertainties, newtons."""
        rest, variance = self._rest.at(xy_mm)
        force_n = np.exp(np.polyval(self._line, np.log(loads)) + rest[:, 0])
        return force_n, force_n * np.sqrt(variance)

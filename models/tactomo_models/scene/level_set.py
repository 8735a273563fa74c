"""Parametric level set: shapes of any form, as the zero line of a sum of Gaussians.

    f(x) = sum_i mu_i p_i(x) - 1/2          the paper, equation 7, with a resting value
    h(f) = 0 below -w, 1 above w, smooth between

The most general description of what presses, and the dearest: it is for scenes that no few
outlines explain, such as an L or two contacts that merge.
"""

from __future__ import annotations

from copy import copy
from functools import cache

import numpy as np

from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene.drawing import Drawing, Slopes, heaviside, heaviside_slope
from tactomo_models.scene.parameters import PEAK, PRIOR_SIGMA
from tactomo_models.scene.pressure_field import PressureField

KERNEL_SPREAD = 0.7  # standard deviation of a Gaussian over the kernels' distance
HALF_WIDTH = 0.15  # w of the Heaviside
SATURATING_KPA = 1e9  # pressure where none is fitted: the sheet is saturated
RESTING = -0.5  # f where nothing presses: below -HALF_WIDTH, so h is exactly 0


class LevelSet:
    """The level-set functions of a sheet: a family of shapes with a coefficient for each kernel."""

    def __init__(self, forward: ForwardModel) -> None:
        prior = 0.3  # inverse variance: coefficients of contacts are of order 1
        x, y = forward.bare.points[:, forward.bare.pressable]
        description = forward.description
        kx, spacing_x = _kernel_centres(description.width_m / 2 - description.sheet.frame_width_m)
        ky, spacing_y = _kernel_centres(description.height_m / 2 - description.sheet.frame_width_m)
        gx = np.exp(-0.5 * ((x[:, None] - kx) / (KERNEL_SPREAD * spacing_x)) ** 2)
        gy = np.exp(-0.5 * ((y[:, None] - ky) / (KERNEL_SPREAD * spacing_y)) ** 2)
        self.kernels = (gx[:, None, :] * gy[:, :, None]).reshape(len(x), -1)  # (P, K)
        self._projection = np.linalg.solve(
            self.kernels.T @ self.kernels + 1e-3 * np.eye(self.kernels.shape[1]), self.kernels.T
        )
        self.prior_mean = np.zeros(self.kernels.shape[1])
        self.prior_precision = np.full(self.kernels.shape[1], prior)
        self._places = np.stack([x, y])
        self.centres_m = np.zeros((0, 2))  # of the contacts that own its parts
        self._owner: IntArray = np.zeros(0, np.intp)
        self._field: PressureField | None = None

    def owned_by(self, centres_m: FloatArray, field: PressureField | None) -> LevelSet:
        """The same level set, each part of which has the pressure of the nearest contact.

        Args:
            centres_m: (K, 2) places of the contacts.
            field: what their peaks are counted by; None where pressures are not fitted.
        """
        owned = copy(self)
        owned.centres_m, owned._field = centres_m, field
        if field is not None:
            apart = np.hypot(*(self._places[:, None] - centres_m.T[:, :, None]))
            owned._owner = apart.argmin(axis=0)
            peaks = np.full(len(centres_m), PRIOR_SIGMA[PEAK])
            kernels = self.kernels.shape[1]
            owned.prior_mean = np.append(
                self.prior_mean[:kernels], np.full(len(peaks), field.typical_peak)
            )
            owned.prior_precision = np.append(self.prior_precision[:kernels], peaks**-2)
        return owned

    def parameters_of(self, likeness: FloatArray) -> FloatArray:
        """Coefficients (K,) for an image (P,) that is 0 where nothing presses and 1 in contacts."""
        f = np.clip(2 * likeness - 1, RESTING, -RESTING)
        mu = self._projection @ (f - RESTING)
        # Gaussians round off small contacts; a start that presses nothing has no derivative.
        return np.asarray(mu * (-2 * RESTING / max(float((self.kernels @ mu).max()), 1e-6)))

    def bounded(self, parameters: FloatArray) -> FloatArray:
        """Any coefficients will do; pressures stay in their range."""
        if self._field is None:
            return parameters
        mu, peaks = np.split(parameters, [self.kernels.shape[1]])
        return np.append(mu, np.clip(peaks, *self._field.limits[:, PEAK]))

    def draw(self, parameters: FloatArray) -> Drawing:
        """Draw what is pressed on the nodes."""
        kernels = self.kernels.shape[1]
        f = self.kernels @ parameters[:kernels] + RESTING
        share = heaviside(f / HALF_WIDTH)
        nodes = np.flatnonzero(f > -HALF_WIDTH)
        if self._field is None:
            pressure = np.full(len(nodes), SATURATING_KPA)
        else:
            pressure = self._field.unit_kpa * parameters[kernels + self._owner[nodes]]

        @cache
        def slopes() -> Slopes:
            by_share = np.zeros((len(nodes), len(parameters)))
            by_f = heaviside_slope(f[nodes] / HALF_WIDTH) / HALF_WIDTH
            by_share[:, :kernels] = by_f[:, None] * self.kernels[nodes]
            by_pressure = np.zeros_like(by_share)
            if self._field is not None:
                owner = kernels + self._owner[nodes]
                by_pressure[np.arange(len(nodes)), owner] = self._field.unit_kpa
            return by_share, by_pressure, by_share, by_pressure

        return Drawing(nodes, share[nodes], pressure, share[nodes], pressure, slopes)


def _kernel_centres(half_side_m: float) -> tuple[FloatArray, float]:
    kernels_per_side = 9
    centres = np.linspace(-half_side_m, half_side_m, kernels_per_side)
    return centres, float(centres[1] - centres[0])

"""Parametric level set: shapes of any form, as the zero line of a sum of Gaussians.

    f(x) = sum_i mu_i p_i(x) - 1/2          the paper, equation 7, with a resting value
    h(f) = 0 below -w, 1 above w, smooth between

The most general description of what presses, and the dearest: it is for scenes that no few
outlines explain, such as an L or two contacts that merge.
"""

from __future__ import annotations

import numpy as np

from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene.shape_fit import heaviside, heaviside_slope

KERNEL_SPREAD = 0.7  # standard deviation of a Gaussian over the kernels' distance
HALF_WIDTH = 0.15  # w of the Heaviside
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
        self.ratio_freedom = 1.0
        self.prior_mean = np.zeros(self.kernels.shape[1])
        self.prior_precision = np.full(self.kernels.shape[1], prior)

    def parameters_of(self, likeness: FloatArray) -> FloatArray:
        """Coefficients (K,) for an image (P,) that is 0 where nothing presses and 1 in contacts."""
        f = np.clip(2 * likeness - 1, RESTING, -RESTING)
        mu = self._projection @ (f - RESTING)
        # Gaussians round off small contacts; a start that presses nothing has no derivative.
        return np.asarray(mu * (-2 * RESTING / max(float((self.kernels @ mu).max()), 1e-6)))

    def bounded(self, parameters: FloatArray) -> FloatArray:
        """Any coefficients will do."""
        return parameters

    def render(self, parameters: FloatArray) -> tuple[FloatArray, BoolArray]:
        """(P,) h, and where it is not 0 or may become so."""
        f = self._function(parameters, slice(None))
        return heaviside(f / HALF_WIDTH), f > -HALF_WIDTH

    def coverage(self, parameters: FloatArray) -> FloatArray:
        """(P,) share pressed."""
        return self.render(parameters)[0]

    def slope(self, parameters: FloatArray, nodes: IntArray) -> FloatArray:
        """Derivative (n, K) of h at n nodes by the coefficients."""
        f = self._function(parameters, nodes)
        by_f = heaviside_slope(f / HALF_WIDTH) / HALF_WIDTH
        return np.asarray(by_f[:, None] * self.kernels[nodes])

    def _function(self, parameters: FloatArray, nodes: slice | IntArray) -> FloatArray:
        return np.asarray(self.kernels[nodes] @ parameters + RESTING)


def _kernel_centres(half_side_m: float) -> tuple[FloatArray, float]:
    kernels_per_side = 9
    centres = np.linspace(-half_side_m, half_side_m, kernels_per_side)
    return centres, float(centres[1] - centres[0])

"""What stands in a tank: the network's objects, refined until they explain the readings.

    f(x) = sum_i mu_i p_i(x)                  Gaussians p_i on a grid
    h = H(f - 1/2) - H(-f - 1/2)              1 in what conducts better, -1 in what conducts worse
    minimise |e^s V(h(mu)) - v|^2 / k^2 + |mu - mu_0|^2 q + (s / s_0)^2       (Levenberg-Marquardt)

The network's image is where the fit starts, mu_0, and its prior: where readings say little the
network has the word, and no speck comes but that readings pay for it. With the scale s of the
readings free, its uncertainty is part of the fit's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.distance import cdist
from tactomo_models.arrays import FloatArray
from tactomo_models.scene.drawing import heaviside, heaviside_slope

from tactomo_lab.tanks.model import (
    PIXELS,
    LinearImages,
    Readings,
    TankModel,
    gaussian_grid,
    pixel_grid,
    probabilities,
    signed_image,
)

WIDTH = 0.096  # of a Gaussian over the radius
SPACING = 1.1  # of the grid, over that
HALF_WIDTH = 0.25  # of the edge, in f
PRECISION = 40.0  # q; 10 and 1e4 (the network alone) score 0.01 and 0.06 less on simulated tanks
# k = |(1, MODEL_ERROR rms(v))|: unit noise, and what the model gets wrong of the change itself.
MODEL_ERROR = 0.2
STEPS = 10
STEP_LIMIT = 0.6  # of a coefficient in one step
SETTLED = 3e-3  # share of the cost below which a gain is not worth another step


@dataclass(frozen=True)
class Tank:
    """What was found in a tank."""

    coefficients: FloatArray  # (K,) mu
    misfit: float  # root mean square of what is left of the readings, over the noise assumed


class TankFit:
    """Finds what stands in tanks that are read one way."""

    def __init__(self, model: TankModel, readings: Readings) -> None:
        self._model, self._readings = model, readings
        self.images = LinearImages(model, readings)
        structure = model.description.structure
        assert structure is not None
        self._log_contrast = np.log(structure.saturated_ratio)
        self._centres = gaussian_grid(SPACING * WIDTH, 1.0)
        self._kernels = self._gaussians(model.points)
        count = self._kernels.shape[1]
        ridge = 0.03 * np.eye(count)  # against coefficients of either sign that cancel
        self._onto = np.linalg.solve(self._kernels.T @ self._kernels + ridge, self._kernels.T)
        self._empty = readings.by_pair @ model.empty

    def _gaussians(self, points: FloatArray) -> FloatArray:
        return np.asarray(np.exp(cdist(points, self._centres, "sqeuclidean") / (-2 * WIDTH**2)))

    def find(
        self,
        changes: FloatArray,  # full minus empty, in the model's unit
        scale_sigma: float,  # s_0, standard deviation of that factor's logarithm
    ) -> Tank:
        """Find what explains readings' changes (n,), known but for a factor."""
        v = self._readings.reduced(changes)
        likely = probabilities(self.images.inputs(v[None]))[0]
        signed = signed_image(likely)(self._model.points[:, ::-1])
        start = self._onto @ np.clip(signed, -1, 1)
        return self._refined(v, np.append(start, 0.0), scale_sigma)

    def _refined(self, v: FloatArray, start: FloatArray, scale_sigma: float) -> Tank:
        noise = np.hypot(1, MODEL_ERROR * np.sqrt(np.mean(v**2)))
        precision = np.append(np.full(len(start) - 1, PRECISION), scale_sigma**-2)

        def judged(x: FloatArray) -> tuple[float, FloatArray, FloatArray, FloatArray]:
            conductivity = np.exp(self._model.nodes @ (self._log_contrast * self._share(x)))
            transfer, fields = self._model.solve(conductivity)
            shown = np.exp(x[-1]) * (self._readings.by_pair @ transfer - self._empty)
            left = np.append((shown - v) / noise, np.sqrt(precision) * (x - start))
            return float(left @ left), left, fields, conductivity

        x, (cost, left, fields, conductivity) = start, judged(start)
        damping = 1.0
        for _ in range(STEPS):
            slope = self._slopes(x, left[: len(v)], v, fields, conductivity, noise)
            jacobian = np.vstack([slope, np.diag(np.sqrt(precision))])
            normal, gradient = jacobian.T @ jacobian, jacobian.T @ left
            before = cost
            while damping < 1e5 and cost == before:
                step = -np.linalg.solve(normal + damping * np.eye(len(x)), gradient)
                step *= min(1.0, STEP_LIMIT / np.abs(step).max())
                trial = judged(x + step)
                if trial[0] < cost:
                    x, (cost, left, fields, conductivity) = x + step, trial
                    damping = max(damping / 5, 1e-2)
                else:
                    damping *= 6
            if before - cost < SETTLED * before:
                break
        misfit = float(np.sqrt(np.mean(left[: len(v)] ** 2)))
        return Tank(x[:-1], misfit)

    def _slopes(
        self,
        x: FloatArray,
        left: FloatArray,
        v: FloatArray,
        fields: FloatArray,
        conductivity: FloatArray,
        noise: float,
    ) -> FloatArray:
        """Derivative (r, K + 1) of what is left of the readings by coefficients and scale."""
        scale = np.exp(x[-1]) / noise
        by_triangle = self._model.derivative(self._readings.by_pair, fields) * conductivity
        f = self._kernels @ x[:-1]
        slope = sum(heaviside_slope((sign * f - 0.5) / HALF_WIDTH) for sign in (1, -1))
        by_node = (by_triangle @ self._model.nodes) * (self._log_contrast / HALF_WIDTH * slope)
        return np.column_stack([scale * (by_node @ self._kernels), left + v / noise])

    def _share(self, x: FloatArray) -> FloatArray:
        f = self._kernels @ x[:-1]
        return np.asarray(heaviside((f - 0.5) / HALF_WIDTH) - heaviside((-f - 0.5) / HALF_WIDTH))

    def image(self, tank: Tank, rows: int, columns: int) -> FloatArray:
        """Level-set function f on a picture's pixels (rows, columns), row 0 at the top.

        0.5 or more in objects that conduct better, -0.5 or less in those that conduct worse.
        """
        axis = np.linspace(-1, 1, 2 * PIXELS + 1)
        across, up = np.exp((axis[:, None] - self._centres.T[:, None]) ** 2 / (-2 * WIDTH**2))
        f = (up * tank.coefficients) @ across.T
        x, y, _ = pixel_grid(rows, columns)
        return np.asarray(RegularGridInterpolator((axis, axis), f)((y, x)))

    def likely(self, tank: Tank) -> FloatArray:
        """Shares (3, PIXELS, PIXELS) of nothing, worse and better, as `probabilities` has them."""
        f = self.image(tank, PIXELS, PIXELS)
        worse, better = (heaviside((sign * f - 0.5) / HALF_WIDTH) for sign in (-1, 1))
        return np.stack([1 - worse - better, worse, better])

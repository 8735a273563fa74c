"""Parametric level set: the outline of what presses, from the saturated channel.

The sheet has two phases, pressed and not. Their outline is the zero line of a sum of Gaussians,
and conductivity is sigma = exp(h(f) log c) with the phases' ratio c. The fit is nonlinear: the
forward model is solved for every trial, because at a ratio of 100 the paper's linear form
(equations 5 to 9) is far outside the range of its Jacobian.

    f(x) = sum_i mu_i p_i(x) - 1/2                  the paper, equation 7, with a resting value
    h(f) = 0 below -w, 1 above w, smooth between    a Heaviside of compact support
    minimise |W (d(mu, c) - d_measured)|^2 + alpha |mu|^2 by Levenberg-Marquardt

Because h is exactly 0 away from a contact, only nodes near it change and only the narrow band
where 0 < h < 1 has derivatives: both the solve and the Jacobian go by the pressed area.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tactomo_models.forward import ForwardModel, Solution

FloatArray = NDArray[np.float64]

KERNELS_PER_SIDE = 9
KERNEL_SPREAD = 0.7  # standard deviation of a Gaussian over the kernels' distance
HALF_WIDTH = 0.15  # w of the Heaviside
RESTING = -0.5  # f where nothing presses: below -HALF_WIDTH, so h is exactly 0
MOST_PRESSED = 1000  # nodes that one solve may change: some 50 ms, two fifths of a sheet
SETTLED = 1e-3  # share of the cost below which another gain is not worth a step
WORST_DAMPING = 1e6  # no step downhill even at this: a minimum
STEP_LIMIT = 0.5  # largest change of a coefficient in one step
RATIO_SPREAD = 0.3  # standard deviation of the log ratio over its nominal value
PRIOR = 0.3  # alpha: coefficients of contacts are of order 1


@dataclass(frozen=True)
class Shape:
    """An estimate of what is pressed.

    Attributes:
        mu: (K,) coefficients of the Gaussians.
        log_ratio: logarithm of the pressed over the bare conductivity.
        pressed: (P,) h at the pressable nodes, 0 to 1.
        solution: forward solution for it.
        residual: (M,) noise-weighted misfit of the data.
        cost: what is minimised, the prior included.
        damping: Levenberg-Marquardt damping that its last step got through with.
        converged: whether the last step changed next to nothing.
    """

    mu: FloatArray
    log_ratio: float
    pressed: FloatArray
    solution: Solution
    residual: FloatArray
    cost: float
    damping: float = 1.0
    converged: bool = False

    @property
    def misfit(self) -> float:
        """Root mean square of the noise-weighted residual; about 1 where the model explains all."""
        return float(np.sqrt(np.mean(self.residual**2)))


class LevelSet:
    """Level-set fit of one channel.

    Args:
        forward: the model of the sheet.
        ratio: conductivity of the saturated phase over the bare sheet's: where its estimate
            starts and what it stays near.
    """

    def __init__(self, forward: ForwardModel, ratio: float) -> None:
        self.forward = forward
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
        self.nominal = float(np.log(ratio))
        self._ratio_sigma = RATIO_SPREAD * abs(self.nominal)
        self._least_ratio, self._most_ratio = sorted((0.1 * self.nominal, 1.5 * self.nominal))

    def start(self, likeness: FloatArray, data: FloatArray, weight: FloatArray) -> Shape | None:
        """Turn an image (P,) that is 0 where nothing presses and 1 inside contacts into a start.

        None where it covers too much of the sheet to be solved in time.
        """
        f = np.clip(2 * likeness - 1, RESTING, -RESTING)
        mu = self._projection @ (f - RESTING)
        # Gaussians round off small contacts; a start that presses nothing has no derivative.
        mu *= -2 * RESTING / max(float((self.kernels @ mu).max()), 1e-6)
        return self.evaluate(mu, self.nominal, data, weight)

    def function(self, shape: Shape) -> FloatArray:
        """Level-set function f (P,) of an estimate."""
        return np.asarray(self.kernels @ shape.mu + RESTING)

    def compare(self, shape: Shape, data: FloatArray, weight: FloatArray) -> Shape:
        """Hold an estimate against other data, without a solve."""
        judged = self._judged(
            shape.mu, shape.log_ratio, shape.pressed, shape.solution, data, weight
        )
        return replace(judged, damping=1.0 if shape.converged else shape.damping)

    def nothing(self, data: FloatArray, weight: FloatArray) -> Shape:
        """Estimate that nothing is pressed."""
        none = np.zeros(self.kernels.shape[1])
        shape = self.evaluate(none, self.nominal, data, weight)
        assert shape is not None
        return shape

    def evaluate(
        self, mu: FloatArray, log_ratio: float, data: FloatArray, weight: FloatArray
    ) -> Shape | None:
        """Solve the forward model for given coefficients and compare it with the data.

        None where so much would be pressed that no deadline could be kept.
        """
        f = self.kernels @ mu + RESTING
        if np.count_nonzero(f > -HALF_WIDTH) > MOST_PRESSED:
            return None
        pressed = heaviside(f)
        change = np.expm1(pressed * log_ratio)
        solution = self.forward.solve(change, also=np.abs(f) < HALF_WIDTH)
        return self._judged(mu, log_ratio, pressed, solution, data, weight)

    def _judged(
        self,
        mu: FloatArray,
        log_ratio: float,
        pressed: FloatArray,
        solution: Solution,
        data: FloatArray,
        weight: FloatArray,
    ) -> Shape:
        bare = self.forward.bare_voltages
        residual = weight * ((solution.voltages - bare) / np.abs(bare) - data)
        off = (log_ratio - self.nominal) / self._ratio_sigma
        cost = residual @ residual + PRIOR * (mu @ mu) + off**2
        return Shape(mu, log_ratio, pressed, solution, residual, float(cost))

    def jacobian(self, shape: Shape, weight: FloatArray) -> FloatArray:
        """Derivative of the weighted residual by the coefficients and the log ratio: (M, K + 1)."""
        f = self.function(shape)
        slope = heaviside_slope(f)
        moved = np.flatnonzero((slope > 0) | (shape.pressed > 0))
        pressed = shape.pressed[moved]
        by_node = self.forward.jacobian(shape.solution, moved)
        by_node *= (weight / np.abs(self.forward.bare_voltages))[:, None]
        sigma = np.exp(pressed * shape.log_ratio)
        by_f = by_node * (shape.log_ratio * sigma * slope[moved])
        by_ratio = by_node @ (sigma * pressed)
        return np.hstack([by_f @ self.kernels[moved], by_ratio[:, None]])

    def refine(
        self,
        shape: Shape,
        data: FloatArray,
        weight: FloatArray,
        budget_s: float,
        good_enough: float,
    ) -> Shape:
        """Improve an estimate by Levenberg-Marquardt.

        Args:
            shape: where to start; its residual must belong to the same data.
            data: (M,) relative voltage changes.
            weight: (M,) inverse standard deviations of the data, model error included.
            budget_s: compute time after which no further step is begun, by a model of the work
                (see `_work_s`); one step is always tried.
            good_enough: misfit at which the data are explained to their noise (discrepancy
                principle): no further step is taken.
        """
        while shape.misfit > good_enough:
            normal, gradient = self._normal_equations(shape, weight)
            budget_s -= _work_s(shape)
            better, budget_s = self._step(shape, normal, gradient, data, weight, budget_s)
            gain = shape.cost - better.cost
            # No gain because the budget ended says nothing about a minimum.
            settled = 0 < gain < SETTLED * shape.cost or better.damping >= WORST_DAMPING
            shape = replace(better, converged=settled)
            if settled or budget_s <= 0:
                return shape
        return replace(shape, converged=True)

    def _normal_equations(self, shape: Shape, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        J = self.jacobian(shape, weight)
        prior = np.append(np.full(len(shape.mu), PRIOR), self._ratio_sigma**-2)
        offset = np.append(shape.mu, shape.log_ratio - self.nominal)
        return J.T @ J + np.diag(prior), J.T @ shape.residual + prior * offset

    def _step(
        self,
        shape: Shape,
        normal: FloatArray,
        gradient: FloatArray,
        data: FloatArray,
        weight: FloatArray,
        budget_s: float,
    ) -> tuple[Shape, float]:
        """Damp until a step leads downhill: the better shape, or the old one, and what is left."""
        damping = shape.damping
        while damping < WORST_DAMPING:
            step = -np.linalg.solve(normal + damping * np.eye(len(normal)), gradient)
            step *= min(1.0, STEP_LIMIT / max(np.abs(step[:-1]).max(), 1e-12))
            ratio = float(np.clip(shape.log_ratio + step[-1], self._least_ratio, self._most_ratio))
            trial = self.evaluate(shape.mu + step[:-1], ratio, data, weight)
            budget_s -= _work_s(trial) if trial else 0.0
            if trial is not None and trial.cost < shape.cost:
                return replace(trial, damping=max(damping / 5, 1e-3)), budget_s
            damping *= 5
            if budget_s <= 0:
                break
        return replace(shape, damping=damping), budget_s


def _work_s(shape: Shape) -> float:
    """Seconds that a solve or a Jacobian of this size takes on a core of the 2.5 GHz class.

    A model and not a clock: the steps taken, and so the maps, must not depend on how busy the
    machine was.
    """
    nodes = len(shape.solution.nodes)
    return 0.001 + 6e-6 * nodes + 3e-11 * nodes**3


def heaviside(f: FloatArray) -> FloatArray:
    """Smoothed step of compact support: 0 below -w, 1 above w."""
    t = np.clip(f / HALF_WIDTH, -1, 1)
    # Rounding must not leave a trace of 1e-17 outside the support: every such node would be solved.
    return np.where(t > -1, 0.5 * (1 + t + np.sin(np.pi * t) / np.pi), 0.0)


def heaviside_slope(f: FloatArray) -> FloatArray:
    """Derivative of `heaviside`."""
    t = np.clip(f / HALF_WIDTH, -1, 1)
    return np.asarray((1 + np.cos(np.pi * t)) / (2 * HALF_WIDTH))


def _kernel_centres(half_side_m: float) -> tuple[FloatArray, float]:
    centres = np.linspace(-half_side_m, half_side_m, KERNELS_PER_SIDE)
    return centres, float(centres[1] - centres[0])

"""Fitting shapes: which parameters of a shape explain the saturated channel's voltages.

The sheet has two phases, pressed and not; a shape says how far each node is pressed, h from 0 to
1, and its conductivity is sigma = exp(h log c) with the phases' ratio c. The fit is nonlinear: the
forward model is solved for every trial, because at a ratio of 100 the paper's linear form
(equations 5 to 9) is far outside the range of its Jacobian.

    minimise |W (d(p, c) - d_measured)|^2 + |(p - p0) / prior|^2      by Levenberg-Marquardt

What a shape is, is a family's matter: a few outlines (`outlines`), or a level set (`levelset`).
In both, h is exactly 0 away from contacts, so that only nodes near them change, and only the
narrow band where 0 < h < 1 has derivatives: solve and Jacobian go by the pressed area.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.physics.forward import ForwardModel, Solution
from tactomo_models.scans.changes import Changes

MAX_PRESSED = 1000  # nodes that one solve may change: some 5 ms, two fifths of a sheet
SETTLED = 5e-3  # share of the cost below which another gain is not worth a step
WORST_DAMPING = 1e6  # no step downhill even at this: a minimum
STEP_LIMIT = 0.5  # largest change of a parameter in one step


class Family(Protocol):
    """A way of describing shapes by n parameters of order 1."""

    @property
    def prior_mean(self) -> FloatArray:
        """(n,) what is likely."""

    @property
    def prior_precision(self) -> FloatArray:
        """(n,) inverse variances of that."""

    @property
    def ratio_freedom(self) -> float:
        """How far the log ratio may stray from what is likely: 1 as far as is known of it."""

    def bounded(self, parameters: FloatArray) -> FloatArray:
        """Bring parameters (n,) back to where they mean something."""

    def render(self, parameters: FloatArray) -> tuple[FloatArray, BoolArray]:
        """(P,) h as the mesh needs it, and where it is not 0 or may become so."""

    def coverage(self, parameters: FloatArray) -> FloatArray:
        """(P,) share pressed, for people to look at."""

    def slope(self, parameters: FloatArray, nodes: IntArray) -> FloatArray:
        """Derivative (k, n) of h at k nodes by the parameters."""


@dataclass(frozen=True)
class Shape:
    """An estimate of what is pressed.

    Attributes:
        family: what its parameters mean.
        parameters: (n,) of the family.
        log_ratio: logarithm of the pressed over the bare conductivity.
        pressed: (P,) h at the pressable nodes, 0 to 1, as the mesh needs it.
        moving: (n,) nodes where h is not 0 or may become so.
        solution: forward solution for it.
        residual: (M,) noise-weighted misfit of the data.
        cost: what is minimised, the prior included.
        damping: Levenberg-Marquardt damping that its last step got through with.
        jacobian: (M, n + 1) that its last step was made with; None before any.
        converged: whether the last step changed next to nothing.
    """

    family: Family
    parameters: FloatArray
    log_ratio: float
    pressed: FloatArray
    moving: IntArray
    solution: Solution
    residual: FloatArray
    cost: float
    damping: float = 1.0
    jacobian: FloatArray | None = None
    converged: bool = False

    @property
    def coverage(self) -> FloatArray:
        """(P,) share pressed, without what the mesh needs drawn differently."""
        return self.family.coverage(self.parameters)

    @property
    def misfit(self) -> float:
        """Root mean square of the noise-weighted residual; about 1 where the model explains all."""
        return float(np.sqrt(np.mean(self.residual**2)))


class Budget:
    """Compute time that is left, by a model of the work on a core of the 2.5 GHz class.

    A model and not a clock: the steps taken, and so the maps, must not depend on how busy the
    machine was.

    Attributes:
        left_s: seconds left.
    """

    def __init__(self, seconds: float) -> None:
        self.left_s = seconds

    @property
    def over(self) -> bool:
        """Whether nothing more should be begun."""
        return self.left_s <= 0

    def spend(self, shape: Shape) -> None:
        """Take off what a solve or a Jacobian of this size costs."""
        nodes = len(shape.solution.nodes)
        self.left_s -= 0.0007 + 2.5e-6 * nodes + 2e-12 * nodes**3  # see tactomo evaluate solves


class ShapeFit:
    """Fit of shapes to one channel.

    Args:
        forward: the model of the sheet.
        ratio: conductivity of the saturated phase over the bare sheet's.
    """

    def __init__(self, forward: ForwardModel, ratio: float) -> None:
        self.forward = forward
        saturated = float(np.log(ratio))
        # Most contacts reach something between a tenth of saturation and all of it.
        self.likely = saturated - np.sign(saturated) * np.log(10) / 2
        self._ratio_sigma = np.log(10) / np.sqrt(12)
        self._least_ratio, self._most_ratio = sorted((0.1 * saturated, 1.5 * saturated))

    def compare(self, shape: Shape, measured: Changes) -> Shape:
        """Hold an estimate against other data, without a solve."""
        judged = self._judged(
            shape.family,
            shape.parameters,
            shape.log_ratio,
            shape.pressed,
            shape.moving,
            shape.solution,
            measured,
        )
        damping = 1.0 if shape.converged else shape.damping
        return replace(judged, damping=damping, jacobian=shape.jacobian)

    def evaluate(
        self,
        family: Family,
        parameters: FloatArray,
        log_ratio: float,
        measured: Changes,
        most_pressed: int = MAX_PRESSED,
    ) -> Shape | None:
        """Solve the forward model for given parameters and compare it with the data.

        None where so much would be pressed that no deadline could be kept.
        """
        pressed, may_move = family.render(parameters)
        moving = np.flatnonzero(may_move)
        if len(moving) > most_pressed:
            return None
        change = conductivity(pressed, log_ratio)[0] - 1
        solution = self.forward.solve(change, mix_resistivities=log_ratio > 0)
        return self._judged(family, parameters, log_ratio, pressed, moving, solution, measured)

    def _judged(
        self,
        family: Family,
        parameters: FloatArray,
        log_ratio: float,
        pressed: FloatArray,
        moving: IntArray,
        solution: Solution,
        measured: Changes,
    ) -> Shape:
        bare = self.forward.bare_voltages
        predicted = (solution.voltages - bare) / np.abs(bare)
        residual = measured.weight * (predicted - measured.change)
        off = (log_ratio - self.likely) / (family.ratio_freedom * self._ratio_sigma)
        away = family.prior_precision @ (parameters - family.prior_mean) ** 2
        cost = residual @ residual + away + off**2
        return Shape(
            family, parameters, log_ratio, pressed, moving, solution, residual, float(cost)
        )

    def jacobian(self, shape: Shape, weight: FloatArray) -> FloatArray:
        """Derivative of the weighted residual by the parameters and the log ratio: (M, n + 1)."""
        moved = shape.moving
        _, by_pressed, by_log_ratio = conductivity(shape.pressed[moved], shape.log_ratio)
        slope = by_pressed[:, None] * shape.family.slope(shape.parameters, moved)
        onto = np.hstack([slope, by_log_ratio[:, None]])
        by_parameter = self.forward.jacobian(shape.solution, moved, onto)
        return by_parameter * (weight / np.abs(self.forward.bare_voltages))[:, None]

    def refine(
        self,
        shape: Shape,
        measured: Changes,
        budget: Budget,
        good_enough: float,
        steps: int = 100,
    ) -> Shape:
        """Improve an estimate by Levenberg-Marquardt.

        Args:
            shape: where to start; its residual must belong to the same data.
            measured: the data.
            budget: work after which no further step is begun; one step is always tried.
            good_enough: misfit at which the data are explained to their noise (discrepancy
                principle): no further step is taken.
            steps: no more than these.
        """
        for _ in range(steps):
            if shape.misfit <= good_enough:
                return replace(shape, converged=True)
            budget.spend(shape)
            better = self._step(shape, measured, budget)
            gain = shape.cost - better.cost
            # No gain because the budget ended says nothing about a minimum.
            settled = 0 < gain < SETTLED * shape.cost or better.damping >= WORST_DAMPING
            shape = replace(better, converged=settled)
            if settled or budget.over:
                break
        return shape

    def covariance(self, shape: Shape, measured: Changes) -> FloatArray:
        """Covariance (n, n) of a shape's parameters; larger where it leaves data unexplained.

        Args:
            shape: the shape.
            measured: the data that it explains.
        """
        J = shape.jacobian
        if J is None:
            J = self.jacobian(shape, measured.weight)
        prior = np.diag(self._prior(shape)[0])
        inverse = np.linalg.inv(J.T @ J + prior)
        covariance = inverse @ (J.T @ (measured.variance_inflation[:, None] * J) + prior) @ inverse
        return np.asarray(covariance[:-1, :-1] * max(1.0, shape.misfit**2))

    def _prior(self, shape: Shape) -> tuple[FloatArray, FloatArray]:
        """Inverse variances (n + 1,) of parameters and log ratio, and their offsets from it."""
        ratio_sigma = shape.family.ratio_freedom * self._ratio_sigma
        precision = np.append(shape.family.prior_precision, ratio_sigma**-2)
        mean = np.append(shape.family.prior_mean, self.likely)
        return precision, np.append(shape.parameters, shape.log_ratio) - mean

    def _step(
        self,
        shape: Shape,
        measured: Changes,
        budget: Budget,
    ) -> Shape:
        """Damp until a step leads downhill: the better shape, or the old one."""
        J = self.jacobian(shape, measured.weight)
        precision, offset = self._prior(shape)
        normal = J.T @ J + np.diag(precision)
        gradient = J.T @ shape.residual + precision * offset
        damping = shape.damping
        while damping < WORST_DAMPING:
            step = -np.linalg.solve(normal + damping * np.eye(len(normal)), gradient)
            step *= min(1.0, STEP_LIMIT / max(np.abs(step[:-1]).max(), 1e-12))
            ratio = float(np.clip(shape.log_ratio + step[-1], self._least_ratio, self._most_ratio))
            parameters = shape.family.bounded(shape.parameters + step[:-1])
            trial = self.evaluate(shape.family, parameters, ratio, measured)
            if trial is not None:
                budget.spend(trial)
                if trial.cost < shape.cost:
                    return replace(trial, damping=max(damping / 5, 1e-3), jacobian=J)
            damping *= 5
            if budget.over:
                break
        return replace(shape, damping=damping)


def conductivity(
    pressed: FloatArray, log_ratio: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Relative conductivity, and its derivatives by h and by the log ratio, each of h's shape.

    Across an edge the phase that conducts worse decides: resistivities mix in proportion where
    contacts conduct better than the sheet, conductivities where they conduct worse. The outline
    then stands where the voltages put it, whatever the ratio. Where h is negative (`objects`) the
    ratio is turned over.
    """
    share, worse = np.abs(pressed), np.where(pressed < 0, log_ratio > 0, log_ratio < 0)
    least = np.exp(-abs(log_ratio))
    mixed = 1 - share + share * least
    sigma = np.where(worse, mixed, 1 / mixed)
    by_mixed = np.where(worse, 1.0, -(sigma**2))
    by_h = by_mixed * (least - 1) * np.where(pressed < 0, -1.0, 1.0)
    return sigma, by_h, by_mixed * share * least * -np.sign(log_ratio)


def heaviside(t: FloatArray) -> FloatArray:
    """Smoothed step of compact support: 0 below -1, 1 above 1."""
    t = np.clip(t, -1, 1)
    # Rounding must not leave a trace of 1e-17 outside the support: every such node would be solved.
    return np.where(t > -1, 0.5 * (1 + t + np.sin(np.pi * t) / np.pi), 0.0)


def heaviside_slope(t: FloatArray) -> FloatArray:
    """Derivative of `heaviside`."""
    return np.asarray((1 + np.cos(np.pi * np.clip(t, -1, 1))) / 2)

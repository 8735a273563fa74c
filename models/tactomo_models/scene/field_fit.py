"""Fitting a pressure field: which of its parameters explain the voltages of all sheets together.

Each sheet's response turns the same pressure into that sheet's conductivity. The fit is nonlinear:
the forward model is solved for every trial, because at a ratio of 100 the paper's linear form
(equations 5 to 9) is far outside the range of its Jacobian.

    minimise sum_s |W_s (d_s(p, c) - measured_s)|^2 + sum_k ((w_k . p - F_k) / sigma_k)^2
           + |(p - p0) / prior|^2   (Levenberg-Marquardt)

A companion such as a load cell feels the force w . p and reads F: one row.
What the parameters mean is a family's matter: a few contacts (`pressure_field`), or a level set.
In both, nothing is pressed away from contacts, so that only nodes near them change: solve and
Jacobian go by the pressed area.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.physics.compiled_sheet import Pressed, Solution
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scans.changes import Changes
from tactomo_models.scans.companion_forces import SheetsAndCompanions
from tactomo_models.scene.drawing import Drawing, Slopes
from tactomo_models.scene.parameters import PEAK
from tactomo_models.scene.pressure_field import PressureField
from tactomo_models.scene.sheet_response import SheetResponse, responses_of
from tactomo_models.sensor.description import SensorDescription

SETTLED = 5e-3  # share of the cost below which another gain is not worth a step
# The same, as the last step's Jacobian predicts it. With 5e-3 another 5 % of the work is saved, but
# one of 36 scenes then goes another way, at a correlation lower by 0.13.
PREDICTED = 1e-3
# Processor time on a quiet core of the 2.5 GHz class, by least squares over frames of all kinds of
# scenes, to 22 %. Measured on a busy core, divided by 1.3: by so much cold frames took longer than
# on a quiet one.
COLD_S = 5e-3  # a frame that starts cold, beside its steps: network, account
SHEET_S = 1.6e-4  # a step on one sheet
ENTRY_S = 3.7e-8  # the same, for each node that is pressed and each parameter
MAX_DAMPING = 1e6  # no step downhill even at this: a minimum
STEP_LIMIT = 0.5  # largest change of a parameter in one step

Measured = Mapping[Channel, Changes]


class Family(Protocol):
    """A way of describing what presses by N parameters of order 1."""

    @property
    def prior_mean(self) -> FloatArray:
        """(N,) what is likely."""

    @property
    def prior_precision(self) -> FloatArray:
        """(N,) inverse variances of that."""

    def bounded(self, parameters: FloatArray) -> FloatArray:
        """Bring parameters (N,) back to where they mean something."""

    def draw(self, parameters: FloatArray) -> Drawing:
        """What is pressed."""


@dataclass(frozen=True)
class FittedField:
    """An estimate of what presses."""

    family: Family  # what its parameters mean
    parameters: FloatArray  # (N,) of the family
    log_ratio: float  # logarithm of the structure sheet's pressed over its bare conductivity
    drawing: Drawing  # the field on the nodes
    solutions: Mapping[Channel, Solution] = field(repr=False)  # each sheet's forward solution
    # each sheet's (M,) noise-weighted misfit of the data
    residuals: Mapping[Channel, FloatArray] = field(repr=False)
    cost: float  # what is minimised, the prior included
    # (N + 1,) inverse variances of parameters and log ratio, and their offsets from what is likely
    prior: tuple[FloatArray, FloatArray] = field(repr=False)
    damping: float = 1.0  # Levenberg-Marquardt damping that its last step got through with
    # (K,) of companions, likewise weighted
    companion_residuals: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)
    # (sum M + K, N + 1) that its last step was made with; None before any
    jacobian: FloatArray | None = field(default=None, repr=False)
    converged: bool = False  # whether the last step changed next to nothing

    @cached_property
    def residual(self) -> FloatArray:
        """(sum M + K,) noise-weighted misfit of all sheets' data, and of companions."""
        return np.concatenate([*self.residuals.values(), self.companion_residuals])

    @cached_property
    def misfit(self) -> float:
        """Root mean square of the noise-weighted residual; about 1 where the model explains all."""
        return _root_mean_square(self.residual)

    @cached_property
    def worst_misfit(self) -> float:
        """The misfit of the sheet that is explained worst."""
        return max(self.misfit_of(name) for name in self.residuals)

    def misfit_of(self, channel: Channel) -> float:
        """The same of one sheet."""
        return _root_mean_square(self.residuals[channel])


@dataclass(frozen=True)
class Step:
    """What another drawing changes, as far as the Jacobian predicts it."""

    residual: FloatArray  # (sum M + K,) added to the weighted residual
    by_parameters: FloatArray  # (sum M + K, N) derivative by the drawing's free parameters
    by_ratio: FloatArray  # (sum M + K,) added to the derivative by the log ratio


class Budget:
    """Compute time that is left, by a model of the work on a core of the 2.5 GHz class.

    A model and not a clock: the steps taken, and so the maps, must not depend on how busy the
    machine was.
    """

    def __init__(self, seconds: float) -> None:
        self.left_s = seconds  # seconds left

    @property
    def over(self) -> bool:
        """Whether nothing more should be begun."""
        return self.left_s <= 0

    def spend(self, fitted: FittedField) -> None:
        """Take off what a solve or a Jacobian of this size costs, on every sheet."""
        for solution in fitted.solutions.values():
            self.left_s -= SHEET_S + ENTRY_S * len(solution.nodes) * len(fitted.parameters)


class FieldFit:
    """Fit of a pressure field to all sheets of a sensor.

    Args:
        forward: the model of the sheets.
        description: the sensor; that of `forward` if None.
        sheets: each sheet as it is, where the tare has told; the even one elsewhere.

    Attributes:
        likely: logarithm of the structure sheet's ratio, as likely as any.
    """

    def __init__(
        self,
        forward: ForwardModel,
        description: SensorDescription | None = None,
        sheets: Mapping[Channel, ForwardModel] | None = None,
    ) -> None:
        description = description or forward.description
        self.forward = forward  # the model of an even sheet
        self.responses: dict[Channel, SheetResponse] = responses_of(description)  # of each sheet
        self._sheets = sheets or {}
        saturated = np.log(10.0)
        if description.structure is not None:
            saturated = float(np.log(description.structure.saturated_ratio))
        # Most contacts reach something between a tenth of saturation and all of it.
        self.likely = float(saturated - np.sign(saturated) * np.log(10) / 2)
        if abs(saturated) < np.log(10):
            self.likely = saturated / 2
        self._ratio_sigma = np.log(10) / np.sqrt(12)
        self._least_ratio, self._most_ratio = sorted((0.1 * saturated, 1.5 * saturated))

    def sheet(self, name: Channel) -> ForwardModel:
        """The model of a channel's sheet: as it is, or an even one."""
        return self._sheets.get(name, self.forward)

    def compare(self, fitted: FittedField, measured: Measured) -> FittedField:
        """Hold an estimate against other data, without a solve.

        Sheets that the estimate has not solved are solved.
        """
        if measured.keys() - fitted.solutions.keys():
            return self.evaluate(
                fitted.family,
                fitted.parameters,
                fitted.log_ratio,
                measured,
                solved=fitted.solutions,
            )
        return self._judged(
            fitted.family,
            fitted.parameters,
            fitted.log_ratio,
            fitted.drawing,
            *self._compared(fitted, measured),
            measured,
            damping=1.0 if fitted.converged else fitted.damping,
        )

    def evaluate(
        self,
        family: Family,
        parameters: FloatArray,
        log_ratio: float,
        measured: Measured,
        solved: Mapping[Channel, Solution] | None = None,
    ) -> FittedField:
        """Solve the forward model for given parameters and compare it with the data.

        Sheets that are `solved` for these very contacts and ratio are not solved again.
        """
        drawing = family.draw(parameters)
        solutions: dict[Channel, Solution] = {}
        residuals: dict[Channel, FloatArray] = {}
        for name, changes in measured.items():
            if solved and name in solved:
                solutions[name] = solved[name]
                residuals[name] = self._residual(name, solved[name], changes)
                continue
            pressed = self._pressed(name, drawing, log_ratio)
            made = self.sheet(name).evaluate(pressed, changes.compiled)
            solutions[name], residuals[name] = made
        return self._judged(family, parameters, log_ratio, drawing, solutions, residuals, measured)

    def _pressed(self, name: Channel, drawing: Drawing, log_ratio: float) -> Pressed:
        """What presses on a sheet, as the sheet sees it."""
        response = self.responses[name]
        share, pressure = map(_for_c, _seen_by(name, _drawn(drawing)))
        exponent = response.exponent(log_ratio)
        return Pressed(drawing.nodes, share, pressure, log_ratio, response.compiled, exponent)

    def _residual(self, name: Channel, solution: Solution, changes: Changes) -> FloatArray:
        bare = self.sheet(name).bare_voltages
        change = (solution.voltages - bare) / np.abs(bare)
        return changes.weighted(change - changes.change)

    def _judged(
        self,
        family: Family,
        parameters: FloatArray,
        log_ratio: float,
        drawing: Drawing,
        solutions: Mapping[Channel, Solution],
        residuals: Mapping[Channel, FloatArray],
        measured: Measured,
        damping: float = 1.0,
    ) -> FittedField:
        precision, offset = self.prior(family, parameters, log_ratio)
        felt = np.zeros(0)
        if isinstance(measured, SheetsAndCompanions):
            weights, readings = measured.rows
            felt = _felt(weights, drawing) - readings
        cost = sum(each @ each for each in residuals.values()) + felt @ felt
        cost += precision @ offset**2
        return FittedField(
            family,
            parameters,
            log_ratio,
            drawing,
            solutions,
            residuals,
            float(cost),
            (precision, offset),
            damping,
            companion_residuals=felt,
        )

    def _compared(
        self, fitted: FittedField, measured: Measured
    ) -> tuple[dict[Channel, Solution], dict[Channel, FloatArray]]:
        """Solutions and residuals (M,) of the sheets that were measured."""
        solutions = {name: fitted.solutions[name] for name in measured}
        return solutions, {
            name: self._residual(name, solutions[name], changes)
            for name, changes in measured.items()
        }

    def jacobian(
        self,
        fitted: FittedField,  # where to differentiate
        measured: Measured,  # the data
        # the same field with other parameters free; that of `fitted` if None
        drawing: Drawing | None = None,
    ) -> FloatArray:
        """Derivative of the weighted residual by the parameters and the log ratio.

        Returns:
            (sum M + K, N + 1), with K companions.
        """
        drawing = drawing or fitted.drawing
        slopes = drawing.slopes()
        sheets = []
        for name, changes in measured.items():
            by_share, by_pressure = _seen_by(name, slopes)
            by_parameter = self.sheet(name).slopes(
                fitted.solutions[name],
                self._pressed(name, drawing, fitted.log_ratio),
                changes.compiled,
                _for_c(by_share),
                _for_c(by_pressure),
            )
            sheets.append(by_parameter)
        if isinstance(measured, SheetsAndCompanions):
            sheets.append(_felt_slopes(measured.rows[0], drawing))
        return np.concatenate(sheets)

    def jacobian_at_onset(self, fitted: FittedField, measured: Measured) -> FloatArray:
        """The same (M, N + 1) of the graded sheet, with light contacts at the onset: what answers.

        Raises:
            TypeError: it is no pressure field.
        """
        family = fitted.family
        if not isinstance(family, PressureField):
            raise TypeError("only contacts of a pressure field have an onset")
        each = family.split(fitted.parameters)
        each[family.light(fitted.parameters), PEAK] = family.onset
        graded = {Channel.MAGNITUDE: measured[Channel.MAGNITUDE]}
        return self.jacobian(fitted, graded, family.draw(family.join(each)))

    def steps_to(
        self, fitted: FittedField, others: Sequence[Drawing], measured: Measured
    ) -> list[Step]:
        """Predict what each of other drawings changes, from the fitted field and without a solve.

        The voltages go by the nodes' conductivities as the Jacobian has it, but a step from c to c'
        counts as that of a small disc, 2 c (c' - c) / (c' + c): in one that conducts well there is
        little field (Ammari & Kang, Springer 2004, polarisation tensors).
        """
        counts = [2 + other.slopes()[0].shape[1] for other in others]
        ends = np.cumsum(counts)
        drawings = [fitted.drawing, *others]
        nodes = np.unique(np.concatenate([each.nodes for each in drawings]))
        rows = [np.searchsorted(nodes, each.nodes) for each in drawings]
        sizes = [len(each) for each in rows[1:]]
        places = np.concatenate(rows[1:]), np.repeat(np.arange(len(others)), sizes)
        sheets = []
        for name, changes in measured.items():
            sheet = self.sheet(name)
            before, by_ratio = np.ones((len(nodes), 1)), np.zeros((len(nodes), 1))
            before[rows[0], 0], _, by_ratio[rows[0], 0] = self._conducting(
                name, [fitted.drawing], fitted.log_ratio
            )
            after = np.ones((len(nodes), len(others)))
            by_ratio_after = np.zeros_like(after)
            found = self._conducting(name, others, fitted.log_ratio)
            after[places], by_each, by_ratio_after[places] = found
            factor = 2 * before / (before + after)
            by_each *= factor[places] ** 2
            columns = np.zeros((len(nodes), sum(counts)))
            columns[:, ends - counts] = factor * (after - before)
            columns[:, ends - 1] = factor**2 * by_ratio_after - by_ratio
            of_each = np.split(by_each, np.cumsum(sizes)[:-1], axis=1)
            for other, at, by, end, count in zip(
                others, rows[1:], of_each, ends, counts, strict=True
            ):
                by_share, by_pressure = _seen_by(name, other.slopes())
                into = by[0][:, None] * by_share + by[1][:, None] * by_pressure
                columns[at, end - count + 1 : end - 1] = into
            moved = columns.any(axis=1)
            where = nodes[moved]
            onto = sheet.at_rest[where, None] * columns[moved]
            voltages = sheet.jacobian(fitted.solutions[name], where, onto)
            sheets.append(changes.weighted(voltages / np.abs(sheet.bare_voltages)[:, None]))
        if isinstance(measured, SheetsAndCompanions):
            weights = measured.rows[0]
            before = _felt(weights, fitted.drawing)
            felt = [
                np.column_stack([_felt(weights, other) - before, _felt_slopes(weights, other)])
                for other in others
            ]
            sheets.append(np.hstack(felt))
        return [
            Step(each[:, 0], each[:, 1:-1], each[:, -1])
            for each in np.split(np.concatenate(sheets), ends[:-1], axis=1)
        ]

    def _conducting(
        self, name: Channel, drawings: Sequence[Drawing], log_ratio: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Conductivity ratios (n,), slopes (2, n) by share and pressure, (n,) by the log ratio.

        Of all drawings' nodes, one drawing after the other.
        """
        of_each = (_seen_by(name, _drawn(drawing)) for drawing in drawings)
        share, pressure = (np.concatenate(each) for each in zip(*of_each, strict=True))
        response = self.responses[name].compiled
        found, slopes = response.conductivity(share, pressure, log_ratio)
        return found, slopes[:2], slopes[2]

    def refine(
        self,
        fitted: FittedField,  # where to start; its residuals must belong to the same data
        measured: Measured,  # the data
        budget: Budget,  # work after which no further step is begun; one step is always tried
        # misfit at which the data are explained to their noise (discrepancy principle): no further
        # step is taken
        good_enough: float,
        steps: int = 100,  # no more than these
    ) -> FittedField:
        """Improve an estimate by Levenberg-Marquardt."""
        for _ in range(steps):
            if fitted.misfit <= good_enough:
                return replace(fitted, converged=True)
            budget.spend(fitted)
            better = self._step(fitted, measured, budget)
            gain = fitted.cost - better.cost
            # No gain because the budget ended says nothing about a minimum.
            settled = 0 < gain < SETTLED * fitted.cost or better.damping >= MAX_DAMPING
            if gain > 0 and not settled:
                assert better.jacobian is not None
                left = predicted_gain(*self.normal_equations(better, better.jacobian))
                settled = left < PREDICTED * better.cost
            fitted = replace(better, converged=settled)
            if settled or budget.over:
                break
        return fitted

    def normal_equations(self, fitted: FittedField, J: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Matrix (N + 1, N + 1) and gradient (N + 1,) of half the linearised cost."""
        precision, offset = fitted.prior
        normal = J.T @ J
        _diagonal(normal)[:] += precision
        return normal, J.T @ fitted.residual + precision * offset

    def bounded_ratio(self, log_ratio: float) -> float:
        """A log ratio brought back to where it means something."""
        return float(min(max(log_ratio, self._least_ratio), self._most_ratio))

    def prior(
        self, family: Family, parameters: FloatArray, log_ratio: float
    ) -> tuple[FloatArray, FloatArray]:
        """Inverse variances (N + 1,) of parameters (N,) and log ratio, and offsets from it."""
        precision, offset = np.empty((2, len(parameters) + 1))
        precision[:-1], precision[-1] = family.prior_precision, self._ratio_sigma**-2
        offset[:-1], offset[-1] = parameters - family.prior_mean, log_ratio - self.likely
        return precision, offset

    def _step(self, fitted: FittedField, measured: Measured, budget: Budget) -> FittedField:
        """Damp until a step leads downhill: the better estimate, or the old one."""
        J = self.jacobian(fitted, measured)
        normal, gradient = self.normal_equations(fitted, J)
        damping = fitted.damping
        while damping < MAX_DAMPING:
            step = bounded_step(normal, gradient, damping)
            ratio = self.bounded_ratio(fitted.log_ratio + step[-1])
            parameters = fitted.family.bounded(fitted.parameters + step[:-1])
            trial = self.evaluate(fitted.family, parameters, ratio, measured)
            budget.spend(trial)
            if trial.cost < fitted.cost:
                return replace(trial, damping=max(damping / 5, 1e-3), jacobian=J)
            damping *= 5
            if budget.over:
                break
        return replace(fitted, damping=damping)


def predicted_gain(normal: FloatArray, gradient: FloatArray) -> float:
    """What further steps would gain in cost, by normal equations: no solve of the sheets."""
    return float(gradient @ np.linalg.solve(normal, gradient))


def bounded_step(
    normal: FloatArray, gradient: FloatArray, damping: FloatArray | float
) -> FloatArray:
    """A damped step (N,) of Gauss-Newton, no parameter of which changes by more than the limit."""
    damped = normal.copy()
    _diagonal(damped)[:] += damping
    step = -np.linalg.solve(damped, gradient)
    step *= min(1.0, STEP_LIMIT / max(float(np.abs(step).max(initial=0.0)), 1e-12))
    return np.asarray(step)


def _drawn(drawing: Drawing) -> Slopes:
    """The four (n,) that a drawing's slopes are of."""
    return drawing.enclosed, drawing.enclosed_kpa, drawing.share, drawing.pressure_kpa


def _seen_by(name: Channel, four: Slopes) -> tuple[FloatArray, FloatArray]:
    """Share and pressure as a sheet sees them, or their slopes."""
    return four[:2] if name == Channel.STRUCTURE else four[2:]


def _felt(weights: FloatArray, drawing: Drawing) -> FloatArray:
    """Weighted forces (K,) that companions feel of a drawing; `weights` (K, P) by 1 kPa."""
    return np.asarray(weights[:, drawing.nodes] @ (drawing.share * drawing.pressure_kpa))


def _felt_slopes(weights: FloatArray, drawing: Drawing) -> FloatArray:
    """Derivative (K, N + 1) of that by the drawing's parameters and the log ratio.

    The log ratio leaves it as it is: the field is the same, whatever a sheet makes of it.
    """
    _, _, by_share, by_pressure = drawing.slopes()
    by_pressed = by_share.T * drawing.pressure_kpa + by_pressure.T * drawing.share
    felt = weights[:, drawing.nodes] @ by_pressed.T
    return np.column_stack([felt, np.zeros(len(felt))])


def _for_c(array: FloatArray) -> FloatArray:
    """The same numbers as C reads them, whatever a family has them in."""
    return np.ascontiguousarray(array, np.float64)


def _diagonal(matrix: FloatArray) -> FloatArray:
    """A view of the diagonal (n,) of a matrix (n, n)."""
    return matrix.reshape(-1)[:: len(matrix) + 1]


def _root_mean_square(values: FloatArray) -> float:
    return math.sqrt(values @ values / len(values))

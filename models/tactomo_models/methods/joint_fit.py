"""All sheets judge together: what was found on one sheet is fitted to every sheet's data.

What is there, and of what form, is found on the sheet that shows outlines best. Here follow the
pressures, the outlines as all sheets have them, and two questions that the graded sheet answers:
does the pressure fall towards the edge, and does a ring press with its rim alone? An answer is an
odds ratio; while it is open, the other account of the contacts has its share in what is shown.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.scans.stillness import Since, are_still
from tactomo_models.scene.drawing import Drawing
from tactomo_models.scene.field_account import Doubt
from tactomo_models.scene.field_fit import Budget, Family, FieldFit, FittedField, Measured
from tactomo_models.scene.level_set import LevelSet
from tactomo_models.scene.parameters import COLUMNS, EDGE, HERTZ, HOLE, PEAK
from tactomo_models.scene.pressure_field import PressureField


@dataclass(frozen=True)
class Question:
    """Whether contacts have an edge, or a hole.

    Attributes:
        column: of their parameters.
        value: that the column then has.
        worth: by how much the cost must fall for it, times what errors that go together make of
            one unit. Of an edge even pressures gain up to 4 by chance and by uneven sheets: 3 for 4
            gains 0.002 of ICC of soft presses, 0.006 on hand-made skins, and loses 0.0008 of flat
            ones at 10 dB; 2 gains as much again, and loses 0.009. Of a hole 6
            gains 0.001 of soft ones, and is sure of solid discs where a ring presses.
    """

    column: int
    value: float
    worth: float


QUESTIONS = (Question(EDGE, HERTZ, 3.0), Question(HOLE, 1.0, 4.0))
ONE_SHEET_WORTH = 0.25  # share of it on one sheet, whose outlines are as open as its edges
FALLEN_PEAK = 1.25  # peak of a pressure that falls, over the even one of about the same mean
CLEARLY = 12.0  # rise of the cost, to second order, from which a question need not be asked
HOPELESS = 20.0  # gains of the last step, that another account is still dearer: no more is tried
FOLLOWED = 3.0  # of the cost, what a parameter gains by following a new frame's noise, at most
OTHER = 1.25  # ratio of the graded sheet's signals, from which a press is another one
FEW = 3  # contacts, that are asked as if they were one
STEPS = 4  # of a refinement, and of an answer


class JointFit:
    """Fits what a course of frames has found on one sheet to all sheets, frame by frame.

    Args:
        fit: what fits fields to the sensor's sheets.
        field: a field without contacts.
        questions: what is asked of the contacts.
    """

    def __init__(
        self, fit: FieldFit, field: PressureField, questions: tuple[Question, ...] = QUESTIONS
    ) -> None:
        self._fit, self._field, self._questions = fit, field, questions
        self.forget()

    def forget(self) -> None:
        """Drop the warm start."""
        self._fitted: FittedField | None = None
        self._given: Drawing | None = None  # what it is the fit of
        self._settled_on: Measured = {}
        self._since: Since | None = None  # what has come since
        self._was_asked = True  # whether what it is the fit of was open to questions
        self._evidence: dict[int, float] = {}  # logarithm of the odds against each column's value
        self._frames_moved = 0  # with these contacts
        self._asked_signal = 0.0  # of the graded sheet, when a question was asked last
        self.doubts: dict[int, Doubt] = {}

    def follow(
        self,
        start: FittedField,
        measured: Measured,
        budget: Budget,
        doubt: float,
        asks: bool,
    ) -> FittedField:
        """Fit one frame more.

        Args:
            start: what was found on one sheet.
            measured: the changes of all sheets.
            budget: compute time that may be spent; one step is always taken.
            doubt: see `unit_of_gain`.
            asks: whether what is there is settled, so that questions may be asked of it.
        """
        fitted = self._continued(start, measured)
        if not fitted.converged or (asks and not self._was_asked):
            started = fitted.cost
            fitted = self._fit.refine(fitted, measured, budget, 0.0)
            # A budget of a step or so a frame lets it follow each frame's noise, no more.
            # A step that was refused, or short by its damping, says nothing; nor do a level set's
            # many coefficients, which gain more than noise while its few pressures are far off.
            gain = started - fitted.cost
            few = isinstance(fitted.family, PressureField) and fitted.damping <= 1
            follows = few and 0 < gain < FOLLOWED * len(fitted.parameters)
            fitted = replace(fitted, converged=fitted.converged or follows)
            self._settled_on, self._was_asked = measured, asks
            if asks and start.converged:  # else its form may answer for an edge
                fitted = self._questioned(fitted, measured, budget, doubt)
                if budget.over and not self._evidence:  # what never was answered is asked again
                    self._was_asked, self._frames_moved = False, 0
            self._since = None
            if fitted.converged and fitted.jacobian is not None:
                self._since = Since(measured, fitted.jacobian, self._fit.prior(fitted)[0])
        self._fitted = fitted
        return fitted

    def _questioned(
        self,
        fitted: FittedField,
        measured: Measured,
        budget: Budget,
        doubt: float,
    ) -> FittedField:
        """The field that questions leave: asked at once and then ever more seldom.

        What moves shall cost no more for them, and what stays is not asked again: a sheet's
        unevenness would say the same each time.
        """
        family = fitted.family
        is_askable = isinstance(family, PressureField) and family.count > 0
        if not (is_askable and fitted.converged) or budget.over:
            return fitted
        signal = measured[Channel.MAGNITUDE].misfit
        if not self._asked_signal / OTHER < signal < self._asked_signal * OTHER:
            # Another press: what the last one left open, or decided, says little of this one.
            self._evidence.clear()
            self.doubts.clear()
            self._frames_moved = 0
        due = self._frames_moved & (self._frames_moved - 1) == 0
        self._frames_moved += 1
        self._asked_signal = signal if due else self._asked_signal
        if not due:
            return fitted
        return self._answered(fitted, measured, budget, unit_of_gain(fitted, doubt))

    def is_fit_of(self, drawing: Drawing) -> None:
        """Say what drawing the next frame will start with if nothing has moved on the one sheet."""
        self._given = drawing

    def _continued(self, start: FittedField, measured: Measured) -> FittedField:
        before = self._fitted
        if before is not None and self._given is start.drawing:
            fitted = self._fit.compare(before, measured)
            still = are_still(self._settled_on, measured)
            if still and self._since is not None:
                still = not self._since.shows_change(measured)
            if still:
                return replace(fitted, converged=before.converged)
            if before.solutions.keys() == measured.keys():
                return fitted
        if start.solutions.keys() == measured.keys():  # found on all sheets
            started = replace(start, converged=False)  # questions are left to ask
        else:
            started = self._on_all_sheets(start, measured)
        if before is None or len(before.parameters) != len(started.parameters):
            self.forget()
        return started

    def _on_all_sheets(self, start: FittedField, measured: Measured) -> FittedField:
        """The same contacts, with pressures to fit."""
        if isinstance(start.family, PressureField):
            each = start.family.split(start.parameters)
            field = self._field.of(each, start.family.order)
            family: Family = field
            parameters, solved = field.join(each), start.solutions
        else:
            assert isinstance(start.family, LevelSet)
            family, parameters = self._with_peaks(start.family, start.parameters)
            solved = {}  # with other pressures
        started = self._fit.evaluate(family, parameters, start.log_ratio, measured, solved=solved)
        assert started is not None  # it was small enough for one sheet
        return started

    def _with_peaks(
        self, family: LevelSet, coefficients: FloatArray
    ) -> tuple[LevelSet, FloatArray]:
        """A level set and the pressure of each of its parts."""
        owned = family.owned_by(family.centres_m, self._field)
        peaks = np.full(len(owned.centres_m), self._field.typical_peak)
        if self._fitted is not None and len(self._fitted.parameters) == len(owned.prior_mean):
            peaks = self._fitted.parameters[len(coefficients) :]
        return owned, np.append(coefficients, peaks)

    def _answered(
        self, fitted: FittedField, measured: Measured, budget: Budget, scale: float
    ) -> FittedField:
        """Ask each question once more; the field that the answers leave."""
        for question in self._questions:
            other = self._other(fitted, question, measured, budget, scale)
            if other is None:
                continue
            one, two = contacts_of(fitted), contacts_of(other)
            # For the even pressure, whichever of the two is the present account.
            falls = bool(one[:, question.column].any())
            rise = (fitted.cost - other.cost if falls else other.cost - fitted.cost) / scale
            # Of many contacts each gains something by chance; with this, crowds' ICC is 0.973 for
            # 0.960. Soft ones, of fewer contacts, would lose 0.006.
            worth = question.worth * (len(one) if len(one) > FEW else 1.0)
            odds = float(np.clip((worth + rise) / 2, -50.0, 50.0))
            # A mean and no sum: where a contact stays, errors of the sheet repeat themselves.
            evidence = (odds + self._evidence.get(question.column, odds)) / 2
            self._evidence[question.column] = evidence
            if falls == (evidence > 0):
                fitted, one, two = other, two, one
                self.doubts.clear()
            self.doubts[question.column] = Doubt(float(np.exp(-abs(evidence))), two - one)
        return fitted

    def _other(
        self,
        fitted: FittedField,
        question: Question,
        measured: Measured,
        budget: Budget,
        scale: float,
    ) -> FittedField | None:
        """The field as it else might be; None where nothing is in question, or time is short."""
        assert isinstance(fitted.family, PressureField)
        each: FloatArray | None = contacts_of(fitted)
        assert each is not None
        falls = each[:, question.column] > 0
        if falls.any():
            each[falls, question.column] = 0.0
            peaks = 1 / FALLEN_PEAK * each[falls, PEAK]
            each[falls, PEAK] = np.clip(peaks, *fitted.family.peak_limits)
        else:
            budget.spend(fitted)
            each = fallen(question, self._fit, fitted, measured, scale)
        if each is None:
            return None
        family = self._field.of(each, fitted.family.order)
        other = self._fit.evaluate(family, family.join(each), fitted.log_ratio, measured)
        if other is None:
            return None
        for _ in range(2 * STEPS):
            before = other.cost
            other = self._fit.refine(other, measured, budget, 0.0, 1)
            is_hopeless = other.cost - fitted.cost > HOPELESS * (before - other.cost)
            if other.converged or is_hopeless:
                return other
            if budget.over:
                break
        return other if other.cost < fitted.cost else None


def contacts_of(fitted: FittedField) -> FloatArray:
    """(K, COLUMNS) of a field's contacts; none of a level set."""
    if not isinstance(fitted.family, PressureField):
        return np.zeros((0, COLUMNS))
    return fitted.family.split(fitted.parameters)


def unit_of_gain(fitted: FittedField, doubt: float) -> float:
    """What one unit of squared misfit means, by what a field leaves unexplained.

    Args:
        fitted: the field.
        doubt: what errors that go together make of it.
    """
    # With few measurements (the paper's sensor has 208) half of it would be more than any one of
    # several contacts can explain.
    half = min(0.5, len(fitted.residual) / 416)
    return max(doubt, half * fitted.misfit**2)


def fallen(
    question: Question, fit: FieldFit, fitted: FittedField, measured: Measured, scale: float
) -> FloatArray | None:
    """The contacts (K, COLUMNS) of a field with an edge, or with holes, as many as may have one.

    What presses is likely of one kind, so they are all asked at once. None where the data are
    clearly against it.
    """
    assert isinstance(fitted.family, PressureField)
    each, column = contacts_of(fitted), question.column
    slopes, bends = further(fit, fitted, measured, slice(column, column + 1))
    rise = 2 * question.value * slopes[:, 0] + question.value**2 * bends[:, 0, 0]
    # Far from where it was made a parabola knows little: a falling one is always worth asking.
    asked = (rise < CLEARLY * scale) | (slopes[:, 0] < 0)
    asked &= (each[:, [EDGE, HOLE]] == 0).all(axis=1)
    if not asked.any():
        return None
    each[asked, column] = question.value
    each[asked, PEAK] = np.minimum(FALLEN_PEAK * each[asked, PEAK], fitted.family.peak_limits[1])
    return each


def further(
    fit: FieldFit, fitted: FittedField, measured: Measured, columns: slice
) -> tuple[FloatArray, FloatArray]:
    """How the cost would go with further parameters of each contact, the others following.

    Args:
        fit: what fitted the field.
        fitted: at its minimum.
        measured: what it is fitted to.
        columns: C further parameters.

    Returns:
        Half the cost's slopes (K, C), and half its curvatures (K, C, C), at what they are now.
    """
    assert isinstance(fitted.family, PressureField)
    family, count = fitted.family, columns.stop - columns.start
    slopes, bends = np.zeros((family.count, count)), np.zeros((family.count, count, count))
    if family.count == 0:
        return slopes, bends
    every = family.with_free(columns)
    drawing = every.draw(every.join(family.split(fitted.parameters)))
    J = fit.jacobian(fitted, measured, drawing)
    known = np.append(family.free[every.free], True)  # and the log ratio
    precision, offset = fit.prior(fitted)
    own = J[:, known]
    normal = own.T @ own + np.diag(precision)
    gradient = own.T @ fitted.residual + precision * offset
    for k, index in enumerate(every.index[:, columns]):
        more = J[:, index]
        cross = np.linalg.solve(normal, own.T @ more)
        slopes[k] = more.T @ fitted.residual - cross.T @ gradient
        bends[k] = more.T @ more - cross.T @ (own.T @ more)
    return slopes, bends

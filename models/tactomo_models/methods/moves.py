"""The moves of the warm-started fit: what may be made of a shape to explain more, or with less.

Contacts are born where the residual misses them, split, and die; outlines get a better form;
pressures fall towards the edge or leave a ring; and where no few outlines do, there is a level set.
Each move makes a candidate, and what that has to gain; none is refined here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import cached_property, partial
from typing import TypeAlias

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.methods.contact_search import ContactSearch, MissingContact
from tactomo_models.methods.joint_fit import (
    ONE_SHEET_WORTH,
    Question,
    contacts_of,
    fallen,
    further,
    unit_of_gain,
)
from tactomo_models.scene.field_fit import Budget, FieldFit, FittedField, Measured
from tactomo_models.scene.level_set import LevelSet
from tactomo_models.scene.parameters import (
    COLUMNS,
    E1,
    E2,
    EDGE,
    HARMONIC,
    MAX_BULGE,
    PEAK,
    PRIOR_SIGMA,
    SIZE,
    UNIT_M,
    X,
    Y,
)
from tactomo_models.scene.pressure_field import PressureField
from tactomo_models.scene.sheet_response import GradedResponse

GOOD_MISFIT = 1.0  # explained to the noise (discrepancy principle): no further step
SUSPECT_MISFIT = 1.5  # a minimum this bad may be the wrong one
TRIALS = 4  # of so many steps that a candidate may take
MAX_CONTACTS = 12
# Gains and losses are in squared misfit, and count by how well the data are explained otherwise.
SURE_GAIN = 30.0  # of a contact: the best of 500 places gains some 15 by noise alone
CROWD = 4  # contacts among which two may pass for one
MANY = 6  # contacts, of more of which what passes for one lies farther apart
CROWD_GAIN = 15.0  # of two for one among them: they gain 30 and more there
ASKED_OF_CROWD = 3  # splits and births: with each, one crowded scene in ten more is counted right
LONG_GAIN = 5.0  # of two small contacts for a long one: about as many parameters
SMALL_M = 0.006  # contacts of a smaller radius are asked whether they are needed

Propose = Callable[[], FloatArray]  # (K, COLUMNS), see `pressure_field.ellipses_of`


class ShapeModel(Enum):
    """How a scene may be described."""

    AS_NEEDED = "as needed"
    OUTLINES = "outlines"
    LEVEL_SET = "level set"


@dataclass(frozen=True)
class Candidate:
    """A shape that is refined beside the one in force.

    Attributes:
        shape: as refined so far.
        gain: by how much its cost must be below that of the shape in force, to take its place.
        trials: refinements that it may still have.
    """

    shape: FittedField
    gain: float
    trials: int = TRIALS


@dataclass(frozen=True)
class Frame:
    """What one frame is fitted to, and what the fit may spend.

    Attributes:
        measured: the changes of each channel that has a scan.
        budget: compute time.
        propose: asked for contacts to start from; None where nothing proposes any.
    """

    measured: Measured
    budget: Budget
    propose: Propose | None

    @cached_property
    def doubt(self) -> float:
        """Errors that go together look like something that is there: gains count for less."""
        inflation = [each.variance_inflation for each in self.measured.values()]
        return float(np.sqrt(np.mean(inflation)))


class Moves:
    """Makes candidates of shapes on one sensor.

    Args:
        fit: what fits fields to the sensor's sheets.
        shape_model: how a scene may be described.
        questions: what is asked of the contacts' pressures.
    """

    def __init__(
        self, fit: FieldFit, shape_model: ShapeModel, questions: tuple[Question, ...]
    ) -> None:
        graded = fit.responses.get(Channel.MAGNITUDE)
        assert graded is None or isinstance(graded, GradedResponse)
        self.fit, self._shape_model, self._questions = fit, shape_model, questions
        self.field = PressureField.on(fit.forward, graded)
        self._level_set = LevelSet(fit.forward)
        typical = {Channel.STRUCTURE: float(np.exp(fit.likely))}
        if graded is not None:
            peak_kpa = np.array(self.field.typical_peak * self.field.unit_kpa)
            typical[Channel.MAGNITUDE] = 1 + float(graded.relative_change(peak_kpa)[0])
        self._search = ContactSearch(fit, typical)
        self._lacking: tuple[FittedField, list[MissingContact]] | None = None
        self._halved: tuple[FittedField, list[tuple[FittedField, int]]] | None = None

    def outlines_of(self, shape: FittedField, sheets: Measured) -> FittedField:
        """The same contacts on one sheet, which says nothing of their pressures."""
        assert isinstance(shape.family, PressureField)
        each = shape.family.split(shape.parameters)
        family = shape.family.of(each, shape.family.order, fits_peaks=False)
        return self.fit.restricted(shape, family, family.join(each), sheets)

    def of(self, shape: FittedField, frame: Frame) -> list[Move]:
        """What may be tried on a shape at its minimum, the simplest first."""
        if not isinstance(shape.family, PressureField):
            return []
        if self._shape_model == ShapeModel.LEVEL_SET:
            return [self.birth, self._escalate]
        questions = self._questions if [*shape.residuals] == [Channel.MAGNITUDE] else ()
        inside: list[Move] = [partial(self._with, question) for question in questions]
        crowd = shape.family.count >= CROWD
        # What one sheet takes for one of a crowd, or for none of many, both are asked for later.
        every = len(frame.measured) == len(self.fit.responses)
        splits = self._splits(shape, crowd and every)
        deaths = self._deaths(shape) if every or shape.family.count <= MANY else []
        form = [self._of_higher_order, self._modulate, *inside, *splits]
        if shape.misfit > GOOD_MISFIT or crowd:
            form += [self._birth_anywhere(k) for k in range(ASKED_OF_CROWD if crowd else 1)]
        # What pressures leave unexplained in a crowd is a matter of edges and holes first.
        as_needed = self._shape_model == ShapeModel.AS_NEEDED and len(frame.measured) == 1
        free = [self._escalate] if as_needed else []
        return [self.birth, *form, self._parted, *free, *deaths]

    def joined(self, shape: FittedField, frame: Frame) -> FittedField:
        """The same contacts and others that landed away from them, before any is let move."""
        while not frame.budget.over:
            born = self.birth(shape, frame)
            if born is None or born.shape.cost > shape.cost - born.gain:
                break
            shape = born.shape
        return shape

    def birth(self, shape: FittedField, frame: Frame) -> Candidate | None:
        """A further contact, away from those that are known."""
        near_m = 0.012  # what is missing this near an outline is more likely a part of its form
        # Circles leave much unexplained that a better form will explain: no contact is made of it.
        each, needed = contacts_of(shape), SURE_GAIN * scale_of(shape, frame)
        circles = isinstance(shape.family, PressureField) and shape.family.order < 2 and len(each)
        sure = 2 * needed if circles else needed
        for found in self._missing(shape, frame):
            if found.gain > sure and _gap_m(each, found) > near_m:
                return self._with_another(shape, found, needed, frame)
        return None

    def _birth_anywhere(self, rank: int) -> Move:
        """A further contact, beside or between others."""
        # Gain to first order in a crowd, over what is needed; 0.2 finds no more.
        likely = 0.5

        def move(shape: FittedField, frame: Frame) -> Candidate | None:
            needed = (CROWD_GAIN if len(frame.measured) > 1 else SURE_GAIN) * scale_of(shape, frame)
            missing, crowd = self._missing(shape, frame), len(contacts_of(shape)) >= CROWD
            if rank >= len(missing) or missing[rank].gain < (likely if crowd else 1) * needed:
                return None
            return self._with_another(shape, missing[rank], needed, frame)

        return move

    def _missing(self, shape: FittedField, frame: Frame) -> list[MissingContact]:
        """Contacts that may be missing, the likeliest first."""
        smallest_m = 0.003  # radius below which it is an error of the model, not a contact
        if not isinstance(shape.family, PressureField) or shape.family.count == MAX_CONTACTS:
            return []
        if self._lacking is None or self._lacking[0] is not shape:
            found = self._search.missing(shape, frame.measured)
            frame.budget.spend(shape)  # about what a search takes, too
            self._lacking = shape, [each for each in found if each.radius_m > smallest_m]
        return self._lacking[1]

    def _with_another(
        self, shape: FittedField, found: MissingContact, gain: float, frame: Frame
    ) -> Candidate | None:
        born = np.zeros((1, COLUMNS))
        born[0, [X, Y, SIZE, PEAK]] = (
            found.x_m / UNIT_M,
            found.y_m / UNIT_M,
            np.log(max(found.radius_m, SMALL_M)),
            self.field.typical_peak,
        )
        other = self._of_contacts(np.vstack([contacts_of(shape), born]), shape, frame)
        return Candidate(other, gain) if other else None

    def _of_higher_order(self, shape: FittedField, frame: Frame) -> Candidate | None:
        worth = 2.5  # of one more parameter of a form
        assert isinstance(shape.family, PressureField)
        if shape.family.order == 2 or shape.family.count == 0:
            return None
        # Order 1 frees a saturated sheet's ratio; where there is none, it has nothing to gain by.
        order = shape.family.order + 1 if Channel.STRUCTURE in frame.measured else 2
        other = self.evaluate(contacts_of(shape), order, shape.log_ratio, frame)
        if other is None:
            return None
        further = len(other.parameters) - len(shape.parameters)
        return Candidate(other, worth * further * scale_of(shape, frame))

    def _modulate(self, shape: FittedField, frame: Frame) -> Candidate | None:
        """Eggs and rounded rectangles for ellipses, where that would explain more."""
        worth = 4.0  # of an outline's four: rectangles gain 12 and more, other outlines up to 6
        assert isinstance(shape.family, PressureField)
        if shape.family.order < 2:
            return None
        needed = worth * scale_of(shape, frame)
        frame.budget.spend(shape)
        slopes, bends = further(self.fit, shape, frame.measured, slice(HARMONIC, PEAK))
        prior = np.diag(PRIOR_SIGMA[HARMONIC:PEAK] ** -2.0)
        steps = -np.linalg.solve(bends + prior, slopes[:, :, None])[:, :, 0]
        each = contacts_of(shape)
        asked = (-(slopes * steps).sum(axis=1) > needed) & ~each[:, HARMONIC:PEAK].any(axis=1)
        if not asked.any():
            return None
        each[asked, HARMONIC:PEAK] = np.clip(steps[asked], -MAX_BULGE / 2, MAX_BULGE / 2)
        other = self._of_contacts(each, shape, frame)
        return Candidate(other, needed * asked.sum()) if other else None

    def _parted(self, shape: FittedField, frame: Frame) -> Candidate | None:
        """Circles for rounded outlines, and what they then miss: two may pass for one of those."""
        assert isinstance(shape.family, PressureField)
        each = contacts_of(shape)
        # One graded sheet shows a soft edge where another has a bulge: it asks for edges instead.
        if not each[:, HARMONIC:PEAK].any() or Channel.STRUCTURE not in frame.measured:
            return None
        each[:, E1:PEAK] = 0.0
        circles = self.evaluate(each, 1, shape.log_ratio, frame)
        if circles is None:
            return None
        circles = self.fit.refine(circles, frame.measured, frame.budget, 0.0, TRIALS)
        missing, scale = self._missing(circles, frame), scale_of(shape, frame)
        if not missing or missing[0].gain < SURE_GAIN * scale:
            return None
        return self._with_another(circles, missing[0], LONG_GAIN * scale, frame)

    def _with(self, question: Question, shape: FittedField, frame: Frame) -> Candidate | None:
        """Pressures that fall towards the edge, or rings, where the data leave that open."""
        scale = scale_of(shape, frame)
        frame.budget.spend(shape)
        each = fallen(question, self.fit, shape, frame.measured, scale)
        if each is None:
            return None
        other = self._of_contacts(each, shape, frame)
        return Candidate(other, ONE_SHEET_WORTH * question.worth * scale) if other else None

    def _splits(self, shape: FittedField, crowd: bool) -> list[Move]:
        """Moves that make two contacts of one: those that stand it best, one after the other."""
        elongated = 0.4  # half the logarithm of the axes' ratio (2.2), from which it may be two
        each = contacts_of(shape)
        if not 0 < len(each) < MAX_CONTACTS:
            return []
        long = np.hypot(each[:, E1], each[:, E2]) > elongated
        unexplained = shape.misfit > GOOD_MISFIT and len(each) < CROWD
        asked = np.arange(len(each)) if unexplained or crowd else np.flatnonzero(long)
        count = ASKED_OF_CROWD if crowd else 1

        def split(rank: int) -> Move:
            def move(shape: FittedField, frame: Frame) -> Candidate | None:
                ranked = self._halves(shape, asked, frame)
                if rank >= len(ranked):
                    return None
                half, k = ranked[rank]
                gain = LONG_GAIN if long[k] else CROWD_GAIN if crowd else SURE_GAIN
                return Candidate(half, gain * scale_of(shape, frame))

            return move

        return [split(rank) for rank in range(min(count, len(asked)))]

    def _halves(
        self, shape: FittedField, asked: IntArray, frame: Frame
    ) -> list[tuple[FittedField, int]]:
        """What each contact that is asked makes as two, the best first, and which it is."""
        if self._halved is None or self._halved[0] is not shape:
            each = contacts_of(shape)
            halves = [
                (half, k)
                for k in asked.tolist()
                if (half := self._of_contacts(_halved(each, k), shape, frame))
            ]
            self._halved = shape, sorted(halves, key=lambda one: one[0].cost)
        return self._halved[1]

    def _escalate(self, shape: FittedField, frame: Frame) -> Candidate | None:
        """The same as a level set."""
        free_worth = 100.0  # of a level set
        always = self._shape_model == ShapeModel.LEVEL_SET
        if len(shape.parameters) == 0 or (shape.misfit < SUSPECT_MISFIT and not always):
            return None
        assert isinstance(shape.family, PressureField)
        likeness = np.zeros(len(shape.family.x_m))
        likeness[shape.drawing.nodes] = shape.drawing.enclosed
        each = contacts_of(shape)
        level_set = self._level_set.owned_by(
            each[:, [X, Y]] * UNIT_M, shape.family if Channel.MAGNITUDE in frame.measured else None
        )
        parameters = level_set.parameters_of(likeness, each[:, PEAK])
        other = self.fit.evaluate(level_set, parameters, shape.log_ratio, frame.measured)
        worth = -np.inf if always else free_worth * scale_of(shape, frame)
        return Candidate(other, worth) if other else None

    def _deaths(self, shape: FittedField) -> list[Move]:
        """A move for each contact that is small or lies against another: leave it out."""
        each = contacts_of(shape)
        if len(each) < 2:
            return []
        apart = np.hypot(*(each[:, None, [X, Y]] - each[None, :, [X, Y]]).T) * UNIT_M
        radius = np.exp(each[:, SIZE])
        gap = apart - radius[:, None] - radius[None] + np.diag(np.full(len(each), np.inf))
        asked = np.flatnonzero((radius < SMALL_M) | (gap.min(axis=1) < 0))

        def without(k: int) -> Move:
            def move(shape: FittedField, frame: Frame) -> Candidate | None:
                needless = 15.0  # a contact whose absence costs less is not there
                other = self._left_out(shape, k, frame)
                return Candidate(other, -needless * scale_of(shape, frame)) if other else None

            return move

        return [without(k) for k in asked[np.argsort(radius[asked])]]

    def each_left_out(self, shape: FittedField, frame: Frame) -> list[FittedField]:
        """What is left without each of several contacts."""
        count = len(contacts_of(shape))
        left = [self._left_out(shape, k, frame) for k in range(count if count > 1 else 0)]
        return [rest for rest in left if rest is not None]

    def _left_out(self, shape: FittedField, k: int, frame: Frame) -> FittedField | None:
        return self._of_contacts(np.delete(contacts_of(shape), k, axis=0), shape, frame)

    def nothing(self, frame: Frame) -> FittedField:
        """What explains a frame by no contact at all."""
        none = np.zeros((0, COLUMNS))
        nothing = self.evaluate(none, 0, self.fit.likely, frame)
        assert nothing is not None
        return nothing

    def _of_contacts(
        self, each: FloatArray, shape: FittedField, frame: Frame
    ) -> FittedField | None:
        """A shape with these contacts instead."""
        assert isinstance(shape.family, PressureField)
        return self.evaluate(each, shape.family.order, shape.log_ratio, frame)

    def evaluate(
        self, each: FloatArray, order: int, log_ratio: float, frame: Frame
    ) -> FittedField | None:
        """A field of contacts (K, COLUMNS) as it explains a frame; None where it cannot be."""
        family = self.field.of(each, order, fits_peaks=Channel.MAGNITUDE in frame.measured)
        shape = self.fit.evaluate(family, family.join(each), log_ratio, frame.measured)
        if shape is not None:
            frame.budget.spend(shape)
        return shape


Move: TypeAlias = Callable[[FittedField, Frame], Candidate | None]


def scale_of(shape: FittedField, frame: Frame) -> float:
    """What one unit of gain means in a frame, by what a shape leaves unexplained of it."""
    unit = unit_of_gain(shape, frame.doubt)
    # Many contacts on both sheets that are explained better than noise and model allow for tell
    # that these were overrated, and gains underrated: without it 0.01 of crowds' ICC is lost.
    return unit * min(1.0, shape.misfit**2) if len(shape.residuals) > 1 else unit


def _halved(each: FloatArray, k: int) -> FloatArray:
    """Contact k as two circles of half its area, side by side along its longer axis."""
    size, e1, e2 = each[k, [SIZE, E1, E2]]
    elongation = np.hypot(e1, e2)
    angle = np.arctan2(e2, e1) / 2
    # Among many, halves of a circle touch: of eight to ten contacts, that counts 85 % of the scenes
    # right for 79 %; 0.65 to 1.3 of its radius differ little. Among four to six, ICC loses 0.002.
    apart = 0.5 if len(each) <= MANY else np.sqrt(0.5)
    away = apart * np.exp(size + elongation) / UNIT_M * np.array([np.cos(angle), np.sin(angle)])
    half = each[k].copy()
    half[SIZE] -= np.log(2) / 2
    half[E1:PEAK] = half[EDGE:] = 0.0
    one, other = half.copy(), half
    one[[X, Y]] += away
    other[[X, Y]] -= away
    return np.vstack([np.delete(each, k, axis=0), one, other])


def _gap_m(each: FloatArray, found: MissingContact) -> float:
    """Distance of a missing contact's centre from the nearest outline, about."""
    apart = np.hypot(each[:, X] * UNIT_M - found.x_m, each[:, Y] * UNIT_M - found.y_m)
    return float(np.min(apart - np.exp(each[:, SIZE]), initial=np.inf))

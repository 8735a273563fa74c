"""The warm-started fit: from the last frame's shape to the simplest that explains this frame.

The simplest description comes first, and a dearer one only where the data ask for it: circles, one
added at a time where the residual shows that it is missing; ellipses; ellipses with modulated
edges; and, where no few outlines explain the data, a level set. Each such move makes a candidate,
which is refined beside the shape in force and takes its place once it explains the data better by
more than its further parameters would by chance. Contacts that the data do not need are taken away
again.

After a change that the known contacts do not account for, they compete with what a cold start
finds, and with themselves and what is missing. Work is spent by the frame's budget; what one frame
does not finish, the next one goes on with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property, partial
from typing import TypeAlias

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.methods.contact_search import ContactSearch, MissingContact
from tactomo_models.methods.joint_fit import (
    FOLLOWED,
    ONE_SHEET_WORTH,
    QUESTIONS,
    JointFit,
    Question,
    contacts_of,
    fallen,
    further,
    unit_of_gain,
)
from tactomo_models.scans.stillness import are_still
from tactomo_models.scene.field_account import Doubt
from tactomo_models.scene.field_fit import Budget, FieldFit, FittedField, Measured
from tactomo_models.scene.level_set import LevelSet
from tactomo_models.scene.pressure_field import (
    COLUMNS,
    E1,
    E2,
    EDGE,
    HARMONIC,
    HOLE,
    MAX_BULGE,
    PEAK,
    PRIOR_SIGMA,
    SIZE,
    UNIT_M,
    Drawing,
    PressureField,
    X,
    Y,
)
from tactomo_models.scene.sheet_response import GradedResponse

GOOD_MISFIT = 1.0  # explained to the noise (discrepancy principle): no further step
SUSPECT_MISFIT = 1.5  # a minimum this bad may be the wrong one
SLACK = 1.1  # contacts that are explained as well as before are not questioned again
TRIALS = 4  # of so many steps that a candidate may take
MAX_CONTACTS = 12
# Gains and losses are in squared misfit, and count by how well the data are explained otherwise.
SURE_GAIN = 30.0  # of a contact: the best of 500 places gains some 15 by noise alone
CROWD = 4  # contacts among which two may pass for one
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
class _Candidate:
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
class _Frame:
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


class _Tools:
    """What every fit on one sensor shares."""

    def __init__(self, fit: FieldFit, questions: tuple[Question, ...]) -> None:
        graded = fit.responses.get(Channel.MAGNITUDE)
        assert graded is None or isinstance(graded, GradedResponse)
        self.fit, self.questions = fit, questions
        self.field = PressureField.on(fit.forward, graded)
        self.level_set = LevelSet(fit.forward)
        typical = {Channel.STRUCTURE: float(np.exp(fit.likely))}
        if graded is not None:
            peak_kpa = np.array(self.field.typical_peak * self.field.unit_kpa)
            typical[Channel.MAGNITUDE] = 1 + float(graded.relative_change(peak_kpa)[0])
        self.search = ContactSearch(fit, typical)

    def outlines_of(self, shape: FittedField, sheets: Measured) -> FittedField:
        """The same contacts on one sheet, which says nothing of their pressures."""
        assert isinstance(shape.family, PressureField)
        each = shape.family.split(shape.parameters)
        family = shape.family.of(each, shape.family.order, fits_peaks=False)
        return self.fit.restricted(shape, family, family.join(each), sheets)


class WarmStartedFit:
    """Keeps the shape of what presses from frame to frame.

    Args:
        fit: what fits fields to the sensor's sheets.
        shape_model: how a scene may be described.
        questions: what is asked of the contacts' pressures.
    """

    def __init__(
        self,
        fit: FieldFit,
        shape_model: ShapeModel = ShapeModel.AS_NEEDED,
        questions: tuple[Question, ...] = QUESTIONS,
    ) -> None:
        self._course = _Course(_Tools(fit, questions), shape_model)
        self._joint = JointFit(fit, self._course.tools.field, questions)

    @property
    def typical_peak(self) -> float:
        """Peak that a proposed contact starts with, in the field's unit."""
        return self._course.tools.field.typical_peak

    def forget(self) -> None:
        """Drop the warm start."""
        self._course = _Course(self._course.tools, self._course.shape_model)
        self._joint.forget()

    def follow(
        self, measured: Measured, budget: Budget, propose: Propose | None = None
    ) -> tuple[FittedField, str]:
        """Find the shape that explains a frame.

        Args:
            measured: the changes of each channel that has a scan.
            budget: compute time that may be spent.
            propose: asked for contacts to start from where there is no shape to go on with; they
                are judged by the data as any other.

        Returns:
            The shape, and in words what it came from.
        """
        if len(measured) == 1:
            return self._course.follow(_Frame(measured, budget, propose))
        # The saturating sheet shows outlines best, and alone it costs half: what is there and of
        # what form is found on it, and then all sheets judge together. In a crowd, what one sheet
        # takes for one contact may be two on the other: there both search.
        every = _Frame(measured, budget, propose)
        outlines = replace(every, measured=_outlines(measured))
        for _ in range(2):
            both = self._course.searches_both
            shape, how = self._course.follow(every if both else outlines)
            asks = both or len(contacts_of(shape)) < CROWD
            joint = self._joint.follow(shape, measured, budget, every.doubt, asks)
            self._joint.is_fit_of(self._course.adopt(joint, measured))
            if budget.over or self._course.searches_both == both:
                break
        return replace(joint, converged=joint.converged and shape.converged), how

    @property
    def doubts(self) -> list[Doubt]:
        """Other accounts of the contacts that were followed last, as likely as the data say."""
        return [*self._joint.doubts.values(), *self._course.doubts.values()]


class _Course:
    """One course of fits from frame to frame."""

    def __init__(self, tools: _Tools, shape_model: ShapeModel) -> None:
        self.tools, self.shape_model = tools, shape_model
        self._shape: FittedField | None = None
        self._settled_on: Measured = {}  # the frame that the shape is of
        self._tried_misfit = 0.0  # at which all moves were tried on contacts like these
        self.doubts: dict[int, Doubt] = {}  # of contacts like these, by what is in doubt
        self._adopted: Drawing | None = None
        self._earlier = np.zeros((0, COLUMNS))  # contacts of the frame before the last
        self._lacking: tuple[FittedField, list[MissingContact]] | None = None
        self._halved: tuple[FittedField, list[tuple[FittedField, int]]] | None = None
        self._start_over()

    def _start_over(self) -> None:
        self._candidate: _Candidate | None = None
        self._moves_tried = 0
        self._moved = False  # whether known contacts were let move, before any is added
        self._settled = False  # whether the shape in force is at its minimum

    def follow(self, frame: _Frame) -> tuple[FittedField, str]:
        """Fit one frame more; see `WarmStartedFit.follow`."""
        shape, how = self._start(frame)
        if not shape.converged:
            shape = self._improve(shape, frame)
            self._settled_on = frame.measured
        self._shape = shape
        return shape, f"{how}, {_in_words(shape)}"

    @property
    def searches_both(self) -> bool:
        """Whether both sheets search, or the one that shows outlines best."""
        return self._shape is not None and len(self._shape.solutions) > 1

    def adopt(self, joint: FittedField, measured: Measured) -> Drawing:
        """Go on from what all channels have made of the shape in force, and return its drawing."""
        assert self._shape is not None
        family = joint.family
        if isinstance(family, PressureField) and joint.drawing is not self._adopted:
            crowded, settled = family.count >= CROWD, self._shape.converged
            sheets = measured if crowded else _outlines(measured)
            shape = joint if crowded else self.tools.outlines_of(joint, sheets)
            if crowded != self.searches_both:  # a crowd is searched anew, others are as they were
                self._start_over()
                self._moved = self._settled = True
                self._tried_misfit = 0.0 if crowded else shape.misfit
                self._settled_on = sheets
                settled &= not crowded
            self._shape = replace(shape, converged=settled)
            self._adopted = joint.drawing
        return self._shape.drawing

    def _start(self, frame: _Frame) -> tuple[FittedField, str]:
        """The last frame's shape where it still holds; else the best of what may be left of it."""
        before = self._shape
        if before is not None and len(before.solutions) > len(frame.measured):  # a scan was lost
            known = isinstance(before.family, PressureField)
            before = self.tools.outlines_of(before, frame.measured) if known else None
        if before is None:
            return self._from_scratch(frame)
        shape = self.tools.fit.compare(before, frame.measured)
        still = are_still(self._settled_on, frame.measured)
        if before.converged and still:
            self._earlier = contacts_of(before)
            return replace(shape, converged=True), "still"
        shape = self._gone_on(replace(shape, converged=False), frame)
        # What did not explain its own frame has no claim on the next one.
        suspect = before.misfit > SUSPECT_MISFIT and not still
        if suspect or shape.misfit > max(SUSPECT_MISFIT, 2 * before.misfit):
            self._start_over()
            if suspect:
                self._tried_misfit = 0.0
            scratch, how = self._from_scratch(frame)
            joined = self._joined(shape, frame)
            left_out = self._each_left_out(joined, frame)
            best = min([shape, joined, *left_out, scratch], key=lambda s: s.cost)
            if best is not shape:  # else they moved: once they have been followed, all is as it was
                self._tried_misfit = 0.0
            return best, how if best is scratch else "warm start"
        if before.converged:  # all was done, but for other data
            self._moved = self._settled = False
        if self._candidate is not None:
            other = self.tools.fit.compare(self._candidate.shape, frame.measured)
            self._candidate = replace(self._candidate, shape=replace(other, converged=False))
        return shape, "warm start"

    def _gone_on(self, shape: FittedField, frame: _Frame) -> FittedField:
        """The last shape, or with its contacts moved on as they last did, if that explains more."""
        least = 0.03  # of a move that is more than noise, in the unit of places
        each, earlier = contacts_of(shape), self._earlier
        self._earlier = each.copy()
        if len(each) == 0 or len(earlier) != len(each):
            return shape
        assert isinstance(shape.family, PressureField)
        moves = (each - earlier)[:, [X, Y]]
        if np.hypot(*moves.T).max() < least:
            return shape
        each[:, [X, Y]] += moves
        parameters = shape.family.bounded(shape.family.join(each))
        moved = self.tools.fit.evaluate(shape.family, parameters, shape.log_ratio, frame.measured)
        if moved is None:
            return shape
        frame.budget.spend(moved)
        return moved if moved.cost < shape.cost else shape

    def _from_scratch(self, frame: _Frame) -> tuple[FittedField, str]:
        """What is proposed, where that explains something; else nothing at all."""
        proposed_order = 2  # ellipses
        nothing = self._nothing(frame)
        if frame.propose is not None and len(each := frame.propose()[:MAX_CONTACTS]):
            proposed = self._evaluate(each, proposed_order, self.tools.fit.likely, frame)
            if proposed is not None and proposed.cost < nothing.cost:
                return proposed, "proposed"
        return self._joined(nothing, frame), "cold start"

    def _improve(self, shape: FittedField, frame: _Frame) -> FittedField:
        """Refine, and try one candidate after another, until none is left or the budget ends."""
        budget = frame.budget
        while True:
            if self._candidate is not None:
                shape = self._judge(self._candidate, shape, frame)
            elif self._moved and not self._settled and (early := self._early_birth(shape, frame)):
                self._candidate = early
            elif not self._settled:
                before, shape = shape, self._refined(shape, frame)
                # A budget of a step or so a frame lets it follow each frame's noise, no more.
                follows = before.cost - shape.cost < FOLLOWED * len(shape.parameters)
                self._settled = shape.converged or (budget.over and follows)
                self._moved = True
            elif shape.misfit <= SLACK * self._tried_misfit or not self._propose(shape, frame):
                self._tried_misfit = max(self._tried_misfit, shape.misfit)
                return replace(shape, converged=True)
            if budget.over:  # one thing at least is done in every frame
                return replace(shape, converged=False)

    def _refined(self, shape: FittedField, frame: _Frame) -> FittedField:
        steps = 4  # of a refinement, before what it leads to is judged
        if len(shape.parameters) == 0:
            return replace(shape, converged=True)
        # Few parameters are better known at the minimum; many would begin to explain the noise.
        good = 0.0 if isinstance(shape.family, PressureField) else GOOD_MISFIT
        return self.tools.fit.refine(shape, frame.measured, frame.budget, good, steps)

    def _judge(self, candidate: _Candidate, shape: FittedField, frame: _Frame) -> FittedField:
        """Refine a candidate: it takes the shape's place, is given up, or goes on."""
        refined = self._refined(candidate.shape, frame)
        wins = refined.cost < shape.cost - candidate.gain
        if wins and self._settled_on is not frame.measured and len(shape.parameters):
            # What follows this frame's noise must not win by that alone.
            shape = self.tools.fit.refine(shape, frame.measured, frame.budget, 0.0, 1)
            wins = refined.cost < shape.cost - candidate.gain
        if wins:
            self.doubts.clear()
        self._doubt(shape, refined, candidate.gain, frame)
        if wins:
            self._start_over()
            self._tried_misfit = 0.0
            self._settled, self._moved = refined.converged, True
            return refined
        # A trial that was cut short does not count.
        trials = candidate.trials - (not frame.budget.over)
        if refined.converged or trials == 0:
            self._candidate = None
            self._moves_tried += 1
        else:
            self._candidate = replace(candidate, shape=refined, trials=trials)
        return shape

    def _doubt(self, shape: FittedField, other: FittedField, gain: float, frame: _Frame) -> None:
        """Remember another account of the same contacts, as likely as the data leave it."""
        if len(one := contacts_of(shape)) != len(two := contacts_of(other)):
            return
        if not (one[:, EDGE:] != two[:, EDGE:]).any():
            return
        odds = np.exp(np.clip((other.cost + gain - shape.cost) / 2 / _scale(shape, frame), -50, 50))
        if odds < 1:
            one, two, odds = two, one, 1 / odds
        what = EDGE if (one[:, EDGE] != two[:, EDGE]).any() else HOLE
        self.doubts[what] = Doubt(float(1 / odds), two - one)

    def _propose(self, shape: FittedField, frame: _Frame) -> bool:
        """Set the next candidate beside a shape at its minimum; False when all were tried."""
        moves = self._moves(shape)
        while self._candidate is None and self._moves_tried < len(moves):
            self._candidate = moves[self._moves_tried](shape, frame)
            if self._candidate is None:
                self._moves_tried += 1
        return self._candidate is not None

    def _moves(self, shape: FittedField) -> list[_Move]:
        if not isinstance(shape.family, PressureField):
            return []
        if self.shape_model == ShapeModel.LEVEL_SET:
            return [self._birth, self._escalate]
        questions = self.tools.questions if [*shape.residuals] == [Channel.MAGNITUDE] else ()
        inside: list[_Move] = [partial(self._with, question) for question in questions]
        form = [self._of_higher_order, self._modulate, *inside, *self._splits(shape)]
        crowd = shape.family.count >= CROWD
        if shape.misfit > GOOD_MISFIT or crowd:
            form += [self._birth_anywhere(k) for k in range(ASKED_OF_CROWD if crowd else 1)]
        # What pressures leave unexplained in a crowd is a matter of edges and holes first.
        as_needed = self.shape_model == ShapeModel.AS_NEEDED and not self.searches_both
        free = [self._escalate] if as_needed else []
        return [self._birth, *form, *free, *self._deaths(shape)]

    def _joined(self, shape: FittedField, frame: _Frame) -> FittedField:
        """The same contacts and others that landed away from them, before any is let move."""
        while not frame.budget.over:
            born = self._birth(shape, frame)
            if born is None or born.shape.cost > shape.cost - born.gain:
                break
            shape = born.shape
        return shape

    def _early_birth(self, shape: FittedField, frame: _Frame) -> _Candidate | None:
        """A further contact where that much is left that it need not wait for the others."""
        return self._birth(shape, frame) if shape.misfit > SUSPECT_MISFIT else None

    def _birth(self, shape: FittedField, frame: _Frame) -> _Candidate | None:
        """A further contact, away from those that are known."""
        near_m = 0.012  # what is missing this near an outline is more likely a part of its form
        # Circles leave much unexplained that a better form will explain: no contact is made of it.
        each, needed = contacts_of(shape), SURE_GAIN * _scale(shape, frame)
        circles = isinstance(shape.family, PressureField) and shape.family.order < 2 and len(each)
        sure = 2 * needed if circles else needed
        for found in self._missing(shape, frame):
            if found.gain > sure and _gap_m(each, found) > near_m:
                return self._with_another(shape, found, needed, frame)
        return None

    def _birth_anywhere(self, rank: int) -> _Move:
        """A further contact, beside or between others."""
        # Gain to first order in a crowd, over what is needed; 0.2 finds no more.
        likely = 0.5

        def move(shape: FittedField, frame: _Frame) -> _Candidate | None:
            needed = (CROWD_GAIN if self.searches_both else SURE_GAIN) * _scale(shape, frame)
            missing, crowd = self._missing(shape, frame), len(contacts_of(shape)) >= CROWD
            if rank >= len(missing) or missing[rank].gain < (likely if crowd else 1) * needed:
                return None
            return self._with_another(shape, missing[rank], needed, frame)

        return move

    def _missing(self, shape: FittedField, frame: _Frame) -> list[MissingContact]:
        """Contacts that may be missing, the likeliest first."""
        smallest_m = 0.003  # radius below which it is an error of the model, not a contact
        if not isinstance(shape.family, PressureField) or shape.family.count == MAX_CONTACTS:
            return []
        if self._lacking is None or self._lacking[0] is not shape:
            found = self.tools.search.missing(shape, frame.measured)
            frame.budget.spend(shape)  # about what a search takes, too
            self._lacking = shape, [each for each in found if each.radius_m > smallest_m]
        return self._lacking[1]

    def _with_another(
        self, shape: FittedField, found: MissingContact, gain: float, frame: _Frame
    ) -> _Candidate | None:
        assert isinstance(shape.family, PressureField)
        each = shape.family.split(shape.parameters)
        further = np.zeros((1, COLUMNS))
        further[0, [X, Y, SIZE, PEAK]] = (
            found.x_m / UNIT_M,
            found.y_m / UNIT_M,
            np.log(max(found.radius_m, SMALL_M)),
            self.tools.field.typical_peak,
        )
        order = shape.family.order
        other = self._evaluate(np.vstack([each, further]), order, shape.log_ratio, frame)
        return _Candidate(other, gain) if other else None

    def _of_higher_order(self, shape: FittedField, frame: _Frame) -> _Candidate | None:
        worth = 2.5  # of one more parameter of a form
        assert isinstance(shape.family, PressureField)
        if shape.family.order == 2 or shape.family.count == 0:
            return None
        each = shape.family.split(shape.parameters)
        other = self._evaluate(each, shape.family.order + 1, shape.log_ratio, frame)
        if other is None:
            return None
        further = len(other.parameters) - len(shape.parameters)
        return _Candidate(other, worth * further * _scale(shape, frame))

    def _modulate(self, shape: FittedField, frame: _Frame) -> _Candidate | None:
        """Eggs and rounded rectangles for ellipses, where that would explain more."""
        worth = 4.0  # of an outline's four: rectangles gain 12 and more, other outlines up to 6
        assert isinstance(shape.family, PressureField)
        if shape.family.order < 2:
            return None
        needed = worth * _scale(shape, frame)
        frame.budget.spend(shape)
        slopes, bends = further(self.tools.fit, shape, frame.measured, slice(HARMONIC, PEAK))
        prior = np.diag(PRIOR_SIGMA[HARMONIC:PEAK] ** -2.0)
        steps = -np.linalg.solve(bends + prior, slopes[:, :, None])[:, :, 0]
        each = shape.family.split(shape.parameters)
        asked = (-(slopes * steps).sum(axis=1) > needed) & ~each[:, HARMONIC:PEAK].any(axis=1)
        if not asked.any():
            return None
        each[asked, HARMONIC:PEAK] = np.clip(steps[asked], -MAX_BULGE / 2, MAX_BULGE / 2)
        other = self._evaluate(each, shape.family.order, shape.log_ratio, frame)
        return _Candidate(other, needed * asked.sum()) if other else None

    def _with(self, question: Question, shape: FittedField, frame: _Frame) -> _Candidate | None:
        """Pressures that fall towards the edge, or rings, where the data leave that open."""
        assert isinstance(shape.family, PressureField)
        scale = _scale(shape, frame)
        frame.budget.spend(shape)
        each = fallen(question, self.tools.fit, shape, frame.measured, scale)
        if each is None:
            return None
        other = self._evaluate(each, shape.family.order, shape.log_ratio, frame)
        return _Candidate(other, ONE_SHEET_WORTH * question.worth * scale) if other else None

    def _splits(self, shape: FittedField) -> list[_Move]:
        """Moves that make two contacts of one: those that stand it best, one after the other."""
        elongated = 0.4  # half the logarithm of the axes' ratio (2.2), from which it may be two
        each = contacts_of(shape)
        if not 0 < len(each) < MAX_CONTACTS:
            return []
        long = np.hypot(each[:, E1], each[:, E2]) > elongated
        crowd = len(each) >= CROWD
        asked = (
            np.arange(len(each)) if shape.misfit > GOOD_MISFIT or crowd else np.flatnonzero(long)
        )
        count = ASKED_OF_CROWD if crowd else 1

        def split(rank: int) -> _Move:
            def move(shape: FittedField, frame: _Frame) -> _Candidate | None:
                ranked = self._halves(shape, asked, frame)
                if rank >= len(ranked):
                    return None
                half, k = ranked[rank]
                gain = LONG_GAIN if long[k] else CROWD_GAIN if crowd else SURE_GAIN
                return _Candidate(half, gain * _scale(shape, frame))

            return move

        return [split(rank) for rank in range(min(count, len(asked)))]

    def _halves(
        self, shape: FittedField, asked: IntArray, frame: _Frame
    ) -> list[tuple[FittedField, int]]:
        """What each contact that is asked makes as two, the best first, and which it is."""
        if self._halved is None or self._halved[0] is not shape:
            assert isinstance(shape.family, PressureField)
            each, order = contacts_of(shape), shape.family.order
            halves = [
                (half, k)
                for k in asked.tolist()
                if (half := self._evaluate(_halved(each, k), order, shape.log_ratio, frame))
            ]
            self._halved = shape, sorted(halves, key=lambda one: one[0].cost)
        return self._halved[1]

    def _escalate(self, shape: FittedField, frame: _Frame) -> _Candidate | None:
        """The same as a level set."""
        free_worth = 100.0  # of a level set
        always = self.shape_model == ShapeModel.LEVEL_SET
        if len(shape.parameters) == 0 or (shape.misfit < SUSPECT_MISFIT and not always):
            return None
        assert isinstance(shape.family, PressureField)
        likeness = np.zeros(len(shape.family.x_m))
        likeness[shape.drawing.nodes] = shape.drawing.enclosed
        each = shape.family.split(shape.parameters)
        level_set = self.tools.level_set.owned_by(
            each[:, [X, Y]] * UNIT_M, shape.family if Channel.MAGNITUDE in frame.measured else None
        )
        parameters = level_set.parameters_of(likeness, each[:, PEAK])
        other = self.tools.fit.evaluate(level_set, parameters, shape.log_ratio, frame.measured)
        worth = -np.inf if always else free_worth * _scale(shape, frame)
        return _Candidate(other, worth) if other else None

    def _deaths(self, shape: FittedField) -> list[_Move]:
        """A move for each contact that is small or lies against another: leave it out."""
        assert isinstance(shape.family, PressureField)
        each = shape.family.split(shape.parameters)
        if len(each) < 2:
            return []
        apart = np.hypot(*(each[:, None, [X, Y]] - each[None, :, [X, Y]]).T) * UNIT_M
        radius = np.exp(each[:, SIZE])
        gap = apart - radius[:, None] - radius[None] + np.diag(np.full(len(each), np.inf))
        asked = np.flatnonzero((radius < SMALL_M) | (gap.min(axis=1) < 0))

        def without(k: int) -> _Move:
            def move(shape: FittedField, frame: _Frame) -> _Candidate | None:
                needless = 15.0  # a contact whose absence costs less is not there
                other = self._left_out(shape, k, frame)
                return _Candidate(other, -needless * _scale(shape, frame)) if other else None

            return move

        return [without(k) for k in asked[np.argsort(radius[asked])]]

    def _each_left_out(self, shape: FittedField, frame: _Frame) -> list[FittedField]:
        if not isinstance(shape.family, PressureField) or shape.family.count < 2:
            return []
        left = [self._left_out(shape, k, frame) for k in range(shape.family.count)]
        return [rest for rest in left if rest is not None]

    def _left_out(self, shape: FittedField, k: int, frame: _Frame) -> FittedField | None:
        assert isinstance(shape.family, PressureField)
        each = np.delete(shape.family.split(shape.parameters), k, axis=0)
        return self._evaluate(each, shape.family.order, shape.log_ratio, frame)

    def _nothing(self, frame: _Frame) -> FittedField:
        none = np.zeros((0, COLUMNS))
        nothing = self._evaluate(none, 0, self.tools.fit.likely, frame)
        assert nothing is not None
        return nothing

    def _evaluate(
        self, each: FloatArray, order: int, log_ratio: float, frame: _Frame
    ) -> FittedField | None:
        family = self.tools.field.of(each, order, fits_peaks=Channel.MAGNITUDE in frame.measured)
        shape = self.tools.fit.evaluate(family, family.join(each), log_ratio, frame.measured)
        if shape is not None:
            frame.budget.spend(shape)
        return shape


_Move: TypeAlias = Callable[[FittedField, _Frame], _Candidate | None]


def _scale(shape: FittedField, frame: _Frame) -> float:
    unit = unit_of_gain(shape, frame.doubt)
    # Many contacts on both sheets that are explained better than noise and model allow for tell
    # that these were overrated, and gains underrated: without it 0.01 of crowds' ICC is lost.
    return unit * min(1.0, shape.misfit**2) if len(shape.residuals) > 1 else unit


def _outlines(measured: Measured) -> Measured:
    return {Channel.STRUCTURE: measured[Channel.STRUCTURE]}


def _in_words(shape: FittedField) -> str:
    if not isinstance(shape.family, PressureField):
        return "level set"
    name = "circle" if shape.family.order < 2 else "ellipse"
    if shape.family.forms == PEAK:
        name = "rounded outline"
    return f"{shape.family.count} {name}{'s' * (shape.family.count != 1)}"


def _halved(each: FloatArray, k: int) -> FloatArray:
    """Contact k as two of half its length, side by side along its longer axis."""
    size, e1, e2 = each[k, [SIZE, E1, E2]]
    elongation = np.hypot(e1, e2)
    angle = np.arctan2(e2, e1) / 2
    # An ellipse of half axes a > b becomes two circles or ellipses of a / 2 and b.
    away = np.exp(size + elongation) / 2 / UNIT_M * np.array([np.cos(angle), np.sin(angle)])
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

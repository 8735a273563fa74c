"""The warm-started fit: from the last frame's shape to the simplest that explains this frame.

The simplest description comes first, and a dearer one only where the data ask for it: circles, one
added at a time where the residual shows that it is missing; ellipses; ellipses with modulated
edges; and, where no few outlines explain the data, a level set. Each such move makes a candidate,
which is refined beside the shape in force and takes its place once it explains the data better by
more than its further parameters would by chance. Contacts that the data do not need are taken away
again.

After a change that the known contacts do not account for, a cold start runs beside the warm one.
Work is spent by the frame's budget; what one frame does not finish, the next one goes on with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from typing import TypeAlias

import numpy as np

from tactomo_models.arrays import FloatArray
from tactomo_models.methods.contact_search import ContactSearch, MissingContact
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scans.changes import Changes
from tactomo_models.scans.stillness import is_still
from tactomo_models.scene.level_set import LevelSet
from tactomo_models.scene.outlines import (
    E1,
    E2,
    MAX_PARAMETERS,
    SIZE,
    UNIT_M,
    Outlines,
    X,
    Y,
    outlines_on,
)
from tactomo_models.scene.shape_fit import Budget, Shape, ShapeFit

GOOD_MISFIT = 1.0  # explained to the noise (discrepancy principle): no further step
SUSPECT_MISFIT = 1.5  # a minimum this bad may be the wrong one
SLACK = 1.1  # contacts that are explained as well as before are not questioned again
TRIALS = 4  # of so many steps that a candidate may take
MAX_CONTACTS = 8
# Gains and losses are in squared misfit, and count by how well the data are explained otherwise.
SURE_GAIN = 30.0  # of a contact: the best of 500 places gains some 15 by noise alone
SMALL_M = 0.006  # contacts of a smaller radius are asked whether they are needed

Propose = Callable[[], FloatArray]  # (K, MAX_PARAMETERS), see `outlines.ellipses_of`


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

    shape: Shape
    gain: float
    trials: int = TRIALS


@dataclass(frozen=True)
class _Frame:
    """What one frame is fitted to, and what the fit may spend.

    Attributes:
        measured: the structure channel's changes.
        budget: compute time.
        propose: asked for contacts to start from; None where nothing proposes any.
    """

    measured: Changes
    budget: Budget
    propose: Propose | None

    @cached_property
    def doubt(self) -> float:
        """Errors that go together look like something that is there: gains count for less."""
        return float(np.sqrt(np.mean(self.measured.variance_inflation)))


class _Tools:
    """What every fit on one sheet shares."""

    def __init__(self, forward: ForwardModel, ratio: float) -> None:
        self.fit = ShapeFit(forward, ratio)
        self.outlines = outlines_on(forward)
        self.level_set = LevelSet(forward)
        self.search = ContactSearch(forward, ratio)


class WarmStartedFit:
    """Keeps the shape of what presses from frame to frame.

    Args:
        forward: the model of the sheet.
        ratio: conductivity of the saturated phase over the bare sheet's.
        shape_model: how a scene may be described.
    """

    def __init__(
        self,
        forward: ForwardModel,
        ratio: float,
        shape_model: ShapeModel = ShapeModel.AS_NEEDED,
    ) -> None:
        self._course = _Course(_Tools(forward, ratio), shape_model)

    @property
    def fit(self) -> ShapeFit:
        """What the shapes are fitted by."""
        return self._course.tools.fit

    def forget(self) -> None:
        """Drop the warm start."""
        self._course = _Course(self._course.tools, self._course.shape_model)

    def follow(
        self, measured: Changes, budget: Budget, propose: Propose | None = None
    ) -> tuple[Shape, str]:
        """Find the shape that explains a frame.

        Args:
            measured: the structure channel's changes.
            budget: compute time that may be spent.
            propose: asked for contacts to start from where there is no shape to go on with; they
                are judged by the data as any other.

        Returns:
            The shape, and in words what it came from.
        """
        return self._course.follow(_Frame(measured, budget, propose))


class _Course:
    """One course of fits from frame to frame; a cold start that runs beside it is another."""

    def __init__(self, tools: _Tools, shape_model: ShapeModel) -> None:
        self.tools, self.shape_model = tools, shape_model
        self._shape: Shape | None = None
        self._settled_on: Changes | None = None  # the frame that the shape is of
        self._tried_misfit = 0.0  # at which all moves were tried on contacts like these
        self._from_nothing = True  # or from the shape of frames before
        self._cold_start: _Course | None = None
        self._start_over()

    def _start_over(self) -> None:
        self._candidate: _Candidate | None = None
        self._moves_tried = 0
        self._moved = False  # whether known contacts were let move, before any is added
        self._settled = False  # whether the shape in force is at its minimum

    def follow(self, frame: _Frame) -> tuple[Shape, str]:
        """Fit one frame more; see `WarmStartedFit.follow`."""
        shape, how = self._start(frame)
        if not shape.converged:
            shape = self._improve(shape, frame)
            self._settled_on = frame.measured
        self._shape = shape
        while self._doubtful(shape):
            shape, how = self._against_cold_start(shape, how, frame)
            if frame.budget.over:
                break
        if not self._doubtful(shape):
            self._cold_start = None
        return shape, f"{how}, {_in_words(shape)}"

    def _doubtful(self, shape: Shape) -> bool:
        """Tell whether a cold start might do better: where the warm one had little to go on."""
        return shape.converged and not self._from_nothing

    def _against_cold_start(self, shape: Shape, how: str, frame: _Frame) -> tuple[Shape, str]:
        """Let a cold start run beside a doubtful shape; the better or the simpler goes on."""
        if self._cold_start is None:
            self._cold_start = _Course(self.tools, self.shape_model)
        other, _ = self._cold_start.follow(frame)
        if not other.converged:
            return shape, how
        self._from_nothing, self._cold_start = True, None
        simpler = len(other.parameters) < len(shape.parameters)
        as_good = other.misfit <= SLACK * max(shape.misfit, GOOD_MISFIT)
        is_better = other.cost <= shape.cost - SURE_GAIN * _scale(shape, frame)
        if not (is_better or (simpler and as_good)):
            return shape, how
        self._start_over()
        self._shape, self._settled_on = other, frame.measured
        self._tried_misfit = other.misfit
        return other, "restarted"

    def _start(self, frame: _Frame) -> tuple[Shape, str]:
        """The last frame's shape where it still holds; else the best of what may be left of it."""
        max_left = 0.25  # of the cost of nothing, that contacts which moved leave to a new frame
        before = self._shape
        if before is None:
            return self._from_scratch(frame)
        shape = self.tools.fit.compare(before, frame.measured)
        still = self._is_still(frame.measured)
        if before.converged and still:
            return replace(shape, converged=True), "still"
        shape = replace(shape, converged=False)
        # What did not explain its own frame has no claim on the next one.
        suspect = before.misfit > SUSPECT_MISFIT and not still
        if suspect or shape.misfit > max(SUSPECT_MISFIT, 2 * before.misfit):
            self._start_over()
            if suspect:
                self._tried_misfit = 0.0
            scratch, how = self._from_scratch(frame)
            left_out = self._each_left_out(shape, frame)
            best = min([shape, *left_out, scratch], key=lambda s: s.cost)
            # What was only moved explains most at once; what was found elsewhere may mislead.
            nothing_cost = self._nothing(frame).cost
            self._from_nothing = best is scratch or best.cost < max_left * nothing_cost
            if best is not shape:  # else they moved: once they have been followed, all is as it was
                self._tried_misfit = 0.0
            return best, how if best is scratch else "warm start"
        if before.converged:  # all was done, but for other data
            self._moved = self._settled = False
        if self._candidate is not None:
            other = self.tools.fit.compare(self._candidate.shape, frame.measured)
            self._candidate = replace(self._candidate, shape=replace(other, converged=False))
        return shape, "warm start"

    def _from_scratch(self, frame: _Frame) -> tuple[Shape, str]:
        """What is proposed, where that explains something; else nothing at all."""
        proposed_order = 2  # ellipses
        nothing = self._nothing(frame)
        if frame.propose is not None and len(each := frame.propose()[:MAX_CONTACTS]):
            proposed = self._evaluate(each, proposed_order, self.tools.fit.likely, frame)
            if proposed is not None and proposed.cost < nothing.cost:
                return proposed, "proposed"
        return nothing, "cold start"

    def _is_still(self, measured: Changes) -> bool:
        """Tell whether this frame differs by noise alone from the one that the shape is of."""
        return self._settled_on is not None and is_still(self._settled_on, measured)

    def _improve(self, shape: Shape, frame: _Frame) -> Shape:
        """Refine, and try one candidate after another, until none is left or the budget ends."""
        noise = 3.0  # what a parameter gains by following a new frame's noise, at most
        budget = frame.budget
        while True:
            if self._candidate is not None:
                shape = self._judge(self._candidate, shape, frame)
            elif self._moved and not self._settled and (early := self._early_birth(shape, frame)):
                self._candidate = early
            elif not self._settled:
                before, shape = shape, self._refined(shape, frame)
                # A budget of a step or so a frame lets it follow each frame's noise, no more.
                follows = before.cost - shape.cost < noise * len(shape.parameters)
                self._settled = shape.converged or (budget.over and follows)
                self._moved = True
            elif shape.misfit <= SLACK * self._tried_misfit or not self._propose(shape, frame):
                self._tried_misfit = max(self._tried_misfit, shape.misfit)
                return replace(shape, converged=True)
            if budget.over:  # one thing at least is done in every frame
                return replace(shape, converged=False)

    def _refined(self, shape: Shape, frame: _Frame) -> Shape:
        steps = 4  # of a refinement, before what it leads to is judged
        if len(shape.parameters) == 0:
            return replace(shape, converged=True)
        # Few parameters are better known at the minimum; many would begin to explain the noise.
        good = 0.0 if isinstance(shape.family, Outlines) else GOOD_MISFIT
        return self.tools.fit.refine(shape, frame.measured, frame.budget, good, steps)

    def _judge(self, candidate: _Candidate, shape: Shape, frame: _Frame) -> Shape:
        """Refine a candidate: it takes the shape's place, is given up, or goes on."""
        refined = self._refined(candidate.shape, frame)
        if refined.cost < shape.cost - candidate.gain:
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

    def _propose(self, shape: Shape, frame: _Frame) -> bool:
        """Set the next candidate beside a shape at its minimum; False when all were tried."""
        moves = self._moves(shape)
        while self._candidate is None and self._moves_tried < len(moves):
            self._candidate = moves[self._moves_tried](shape, frame)
            if self._candidate is None:
                self._moves_tried += 1
        return self._candidate is not None

    def _moves(self, shape: Shape) -> list[_Move]:
        if not isinstance(shape.family, Outlines):
            return []
        if self.shape_model == ShapeModel.LEVEL_SET:
            return [self._birth, self._escalate]
        form = [self._of_higher_order, self._split, self._birth_anywhere]
        if shape.misfit <= GOOD_MISFIT:
            form = [self._of_higher_order] if shape.family.order == 0 else []
        free = [self._escalate] if self.shape_model == ShapeModel.AS_NEEDED else []
        return [self._birth, *form, *free, *self._deaths(shape)]

    def _early_birth(self, shape: Shape, frame: _Frame) -> _Candidate | None:
        """A further contact where that much is left that it need not wait for the others."""
        return self._birth(shape, frame) if shape.misfit > SUSPECT_MISFIT else None

    def _birth(self, shape: Shape, frame: _Frame) -> _Candidate | None:
        """A further contact, away from those that are known."""
        near_m = 0.012  # what is missing this near an outline is more likely a part of its form
        return self._with_another(shape, frame, near_m)

    def _birth_anywhere(self, shape: Shape, frame: _Frame) -> _Candidate | None:
        return self._with_another(shape, frame, -np.inf)

    def _with_another(self, shape: Shape, frame: _Frame, least_gap_m: float) -> _Candidate | None:
        smallest_m = 0.003  # radius below which it is an error of the model, not a contact
        if not isinstance(shape.family, Outlines) or shape.family.count == MAX_CONTACTS:
            return None
        found = self.tools.search.best(shape, frame.measured.weight)
        frame.budget.spend(shape)  # about what a search takes, too
        each = shape.family.split(shape.parameters)
        worth = SURE_GAIN * _scale(shape, frame)
        # Circles leave much unexplained that a better form will explain: no contact is made of it.
        sure = worth * (2 if shape.family.order < 2 and len(each) else 1)
        if found.gain < sure or found.radius_m < smallest_m or _gap_m(each, found) <= least_gap_m:
            return None
        further = np.zeros((1, MAX_PARAMETERS))
        further[0, [X, Y, SIZE]] = (
            found.x_m / UNIT_M,
            found.y_m / UNIT_M,
            np.log(max(found.radius_m, SMALL_M)),
        )
        order = shape.family.order
        other = self._evaluate(np.vstack([each, further]), order, shape.log_ratio, frame)
        return _Candidate(other, worth) if other else None

    def _of_higher_order(self, shape: Shape, frame: _Frame) -> _Candidate | None:
        worth = 2.5  # of one more parameter of a form
        assert isinstance(shape.family, Outlines)
        if shape.family.order == 4 or shape.family.count == 0:
            return None
        order = {0: 1, 1: 2, 2: 4}[shape.family.order]
        each = shape.family.split(shape.parameters)
        other = self._evaluate(each, order, shape.log_ratio, frame)
        if other is None:
            return None
        further = len(other.parameters) - len(shape.parameters)
        return _Candidate(other, worth * further * _scale(shape, frame))

    def _split(self, shape: Shape, frame: _Frame) -> _Candidate | None:
        """Two contacts for one, of the contact that stands it best."""
        assert isinstance(shape.family, Outlines)
        if shape.family.count == MAX_CONTACTS:
            return None
        each, order = shape.family.split(shape.parameters), shape.family.order
        halved = [
            self._evaluate(_halved(each, k), order, shape.log_ratio, frame)
            for k in range(len(each))
        ]
        best = min((h for h in halved if h), key=lambda half: half.cost, default=None)
        return _Candidate(best, SURE_GAIN * _scale(shape, frame)) if best else None

    def _escalate(self, shape: Shape, frame: _Frame) -> _Candidate | None:
        """The same as a level set."""
        free_worth = 100.0  # of a level set
        always = self.shape_model == ShapeModel.LEVEL_SET
        if len(shape.parameters) == 0 or (shape.misfit < SUSPECT_MISFIT and not always):
            return None
        level_set = self.tools.level_set
        parameters = level_set.parameters_of(shape.pressed)
        other = self.tools.fit.evaluate(level_set, parameters, shape.log_ratio, frame.measured)
        worth = -np.inf if always else free_worth * _scale(shape, frame)
        return _Candidate(other, worth) if other else None

    def _deaths(self, shape: Shape) -> list[_Move]:
        """A move for each contact that is small or lies against another: leave it out."""
        assert isinstance(shape.family, Outlines)
        each = shape.family.split(shape.parameters)
        if len(each) < 2:
            return []
        apart = np.hypot(*(each[:, None, [X, Y]] - each[None, :, [X, Y]]).T) * UNIT_M
        radius = np.exp(each[:, SIZE])
        gap = apart - radius[:, None] - radius[None] + np.diag(np.full(len(each), np.inf))
        asked = np.flatnonzero((radius < SMALL_M) | (gap.min(axis=1) < 0))

        def without(k: int) -> _Move:
            def move(shape: Shape, frame: _Frame) -> _Candidate | None:
                needless = 15.0  # a contact whose absence costs less is not there
                other = self._left_out(shape, k, frame)
                return _Candidate(other, -needless * _scale(shape, frame)) if other else None

            return move

        return [without(k) for k in asked[np.argsort(radius[asked])]]

    def _each_left_out(self, shape: Shape, frame: _Frame) -> list[Shape]:
        if not isinstance(shape.family, Outlines) or shape.family.count < 2:
            return []
        left = [self._left_out(shape, k, frame) for k in range(shape.family.count)]
        return [rest for rest in left if rest is not None]

    def _left_out(self, shape: Shape, k: int, frame: _Frame) -> Shape | None:
        assert isinstance(shape.family, Outlines)
        each = np.delete(shape.family.split(shape.parameters), k, axis=0)
        return self._evaluate(each, shape.family.order, shape.log_ratio, frame)

    def _nothing(self, frame: _Frame) -> Shape:
        none = np.zeros((0, MAX_PARAMETERS))
        nothing = self._evaluate(none, 0, self.tools.fit.likely, frame)
        assert nothing is not None
        return nothing

    def _evaluate(
        self, each: FloatArray, order: int, log_ratio: float, frame: _Frame
    ) -> Shape | None:
        family = self.tools.outlines.of(order, len(each))
        shape = self.tools.fit.evaluate(family, family.join(each), log_ratio, frame.measured)
        if shape is not None:
            frame.budget.spend(shape)
        return shape


_Move: TypeAlias = Callable[[Shape, _Frame], _Candidate | None]


def _scale(shape: Shape, frame: _Frame) -> float:
    """What one unit of squared misfit means, by what a shape leaves unexplained."""
    return max(frame.doubt, shape.misfit**2 / 2)


def _in_words(shape: Shape) -> str:
    if not isinstance(shape.family, Outlines):
        return "level set"
    name = {0: "circle", 1: "circle", 2: "ellipse", 4: "rounded outline"}[shape.family.order]
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
    half[E1:] = 0.0
    one, other = half.copy(), half
    one[[X, Y]] += away
    other[[X, Y]] -= away
    return np.vstack([np.delete(each, k, axis=0), one, other])


def _gap_m(each: FloatArray, found: MissingContact) -> float:
    """Distance of a missing contact's centre from the nearest outline, about."""
    apart = np.hypot(each[:, X] * UNIT_M - found.x_m, each[:, Y] * UNIT_M - found.y_m)
    return float(np.min(apart - np.exp(each[:, SIZE]), initial=np.inf))

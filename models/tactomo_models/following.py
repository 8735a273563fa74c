"""Following what presses: from nothing or the last frame to the simplest shape that explains it.

The simplest description comes first, and a dearer one only where the data ask for it: circles, one
added at a time where the residual shows that it is missing; ellipses; ellipses with modulated
edges; and, where no few outlines explain the data, a level set. Each such move makes a rival of
the shape in force, which is refined beside it and takes its place once it explains the data better
by more than its further parameters would by chance. Contacts that the data do not need are taken
away again.

After a change that the known contacts do not account for, a cold start runs beside the warm one.
Work is spent by the frame's budget; what one frame does not finish, the next one goes on with.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from tactomo_models.forward import ForwardModel
from tactomo_models.levelset import LevelSet
from tactomo_models.outlines import (
    E1,
    E2,
    MOST_PARAMETERS,
    SIZE,
    UNIT_M,
    Outlines,
    X,
    Y,
    outlines_on,
)
from tactomo_models.search import Candidate, ContactSearch
from tactomo_models.shape_fit import Budget, Shape, ShapeFit

FloatArray = NDArray[np.float64]

GOOD_MISFIT = 1.0  # explained to the noise (discrepancy principle): no further step
SUSPECT_MISFIT = 1.5  # a minimum this bad may be the wrong one
STILL = 1.5  # mean square of a still scene's differences over their noise: 1, give or take 0.1
SLACK = 1.1  # contacts that are explained as well as before are not questioned again
MOST_LEFT = 0.25  # of the cost of nothing, that contacts which moved leave to a new frame
STEPS = 4  # of a refinement, before what it leads to is judged
TRIALS = 4  # of so many steps that a rival may take
MOST_CONTACTS = 8
# Gains and losses are in squared misfit, and count by how well the data are explained otherwise.
SURE_GAIN = 30.0  # of a contact: the best of 500 places gains some 15 by noise alone
WORTH = 2.5  # of one more parameter of a form
FREE_WORTH = 100.0  # of a level set
NEEDLESS = 15.0  # a contact whose absence costs less is not there
NOISE = 3.0  # what a parameter gains by following a new frame's noise, at most
NEAR_M = 0.012  # what is missing this near an outline is more likely a part of its form
SMALLEST_M = 0.003  # radius below which it is an error of the model, not a contact
SMALL_M = 0.006  # contacts of a smaller radius are asked whether they are needed
PROPOSED_ORDER = 2  # ellipses

Propose = Callable[[], FloatArray]  # (K, MOST_PARAMETERS), see `outlines.ellipses_of`


class Freedom(Enum):
    """How a scene may be described."""

    AS_NEEDED = "as needed"
    OUTLINES = "outlines"
    LEVEL_SET = "level set"


@dataclass(frozen=True)
class _Rival:
    """A shape that is refined beside the one in force.

    Attributes:
        shape: as refined so far.
        gain: by how much its cost must be below that of the shape in force, to take its place.
        trials: refinements that it may still have.
    """

    shape: Shape
    gain: float
    trials: int = TRIALS


class ShapeFollower:
    """Keeps the shape of what presses from frame to frame.

    Args:
        forward: the model of the sheet.
        ratio: conductivity of the saturated phase over the bare sheet's.
    """

    def __init__(self, forward: ForwardModel, ratio: float) -> None:
        self.fit = ShapeFit(forward, ratio)
        self._freedom = Freedom.AS_NEEDED
        self._budget = Budget(0.0)
        self._outlines = outlines_on(forward)
        self._level_set = LevelSet(forward)
        self._propose: Propose | None = None
        self._search = ContactSearch(forward, ratio)
        self.forget()

    def forget(self) -> None:
        """Drop the warm start."""
        self._shape: Shape | None = None
        self._settled_data = np.zeros(0)  # of the frame that the shape is of
        self._tried_misfit = 0.0  # at which all moves were tried on contacts like these
        self._from_nothing = True  # or from the shape of frames before
        self._understudy: ShapeFollower | None = None
        self._start_over()

    def _start_over(self) -> None:
        self._rival: _Rival | None = None
        self._moves_tried = 0
        self._moved = False  # whether known contacts were let move, before any is added
        self._settled = False  # whether the shape in force is at its minimum

    def follow(
        self,
        change: FloatArray,
        weight: FloatArray,
        spread: FloatArray,
        noise: FloatArray,
        budget_s: float,
        freedom: Freedom = Freedom.AS_NEEDED,
        propose: Propose | None = None,
    ) -> tuple[Shape, str]:
        """Find the shape that explains a frame.

        Args:
            change: (M,) relative voltage changes.
            weight: (M,) their inverse standard deviations.
            spread: (M,) factor on variances, see `ShapeFit.covariance`.
            noise: (M,) variances of what differs between two frames of a still scene, of each.
            budget_s: compute time, by a model of the work.
            freedom: how the shape may be described.
            propose: asked for contacts to start from where there is no shape to go on with; they
                are judged by the data as any other.

        Returns:
            The shape, and in words what it came from.
        """
        self._data, self._noise, self._propose = (change, weight), noise, propose
        # Errors that go together look like something that is there: gains count for less.
        self._doubt = float(np.sqrt(np.mean(spread)))
        if freedom != self._freedom:
            self.forget()
            self._freedom = freedom
        self._budget = Budget(budget_s)
        shape, how = self._start()
        if not shape.converged:
            shape = self._improve(shape, self._budget)
            self._settled_data = change
        self._shape = shape
        while self._doubtful(shape):
            shape, how = self._challenged_from_nothing(shape, how, spread, noise)
            if self._budget.over:
                break
        if not self._doubtful(shape):
            self._understudy = None
        return shape, f"{how}, {self._in_words(shape)}"

    def _doubtful(self, shape: Shape) -> bool:
        """Tell whether a cold start might do better: where the warm one had little to go on."""
        return shape.converged and not self._from_nothing

    def _challenged_from_nothing(
        self, shape: Shape, how: str, spread: FloatArray, noise: FloatArray
    ) -> tuple[Shape, str]:
        """Let a cold start run beside a doubtful shape; the better or the simpler goes on."""
        if self._understudy is None:
            self._understudy = copy(self)
            self._understudy.forget()
        left_s = self._budget.left_s
        other, _ = self._understudy.follow(
            *self._data, spread, noise, left_s, self._freedom, self._propose
        )
        self._budget.left_s = self._understudy._budget.left_s
        if not other.converged:
            return shape, how
        self._from_nothing, self._understudy = True, None
        simpler = len(other.parameters) < len(shape.parameters)
        as_good = other.misfit <= SLACK * max(shape.misfit, GOOD_MISFIT)
        if other.cost > shape.cost - SURE_GAIN * self._scale(shape) and not (simpler and as_good):
            return shape, how
        self._start_over()
        self._shape, self._settled_data, self._tried_misfit = other, self._data[0], other.misfit
        return other, "restarted"

    def _start(self) -> tuple[Shape, str]:
        """The last frame's shape where it still holds; else the best of what may be left of it."""
        before = self._shape
        if before is None:
            return self._from_scratch()
        shape = self.fit.compare(before, *self._data)
        still = self._is_still()
        if before.converged and still:
            return replace(shape, converged=True), "still"
        shape = replace(shape, converged=False)
        # What did not explain its own frame has no claim on the next one.
        suspect = before.misfit > SUSPECT_MISFIT and not still
        if suspect or shape.misfit > max(SUSPECT_MISFIT, 2 * before.misfit):
            self._start_over()
            if suspect:
                self._tried_misfit = 0.0
            scratch, how = self._from_scratch()
            best = min([shape, *self._each_left_out(shape), scratch], key=lambda s: s.cost)
            # What was only moved explains most at once; what was found elsewhere may mislead.
            nothing_cost = self._nothing().cost
            self._from_nothing = best is scratch or best.cost < MOST_LEFT * nothing_cost
            if best is not shape:  # else they moved: once they have been followed, all is as it was
                self._tried_misfit = 0.0
            return best, how if best is scratch else "warm start"
        if before.converged:  # all was done, but for other data
            self._moved = self._settled = False
        if self._rival is not None:
            rival = self.fit.compare(self._rival.shape, *self._data)
            self._rival = replace(self._rival, shape=replace(rival, converged=False))
        return shape, "warm start"

    def _from_scratch(self) -> tuple[Shape, str]:
        """What is proposed, where that explains something; else nothing at all."""
        nothing = self._nothing()
        if self._propose is not None and len(each := self._propose()[:MOST_CONTACTS]):
            proposed = self._evaluate(each, PROPOSED_ORDER, self.fit.likely)
            if proposed is not None and proposed.cost < nothing.cost:
                return proposed, "proposed"
        return nothing, "cold start"

    def _is_still(self) -> bool:
        """Tell whether this frame differs by noise alone from the one that the shape is of."""
        valid = self._data[1] > 0
        difference = (self._data[0] - self._settled_data)[valid]
        return float(np.mean(difference**2 / (2 * self._noise[valid]))) < STILL

    def _improve(self, shape: Shape, budget: Budget) -> Shape:
        """Refine, and try one rival after another, until none is left or the budget ends."""
        while True:
            if self._rival is not None:
                shape = self._judge(self._rival, shape, budget)
            elif self._moved and not self._settled and (rival := self._missing(shape)):
                self._rival = rival
            elif not self._settled:
                before, shape = shape, self._refined(shape, budget)
                # A budget of a step or so a frame lets it follow each frame's noise, no more.
                follows = before.cost - shape.cost < NOISE * len(shape.parameters)
                self._settled = shape.converged or (budget.over and follows)
                self._moved = True
            elif shape.misfit <= SLACK * self._tried_misfit or not self._challenge(shape):
                self._tried_misfit = max(self._tried_misfit, shape.misfit)
                return replace(shape, converged=True)
            if budget.over:  # one thing at least is done in every frame
                return replace(shape, converged=False)

    def _refined(self, shape: Shape, budget: Budget) -> Shape:
        if len(shape.parameters) == 0:
            return replace(shape, converged=True)
        # Few parameters are better known at the minimum; many would begin to explain the noise.
        good = 0.0 if isinstance(shape.family, Outlines) else GOOD_MISFIT
        return self.fit.refine(shape, *self._data, budget, good, STEPS)

    def _judge(self, rival: _Rival, shape: Shape, budget: Budget) -> Shape:
        """Refine a rival: it takes the shape's place, is given up, or goes on."""
        refined = self._refined(rival.shape, budget)
        if refined.cost < shape.cost - rival.gain:
            self._start_over()
            self._tried_misfit = 0.0
            self._settled, self._moved = refined.converged, True
            return refined
        trials = rival.trials - (not budget.over)  # one that was cut short does not count
        if refined.converged or trials == 0:
            self._rival = None
            self._moves_tried += 1
        else:
            self._rival = replace(rival, shape=refined, trials=trials)
        return shape

    def _challenge(self, shape: Shape) -> bool:
        """Set the next rival against a shape that is at its minimum; False when all were tried."""
        moves = self._moves(shape)
        while self._rival is None and self._moves_tried < len(moves):
            self._rival = moves[self._moves_tried](shape)
            if self._rival is None:
                self._moves_tried += 1
        return self._rival is not None

    def _moves(self, shape: Shape) -> list[Callable[[Shape], _Rival | None]]:
        if not isinstance(shape.family, Outlines):
            return []
        if self._freedom == Freedom.LEVEL_SET:
            return [self._grown, self._freed]
        form = [self._of_higher_order, self._split, self._grown_anywhere]
        if shape.misfit <= GOOD_MISFIT:
            form = [self._of_higher_order] if shape.family.order == 0 else []
        free = [self._freed] if self._freedom == Freedom.AS_NEEDED else []
        return [self._grown, *form, *free, *self._without_needless(shape)]

    def _missing(self, shape: Shape) -> _Rival | None:
        """A further contact where that much is left that it need not wait for the others."""
        return self._grown(shape) if shape.misfit > SUSPECT_MISFIT else None

    def _grown(self, shape: Shape) -> _Rival | None:
        """A further contact, away from those that are known."""
        return self._with_candidate(shape, lambda gap_m: gap_m > NEAR_M)

    def _grown_anywhere(self, shape: Shape) -> _Rival | None:
        return self._with_candidate(shape, lambda gap_m: True)

    def _with_candidate(self, shape: Shape, may_be: Callable[[float], bool]) -> _Rival | None:
        if not isinstance(shape.family, Outlines) or shape.family.count == MOST_CONTACTS:
            return None
        found = self._search.best(shape, self._data[1])
        self._budget.spend(shape)  # about what a search takes, too
        each = shape.family.split(shape.parameters)
        # Circles leave much unexplained that a better form will explain: no contact is made of it.
        sure = SURE_GAIN * self._scale(shape) * (2 if shape.family.order < 2 and len(each) else 1)
        if found.gain < sure or found.radius_m < SMALLEST_M or not may_be(_gap_m(each, found)):
            return None
        further = np.zeros((1, MOST_PARAMETERS))
        further[0, [X, Y, SIZE]] = (
            found.x_m / UNIT_M,
            found.y_m / UNIT_M,
            np.log(max(found.radius_m, SMALL_M)),
        )
        rival = self._evaluate(np.vstack([each, further]), shape.family.order, shape.log_ratio)
        return _Rival(rival, SURE_GAIN * self._scale(shape)) if rival else None

    def _of_higher_order(self, shape: Shape) -> _Rival | None:
        assert isinstance(shape.family, Outlines)
        if shape.family.order == 4 or shape.family.count == 0:
            return None
        order = {0: 1, 1: 2, 2: 4}[shape.family.order]
        rival = self._evaluate(shape.family.split(shape.parameters), order, shape.log_ratio)
        if rival is None:
            return None
        further = len(rival.parameters) - len(shape.parameters)
        return _Rival(rival, WORTH * further * self._scale(shape))

    def _split(self, shape: Shape) -> _Rival | None:
        """Two contacts for one, of the contact that stands it best."""
        assert isinstance(shape.family, Outlines)
        if shape.family.count == MOST_CONTACTS:
            return None
        each = shape.family.split(shape.parameters)
        halved = [
            self._evaluate(_halved(each, k), shape.family.order, shape.log_ratio)
            for k in range(len(each))
        ]
        best = min((h for h in halved if h), key=lambda half: half.cost, default=None)
        return _Rival(best, SURE_GAIN * self._scale(shape)) if best else None

    def _freed(self, shape: Shape) -> _Rival | None:
        """The same as a level set."""
        always = self._freedom == Freedom.LEVEL_SET
        if len(shape.parameters) == 0 or (shape.misfit < SUSPECT_MISFIT and not always):
            return None
        parameters = self._level_set.parameters_of(shape.pressed)
        rival = self.fit.evaluate(self._level_set, parameters, shape.log_ratio, *self._data)
        return (
            _Rival(rival, -np.inf if always else FREE_WORTH * self._scale(shape)) if rival else None
        )

    def _without_needless(self, shape: Shape) -> list[Callable[[Shape], _Rival | None]]:
        """A move for each contact that is small or lies against another."""
        assert isinstance(shape.family, Outlines)
        each = shape.family.split(shape.parameters)
        if len(each) < 2:
            return []
        apart = np.hypot(*(each[:, None, [X, Y]] - each[None, :, [X, Y]]).T) * UNIT_M
        radius = np.exp(each[:, SIZE])
        gap = apart - radius[:, None] - radius[None] + np.diag(np.full(len(each), np.inf))
        asked = np.flatnonzero((radius < SMALL_M) | (gap.min(axis=1) < 0))

        def without(k: int) -> Callable[[Shape], _Rival | None]:
            def move(shape: Shape) -> _Rival | None:
                rival = self._left_out(shape, k)
                return _Rival(rival, -NEEDLESS * self._scale(shape)) if rival else None

            return move

        return [without(k) for k in asked[np.argsort(radius[asked])]]

    def _each_left_out(self, shape: Shape) -> list[Shape]:
        if not isinstance(shape.family, Outlines) or shape.family.count < 2:
            return []
        left = [self._left_out(shape, k) for k in range(shape.family.count)]
        return [rest for rest in left if rest is not None]

    def _left_out(self, shape: Shape, k: int) -> Shape | None:
        assert isinstance(shape.family, Outlines)
        each = np.delete(shape.family.split(shape.parameters), k, axis=0)
        return self._evaluate(each, shape.family.order, shape.log_ratio)

    def _nothing(self) -> Shape:
        nothing = self._evaluate(np.zeros((0, MOST_PARAMETERS)), 0, self.fit.likely)
        assert nothing is not None
        return nothing

    def _evaluate(self, each: FloatArray, order: int, log_ratio: float) -> Shape | None:
        family = self._outlines.of(order, len(each))
        shape = self.fit.evaluate(family, family.join(each), log_ratio, *self._data)
        if shape is not None:
            self._budget.spend(shape)
        return shape

    def _scale(self, shape: Shape) -> float:
        """What one unit of squared misfit means, by what a shape leaves unexplained."""
        return max(self._doubt, shape.misfit**2 / 2)

    def _in_words(self, shape: Shape) -> str:
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


def _gap_m(each: FloatArray, candidate: Candidate) -> float:
    """Distance of a candidate's centre from the nearest outline, about."""
    apart = np.hypot(each[:, X] * UNIT_M - candidate.x_m, each[:, Y] * UNIT_M - candidate.y_m)
    return float(np.min(apart - np.exp(each[:, SIZE]), initial=np.inf))

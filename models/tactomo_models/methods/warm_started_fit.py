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

from dataclasses import replace

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.methods.joint_fit import (
    FOLLOWED,
    QUESTIONS,
    JointFit,
    Question,
    contacts_of,
)
from tactomo_models.methods.moves import (
    CROWD,
    GOOD_MISFIT,
    MANY,
    MAX_CONTACTS,
    SUSPECT_MISFIT,
    Candidate,
    Frame,
    Moves,
    Propose,
    ShapeModel,
    scale_of,
)
from tactomo_models.scans.stillness import Since, are_still
from tactomo_models.scene.drawing import Drawing
from tactomo_models.scene.field_account import Doubt
from tactomo_models.scene.field_fit import COLD_S, Budget, FieldFit, FittedField, Measured
from tactomo_models.scene.parameters import COLUMNS, EDGE, HOLE, PEAK, X, Y
from tactomo_models.scene.pressure_field import PressureField

STEPS = 4  # of a refinement, before what it leads to is judged
SLACK = 1.1  # contacts that are explained as well as before are not questioned again


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
        self._moves = Moves(fit, shape_model, questions)
        self._course = _Course(self._moves)
        self._joint = JointFit(fit, self._moves.field, questions)

    @property
    def typical_peak(self) -> float:
        """Peak that a proposed contact starts with, in the field's unit."""
        return self._moves.field.typical_peak

    def forget(self) -> None:
        """Drop the warm start."""
        self._course = _Course(self._moves)
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
            return self._course.follow(Frame(measured, budget, propose))
        # The saturating sheet shows outlines best, and alone it costs half: what is there and of
        # what form is found on it, and then all sheets judge together. In a crowd, what one sheet
        # takes for one contact may be two on the other: there both search.
        every = Frame(measured, budget, propose)
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

    def __init__(self, moves: Moves) -> None:
        self._moves, self._fit = moves, moves.fit
        self._shape: FittedField | None = None
        self._settled_on: Measured = {}  # the frame that the shape is of
        self._since: Since | None = None  # what has come since, where no other sheet judges that
        self._tried_misfit = 0.0  # at which all moves were tried on contacts like these
        self.doubts: dict[int, Doubt] = {}  # of contacts like these, by what is in doubt
        self._adopted: Drawing | None = None
        self._earlier = np.zeros((0, COLUMNS))  # contacts of the frame before the last
        self._start_over()

    def _start_over(self) -> None:
        self._candidate: Candidate | None = None
        self._moves_tried = 0
        self._moved = False  # whether known contacts were let move, before any is added
        self._settled = False  # whether the shape in force is at its minimum
        self._early = True  # whether a contact may be added before that

    def follow(self, frame: Frame) -> tuple[FittedField, str]:
        """Fit one frame more; see `WarmStartedFit.follow`."""
        shape, how = self._start(frame)
        if not shape.converged:
            shape = self._improve(shape, frame)
            self._settled_on, self._since = frame.measured, None
            if shape.converged and shape.jacobian is not None:
                precision, _ = self._fit.prior(shape)
                self._since = Since(frame.measured, shape.jacobian, precision)
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
            shape = joint if crowded else self._moves.outlines_of(joint, sheets)
            if crowded != self.searches_both:  # a crowd is searched anew, others are as they were
                self._start_over()
                self._moved = self._settled = True
                self._tried_misfit = 0.0 if crowded else shape.misfit
                self._settled_on = sheets
                settled &= not crowded
            self._shape = replace(shape, converged=settled)
            self._adopted, self._since = joint.drawing, None
        return self._shape.drawing

    def _start(self, frame: Frame) -> tuple[FittedField, str]:
        """The last frame's shape where it still holds; else the best of what may be left of it."""
        before = self._shape
        if before is not None and len(before.solutions) > len(frame.measured):  # a scan was lost
            known = isinstance(before.family, PressureField)
            before = self._moves.outlines_of(before, frame.measured) if known else None
        if before is None:
            return self._from_scratch(frame)
        shape = self._fit.compare(before, frame.measured)
        still = are_still(self._settled_on, frame.measured)
        if still and before.converged and self._since is not None:
            still = not self._since.shows_change(frame.measured)
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
            joined = self._moves.joined(shape, frame)
            left_out = self._moves.each_left_out(joined, frame)
            best = min([shape, joined, *left_out, scratch], key=lambda s: s.cost)
            if best is not shape:  # else they moved: once they have been followed, all is as it was
                self._tried_misfit = 0.0
            return best, how if best is scratch else "warm start"
        if before.converged:  # all was done, but for other data
            self._moved = self._settled = False
            self._early = True
        if self._candidate is not None:
            other = self._fit.compare(self._candidate.shape, frame.measured)
            self._candidate = replace(self._candidate, shape=replace(other, converged=False))
        return shape, "warm start"

    def _gone_on(self, shape: FittedField, frame: Frame) -> FittedField:
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
        moved = self._fit.evaluate(shape.family, parameters, shape.log_ratio, frame.measured)
        if moved is None:
            return shape
        frame.budget.spend(moved)
        return moved if moved.cost < shape.cost else shape

    def _from_scratch(self, frame: Frame) -> tuple[FittedField, str]:
        """What is proposed, where that explains something; else nothing at all."""
        proposed_order = 2  # ellipses
        nothing = self._moves.nothing(frame)
        frame.budget.left_s -= COLD_S
        if frame.propose is not None and len(each := frame.propose()[:MAX_CONTACTS]):
            proposed = self._moves.evaluate(each, proposed_order, self._fit.likely, frame)
            if proposed is not None and proposed.cost < nothing.cost:
                return proposed, "proposed"
        return self._moves.joined(nothing, frame), "cold start"

    def _improve(self, shape: FittedField, frame: Frame) -> FittedField:
        """Refine, and try one candidate after another, until none is left or the budget ends."""
        budget = frame.budget
        while True:
            if self._candidate is not None:
                shape = self._judge(self._candidate, shape, frame)
            elif self._is_crowding(shape) and (early := self._moves.birth(shape, frame)):
                self._candidate = early
            elif not self._settled:
                before, shape = shape, self._refined(shape, frame, STEPS)
                # A budget of a step or so a frame lets it follow each frame's noise, no more.
                follows = before.cost - shape.cost < FOLLOWED * len(shape.parameters)
                self._settled = shape.converged or (budget.over and follows)
                self._moved = True
            elif shape.misfit <= SLACK * self._tried_misfit or not self._propose(shape, frame):
                self._tried_misfit = max(self._tried_misfit, shape.misfit)
                return replace(shape, converged=True)
            if budget.over:  # one thing at least is done in every frame
                return replace(shape, converged=False)

    def _is_crowding(self, shape: FittedField) -> bool:
        """Whether that much is left that a further contact need not wait for the others."""
        waits = self._moved and not self._settled
        return self._early and waits and shape.misfit > SUSPECT_MISFIT

    def _refined(self, shape: FittedField, frame: Frame, steps: int) -> FittedField:
        if len(shape.parameters) == 0:
            return replace(shape, converged=True)
        # Few parameters are better known at the minimum; many would begin to explain the noise.
        good = 0.0 if isinstance(shape.family, PressureField) else GOOD_MISFIT
        return self._fit.refine(shape, frame.measured, frame.budget, good, steps)

    def _judge(self, candidate: Candidate, shape: FittedField, frame: Frame) -> FittedField:
        """Refine a candidate: it takes the shape's place, is given up, or goes on."""
        refined, hopeless = candidate.shape, False
        for _ in range(STEPS):
            refined = self._refined(refined, frame, 1)
            hopeless = self._is_hopeless(refined, shape, candidate)
            if refined.converged or hopeless or frame.budget.over:
                break
        wins = refined.cost < shape.cost - candidate.gain
        if wins and self._settled_on is not frame.measured and len(shape.parameters):
            # What follows this frame's noise must not win by that alone.
            shape = self._fit.refine(shape, frame.measured, frame.budget, 0.0, 1)
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
        if refined.converged or hopeless or trials == 0:
            self._candidate = None
            self._moves_tried += self._settled
            self._early = self._settled  # what came too early is tried again at the minimum
        else:
            self._candidate = replace(candidate, shape=refined, trials=trials)
        return shape

    def _is_hopeless(self, refined: FittedField, shape: FittedField, candidate: Candidate) -> bool:
        """Whether a candidate would not win with all that its next steps leave to be gained.

        It saves a third to two thirds of a cold start of four contacts and more. Among many, whose
        contacts have far to go, a step foresees too little: believed, it loses a contact in two of
        twelve crowds that twice as much finds; four times and no end find no more, nor do two of
        four to six contacts, at a fifth more time.
        """
        count = len(contacts_of(shape))
        if refined.jacobian is None or count < CROWD:
            return False
        foreseen = (2.0 if count > MANY else 1.0) * self._fit.foreseen(refined)
        return refined.cost - foreseen > shape.cost - candidate.gain

    def _doubt(self, shape: FittedField, other: FittedField, gain: float, frame: Frame) -> None:
        """Remember another account of the same contacts, as likely as the data leave it."""
        if len(one := contacts_of(shape)) != len(two := contacts_of(other)):
            return
        if not (one[:, EDGE:] != two[:, EDGE:]).any():
            return
        halves = (other.cost + gain - shape.cost) / 2 / scale_of(shape, frame)
        odds = np.exp(np.clip(halves, -50, 50))
        if odds < 1:
            one, two, odds = two, one, 1 / odds
        what = EDGE if (one[:, EDGE] != two[:, EDGE]).any() else HOLE
        self.doubts[what] = Doubt(float(1 / odds), two - one)

    def _propose(self, shape: FittedField, frame: Frame) -> bool:
        """Set the next candidate beside a shape at its minimum; False when all were tried."""
        moves = self._moves.of(shape, frame)
        while self._candidate is None and self._moves_tried < len(moves):
            self._candidate = moves[self._moves_tried](shape, frame)
            if self._candidate is None:
                self._moves_tried += 1
        return self._candidate is not None


def _outlines(measured: Measured) -> Measured:
    return {Channel.STRUCTURE: measured[Channel.STRUCTURE]}


def _in_words(shape: FittedField) -> str:
    if not isinstance(shape.family, PressureField):
        return "level set"
    name = "circle" if shape.family.order < 2 else "ellipse"
    if shape.family.forms == PEAK:
        name = "rounded outline"
    return f"{shape.family.count} {name}{'s' * (shape.family.count != 1)}"

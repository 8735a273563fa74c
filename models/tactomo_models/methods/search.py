"""One search: from what was believed of the frame before to what is believed of this one.

    advance(belief, frame) -> belief        the frame before is an argument; nothing else is kept

A frame that is of the same scene leaves the belief as it is. Else contacts are moved on as they
last moved, and fitted to all sheets at once. Where that does not explain the data, what is left of
the contacts, what is missing beside them and a cold start compete. Then each contact is asked by
itself what it is: even, rounded, a ring, falling towards the edge, two contacts, or none. What
each would come to is predicted without a solve (`prediction`), and solved for where that is likely.
The evidence decides, and what it leaves open is kept as rivals, whose share is part of what is
shown. What one frame's budget does not finish, the next one goes on with.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse.csgraph import connected_components
from tactomo_protocol import Channel

from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.methods.account import Account, Frame, account_of, descended, outline_errors
from tactomo_models.methods.contact_search import ContactSearch
from tactomo_models.methods.kinds import Kind, as_kind, as_one, kind_of
from tactomo_models.methods.prediction import Prediction, at_end, predict, with_kind
from tactomo_models.methods.rivals import (
    Rivals,
    alternatives,
    as_predicted,
    as_solved,
    choices,
    in_another_frame,
    opened,
    to_be_asked,
    turned,
)
from tactomo_models.scans.companion_forces import with_outline_errors
from tactomo_models.scans.stillness import Since, are_still
from tactomo_models.scene.field_account import Alternative
from tactomo_models.scene.field_fit import COLD_S, FieldFit, FittedField, Measured
from tactomo_models.scene.parameters import COLUMNS, E1, E2, PEAK, SIZE, UNIT_M, X, Y
from tactomo_models.scene.pressure import CLEARLY
from tactomo_models.scene.pressure_field import PressureField
from tactomo_models.scene.sheet_response import GradedResponse, SaturatingResponse

MAX_CONTACTS = 12
LIKELIER = (
    1.0  # from which a rival takes a contact's place; below, the mean of both is shown anyway
)
# Of a contact that data explain: half the logarithm of its axes' ratio, from which it may be two
# (two circles 8 mm apart have 0.2), and the uncertainty of a logarithm of its size, from which it
# may be none. With every contact asked for both, cold frames take a third longer.
LONG, KNOWN_SIZE = 0.1, 0.25
FEW_STEPS = 4  # of starts that are compared: a start's cost says little before
# Of a fit in one go, before what is left is looked at; of one that is unexplained, which may have
# far to go.
STEPS, FAR_STEPS = 4, 20
HOPELESS = -6.0  # logarithm of odds: what is predicted below is asked no more
SURE_STEPS = 6  # of a fit of two contacts from afar, before what it predicts is believed
# Of chi-squared: a check ends where the Jacobian predicts that no more is left to gain.
CHECKED = 0.5
# Chi-squared over the count of data, from which a contact is missing rather than of another kind.
SURPRISE = 2.0
# Of questions, each after what the last one changed. With 4 a crowd ended before all was asked, and
# small balls were surely flat; ordinary scenes come to three.
ROUNDS = 12
ANOTHER_PRESS = 1.25  # factor of a peak, from which evidence of a kind is of another press


@dataclass(frozen=True)
class Belief:
    """What is believed of a scene after a frame."""

    account: Account  # the likeliest account
    rivals: tuple[Rivals, ...]  # of each contact, what else it may be, as far as it was asked
    settled_on: Measured  # the frame that it was fitted to last
    since: Since | None = None  # what has come since
    moved: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))  # (K, 2) in that frame
    asked_peaks: FloatArray = field(default_factory=lambda: np.zeros(0))  # (K,) when asked last
    rounds: int = 0  # of questions in which something has changed
    frames: int = 0  # in which something moved, with these contacts
    challenged: float = 0.0  # chi-squared that no start could better
    is_explained: bool = True  # whether it explains its own frame
    lacks_none: bool = False  # whether no contact is missing, as far as was asked
    lifts_none: bool = False  # whether no light contact presses harder, as far as was tried
    is_parted: bool = False  # whether no contacts that touch are one, as far as was asked
    done: bool = False  # whether nothing is left to try
    how: str = ""  # in words, what it came from

    def judged(self, measured: Measured) -> Measured:
        """Data with the errors of outlines that were allowed for when it was fitted."""
        errors = {name: each.outline_errors for name, each in self.settled_on.items()}
        return with_outline_errors(measured, errors)

    @property
    def alternatives(self) -> list[list[Alternative]]:
        """What else each contact may be.

        Of what presses too lightly for the graded sheet no kind has another peak.
        """
        account, family = self.account, self.account.family
        may_differ = (account.contacts[:, PEAK] > family.onset) & family.free[:, PEAK]
        return alternatives(account.contacts, account.sigmas, self.rivals, may_differ)


class Search:
    """Searches on one sensor.

    Args:
        fit: what fits fields to the sensor's sheets.
    """

    def __init__(self, fit: FieldFit) -> None:
        graded = fit.responses.get(Channel.MAGNITUDE)
        assert graded is None or isinstance(graded, GradedResponse)
        self.fit = fit
        self.field = PressureField.on(fit.forward, graded)
        typical = {Channel.STRUCTURE: float(np.exp(fit.likely))}
        if graded is not None:
            peak_kpa = np.array(self.field.typical_peak * self.field.unit_kpa)
            typical[Channel.MAGNITUDE] = 1 + float(graded.relative_change(peak_kpa)[0])
        self._missing = ContactSearch(fit, typical)

    def advance(self, belief: Belief | None, frame: Frame) -> Belief:
        """What is believed after one frame more."""
        if belief is None or belief.account.fitted.solutions.keys() != frame.measured.keys():
            return self._tried(self._cold(frame), frame)
        still, since = self._is_still(belief, frame)
        if still:
            judged = replace(frame, measured=belief.judged(frame.measured))
            return self._held(replace(belief, since=since, how="still"), judged)
        frame = self._with_outline_errors(belief.account, frame)
        return self._tried(self._followed(belief, frame), frame)

    def _tried(self, belief: Belief, frame: Frame) -> Belief:
        """What is left to try, one thing after the other, as long as the budget lasts."""
        outlined = belief.account.family.count  # whose outlines' errors are allowed for
        if any(each.outline_errors is None for each in frame.measured.values()):
            outlined = 0
        while not belief.done and not frame.budget.over:
            account = belief.account
            if account.at_minimum and account.family.count != outlined:
                frame, outlined = self._with_outline_errors(account, frame), account.family.count
                belief = self._compared(belief, frame)
            belief = self._advanced(belief, frame)
        explained = frame.likelihood.explains(belief.account.chi_squared)
        return replace(belief, is_explained=explained)

    def _with_outline_errors(self, account: Account, frame: Frame) -> Frame:
        """The frame, where what the mesh may make of an account's outlines counts as an error."""
        errors = outline_errors(self.fit, account, frame.measured)
        return replace(frame, measured=with_outline_errors(frame.measured, errors))

    def _compared(self, belief: Belief, frame: Frame) -> Belief:
        """The belief held against a frame that is judged otherwise."""
        fitted = self.fit.compare(belief.account.fitted, frame.measured)
        account = account_of(self.fit, fitted, frame)
        return replace(belief, account=account, settled_on=frame.measured)

    # From frame to frame

    @staticmethod
    def _is_still(belief: Belief, frame: Frame) -> tuple[bool, Since | None]:
        """Whether a frame is of the scene that was fitted last, and what has come since then."""
        if not are_still(belief.settled_on, frame.measured):
            return False, None
        if belief.since is None:
            return True, None
        since, moves = belief.since.taken(frame.measured)
        return not moves, since

    def _held(self, belief: Belief, frame: Frame) -> Belief:
        """The belief held against a frame of the same scene, which tells nothing new.

        What is left to try is tried on the frame that was fitted.
        """
        if not belief.done:
            fitted = self.fit.compare(belief.account.fitted, belief.settled_on)
            account = replace(belief.account, fitted=fitted)
            settled = replace(frame, measured=belief.settled_on)
            belief = self._tried(replace(belief, account=account), settled)
        shown = self.fit.compare(belief.account.fitted, frame.measured)
        return replace(belief, account=replace(belief.account, fitted=shown))

    def _followed(self, belief: Belief, frame: Frame) -> Belief:
        """The same contacts, fitted to a frame in which something has changed."""
        old = belief.account
        compared = self.fit.compare(old.fitted, frame.measured)
        ahead = self._moved_on(belief, frame)
        if ahead is not None and ahead.cost < compared.cost:
            compared = ahead
        account = account_of(self.fit, compared, frame)
        frames = belief.frames + 1
        settled = self._descended(account, frame, STEPS)
        belief = replace(
            belief,
            account=settled,
            rivals=tuple(in_another_frame(mine, settled.log_evidence) for mine in belief.rivals),
            settled_on=frame.measured,
            since=None,
            frames=frames,
            done=False,
            lifts_none=False,
            how="warm start",
        )
        due = frames & (frames - 1) == 0
        # What did not explain its own frame has no claim on the next one.
        suspect = not belief.is_explained and (due or not belief.challenged)
        if suspect or not self._is_explained(belief, frame, anew=due):
            return self._challenged(belief, account, frame)
        moved = (belief.account.contacts - old.contacts)[:, [X, Y]]
        return self._asking_again(replace(belief, moved=moved), due=due)

    def _moved_on(self, belief: Belief, frame: Frame) -> FittedField | None:
        """The contacts where they would be if they went on as they last moved."""
        account = belief.account
        if len(belief.moved) != len(account.contacts):
            return None
        sigmas = account.sigmas[:, [X, Y]]
        if not (np.abs(belief.moved) > sigmas).any():
            return None
        each = account.contacts.copy()
        each[:, [X, Y]] += belief.moved
        return self._fitted(each, account.fitted.log_ratio, frame)

    def _asking_again(self, belief: Belief, *, due: bool) -> Belief:
        """Ask a contact that is pressed quite differently; where it is due, what is open, too."""
        peaks = _pressed_peaks(belief.account)
        asked = belief.asked_peaks if len(belief.asked_peaks) == len(peaks) else peaks
        same = (peaks == 0) | (peaks < ANOTHER_PRESS * asked) & (asked < ANOTHER_PRESS * peaks)
        if same.all() and not due:
            return belief
        rivals = tuple(
            {
                kind: replace(
                    rival,
                    is_open=rival.is_open or not is_same or (due and rival.log_odds > HOPELESS),
                )
                for kind, rival in mine.items()
            }
            for mine, is_same in zip(belief.rivals, same, strict=True)
        )
        again = replace(belief, rivals=rivals, asked_peaks=np.where(same, asked, peaks), rounds=0)
        return replace(again, lacks_none=False, is_parted=False) if due else again

    @staticmethod
    def _is_explained(belief: Belief, frame: Frame, *, anew: bool) -> bool:
        """Whether the data are explained, or at least as well as they were when all was tried."""
        likelihood, chi_squared = frame.likelihood, belief.account.chi_squared
        tried = 0.0 if anew else belief.challenged - likelihood.count
        return likelihood.explains(chi_squared - max(tried, 0.0))

    # Starts

    def _cold(self, frame: Frame) -> Belief:
        """What is proposed, or nothing: any contact at all explains more than none."""
        frame.budget.left_s -= COLD_S
        starts = [self._nothing(frame), *self._proposed(frame)]
        best = min(starts, key=lambda one: one.fitted.cost)
        return self._begun(best, frame, "proposed" if best.family.count else "cold start")

    def _nothing(self, frame: Frame) -> Account:
        return self._account(np.zeros((0, COLUMNS)), self.fit.likely, frame)

    def _proposed(self, frame: Frame) -> list[Account]:
        """What a network proposes, where it proposes any contact."""
        each = frame.propose()[:MAX_CONTACTS] if frame.propose else np.zeros((0, COLUMNS))
        each[:, PEAK] = self._start_peak(frame)
        return [self._account(each, self.fit.likely, frame)] if len(each) else []

    def _challenged(self, belief: Belief, before: Account, frame: Frame) -> Belief:
        """What explains a frame that the known contacts do not: the best of all starts."""
        starts = [belief.account, self._with_missing(belief.account, frame, far=True)]
        if before.family.count > 1 and _is_light(before):
            # A large contact that comes lightly is first taken for several.
            one = as_one(before.contacts)[None]
            starts.append(self._account(one, before.fitted.log_ratio, frame))
        starts += self._proposed(frame) or self._grown_anew(frame)
        tried = [self._descended(start, frame, FEW_STEPS) for start in starts]
        best = max(tried, key=lambda one: one.log_evidence)
        begun = self._begun(best, frame, "warm start")
        return replace(begun, challenged=best.chi_squared)

    def _grown_anew(self, frame: Frame) -> list[Account]:
        """Contacts found one after the other from none, where any are, while much is left."""
        account, grown = self._nothing(frame), []
        while self._explains_little(account, frame) and not frame.budget.over:
            more = self._with_missing(account, frame, far=True)
            if more is account:
                break
            account, grown = more, [more]
        return grown

    def _lifted(self, account: Account, frame: Frame) -> Account:
        """Light contacts pressed as hard as the graded sheet says at its onset, where it does.

        Below the onset a peak has no slope, so that a fit which came there stays.
        """
        light = account.family.light(account.fitted.parameters)
        if not light.any():
            return account
        peaks = account.family.index[light, PEAK]
        by_peak = self.fit.jacobian_at_onset(account.fitted, frame.measured)[:, peaks]
        power = np.maximum((by_peak**2).sum(axis=0), 1e-12)
        pull = -by_peak.T @ account.fitted.residuals[Channel.MAGNITUDE]
        if not (pull > CLEARLY * np.sqrt(power)).any():
            return account
        each = account.contacts.copy()
        each[light, PEAK] = self.field.onset + np.maximum(pull / power, 0.0)
        lifted = self._account(each, account.fitted.log_ratio, frame)
        return self._likelier(account, lifted, frame)

    def _lightened(self, account: Account, frame: Frame) -> Account:
        """Light contacts pressed less, at the ratio that is likely, where that is likelier.

        A light press on a sheet that changes much when saturated, and a hard one on a sheet that
        changes little, look alike. Where a sheet is saturated a peak has no slope, so that a fit
        which came there stays.
        """
        response = self.fit.responses.get(Channel.STRUCTURE)
        precision, offset = account.fitted.prior
        is_likely = precision[-1] * offset[-1] ** 2 < 1
        if not isinstance(response, SaturatingResponse) or is_likely or not _is_light(account):
            return account
        each, unit = account.contacts.copy(), self.field.unit_kpa
        share = account.fitted.log_ratio / self.fit.likely
        reached = share * response.saturation(unit * each[:, PEAK])[0]
        each[:, PEAK] = response.pressure_at(reached) / unit
        return self._likelier(account, self._account(each, self.fit.likely, frame), frame)

    def _likelier(self, account: Account, start: Account, frame: Frame) -> Account:
        """What a start leads to, where that is likelier than the account; else this."""
        other = self._descended(start, frame, STEPS)
        return other if other.log_evidence > account.log_evidence else account

    def _begun(self, account: Account, frame: Frame, how: str) -> Belief:
        nobody: tuple[Rivals, ...] = ({},) * account.family.count
        return Belief(account, nobody, frame.measured, how=how)

    # Questions

    def _advanced(self, belief: Belief, frame: Frame) -> Belief:
        """One thing more: a fit, a contact's kinds, what they lead to, or what is missing."""
        account = belief.account
        # Fitted to its end by itself, the first of several contacts would grow over them all.
        if not belief.lacks_none and self._explains_little(account, frame):
            born = self._with_missing(account, frame, far=True)
            if born is not account:
                return self._grown(belief, born)
        if not account.at_minimum:
            return replace(belief, account=self._descended(account, frame, STEPS))
        if not belief.lifts_none:
            lifted = self._lifted(self._lightened(account, frame), frame)
            tried = replace(belief, account=lifted, lifts_none=lifted is account)
            return self._asking_again(tried, due=False)
        specks = account.contacts[:, SIZE] <= self.field.limits[0, SIZE]
        if specks.any():
            return self._without_specks(belief, specks, frame)
        if not belief.is_parted and _is_light(account):
            return self._joined(belief, frame)
        if belief.rounds < ROUNDS:
            asks = self._unasked(belief, frame)
            if asks:
                return self._asked(belief, asks, frame)
            better = self._decided(belief, frame)
            if better is not None:
                return better
            for k in range(account.family.count):
                kinds = self._unsolved(belief, k, frame)
                if kinds:
                    return self._solved(belief, k, kinds, frame)
        if not belief.lacks_none:
            born = self._with_missing(account, frame, far=False)
            if born is not account:
                return self._grown(belief, born)
            return replace(belief, lacks_none=True)
        if not belief.is_parted:
            return self._joined(belief, frame)
        return replace(
            belief,
            since=Since.after(frame.measured, account.jacobian, account.fitted.prior[0]),
            asked_peaks=_pressed_peaks(account),
            done=True,
        )

    def _without_specks(self, belief: Belief, specks: BoolArray, frame: Frame) -> Belief:
        """The belief without contacts as small as may be: they are errors of the model."""
        account = belief.account
        rest = self._account(account.contacts[~specks], account.fitted.log_ratio, frame)
        begun = self._begun(rest, frame, belief.how)
        return replace(begun, lacks_none=True, challenged=belief.challenged)

    def _kinds(self, account: Account, k: int, frame: Frame) -> list[Kind]:
        """What else a contact may be, as far as that is worth a trial."""
        contact, own = account.contacts[k], kind_of(account.contacts[k])
        kinds = [Kind.EVEN, Kind.ROUNDED]
        if account.family.free[k, PEAK]:
            kinds += [Kind.FALLING, Kind.RING]
        unexplained = not frame.likelihood.explains(account.chi_squared)
        if account.sigmas[k, SIZE] > KNOWN_SIZE or unexplained:
            kinds.append(Kind.NONE)
        is_long = float(np.hypot(*contact[[E1, E2]])) > LONG or own is Kind.ROUNDED
        if (is_long or unexplained) and account.family.count < MAX_CONTACTS:
            kinds.append(Kind.TWO)
        return [kind for kind in kinds if kind is not own]

    def _unasked(self, belief: Belief, frame: Frame) -> list[tuple[int, Kind]]:
        """Contacts and kinds that are still to be asked, of which the Jacobian predicts anything.

        Of two contacts in place of one that explains little it predicts nothing.
        """
        is_far = self._explains_little(belief.account, frame)
        return [
            (k, kind)
            for k, mine in enumerate(belief.rivals)
            for kind in self._kinds(belief.account, k, frame)
            if to_be_asked(kind, mine) and not (is_far and kind is Kind.TWO)
        ]

    def _asked(self, belief: Belief, asks: list[tuple[int, Kind]], frame: Frame) -> Belief:
        """Predict what contacts would come to be of other kinds."""
        account, rivals = belief.account, [dict(mine) for mine in belief.rivals]
        now = at_end(self.fit, account, frame).log_evidence
        found = predict(self.fit, self.field, account, asks, frame)
        for (k, kind), each in zip(asks, found, strict=True):
            before, log_odds = rivals[k].get(kind), each.log_evidence - now
            rivals[k][kind] = as_predicted(each, log_odds, account.contacts[k], before)
        for _ in {k for k, _ in asks}:
            frame.budget.spend(account.fitted)  # about what asking a contact takes
        return replace(belief, rivals=tuple(rivals))

    def _unsolved(self, belief: Belief, k: int, frame: Frame) -> list[Kind]:
        """Kinds that a contact is still to be solved for."""
        mine = belief.rivals[k]
        kinds = [kind for kind, rival in mine.items() if rival.is_doubtful]
        if self._explains_little(belief.account, frame) and to_be_asked(Kind.TWO, mine):
            kinds += [kind for kind in self._kinds(belief.account, k, frame) if kind is Kind.TWO]
        return kinds

    def _solved(self, belief: Belief, k: int, kinds: list[Kind], frame: Frame) -> Belief:
        """Solve for a contact of other kinds."""
        account, mine = belief.account, dict(belief.rivals[k])
        now = at_end(self.fit, account, frame).log_evidence
        for kind in kinds:
            rival = mine.get(kind)
            if rival is None or rival.found is None:
                every, own = with_kind(self.fit, self.field, account, k, kind)
                start = self._account(every, account.fitted.log_ratio, frame)
                each = self._checked(start, own, now, frame, FAR_STEPS, SURE_STEPS)
            else:
                start = self._account(rival.found.every, rival.found.log_ratio, frame)
                each = self._checked(start, rival.found.own, now, frame)
            mine[kind] = as_solved(each, each.log_evidence - now, account.contacts[k], rival)
        return self._with_rivals(belief, k, mine)

    @staticmethod
    def _explains_little(account: Account, frame: Frame) -> bool:
        """Whether so much is left that a contact is missing rather than of another kind."""
        return account.chi_squared > SURPRISE * frame.likelihood.count

    def _checked(
        self,
        solved: Account,  # where to begin
        own: IntArray,  # (m,) the contacts that were asked about
        now: float,  # the log evidence of the field as it is
        frame: Frame,
        steps: int = STEPS,  # no more than these
        # of them before what is predicted to be hopeless is believed. One where a start was likely:
        # without, a ball on one graded sheet was surely an egg that presses evenly; with two, a
        # cold frame has a solve more
        sure: int = 1,
    ) -> Prediction:
        """What other contacts come to, by a fit that ends early where that is hopeless."""
        found = at_end(self.fit, solved, frame, own)
        for taken in range(steps):
            is_hopeless = found.log_evidence - now < HOPELESS
            # A step that would lose is cut at a limit: the end is still far.
            is_there = 0 <= found.gain < CHECKED or solved.at_minimum
            if is_there or (is_hopeless and taken >= sure):
                break
            # Of how hard light contacts press it tells nothing.
            solved = descended(self.fit, solved, frame, 1, stays_light=True)
            found = at_end(self.fit, solved, frame, own)
        return found

    def _decided(self, belief: Belief, frame: Frame) -> Belief | None:
        """The belief with each contact of its likeliest kind, where that is likelier altogether."""
        account = belief.account
        for choice in choices(belief.rivals, LIKELIER):
            changed = self._changed(belief, choice, frame)
            gain = changed.account.log_evidence - account.log_evidence
            (k, kind), *more = choice.items()
            before = belief.rivals[k][kind]
            if (gain if more else before.mean(gain)) >= LIKELIER:
                return changed
            if not more:
                own = np.arange(k, k + 1 + changed.account.family.count - account.family.count)
                found = at_end(self.fit, changed.account, frame, own)
                refused = as_solved(found, gain, account.contacts[k], before)
                return self._with_rivals(belief, k, {**belief.rivals[k], kind: refused})
        return None

    @staticmethod
    def _with_rivals(belief: Belief, k: int, mine: Rivals) -> Belief:
        return replace(belief, rivals=(*belief.rivals[:k], mine, *belief.rivals[k + 1 :]))

    def _changed(self, belief: Belief, choice: Mapping[int, Kind], frame: Frame) -> Belief:
        """The belief with some contacts of another kind, fitted altogether."""
        account = belief.account
        rows = [contact[None] for contact in account.contacts]
        for k, kind in choice.items():
            won = belief.rivals[k][kind]
            rows[k] = (rows[k][0] + won.difference)[None] if won.is_one else won.difference
        every, log_ratio = np.vstack(rows), account.fitted.log_ratio
        ends = [belief.rivals[k][kind].found for k, kind in choice.items()]
        if len(ends) == 1 and ends[0] is not None:
            every, log_ratio = ends[0].every, ends[0].log_ratio
        start = self._account(every, log_ratio, frame)
        changed = self._descended(start, frame, FEW_STEPS)
        if at_end(self.fit, changed, frame).log_evidence > account.log_evidence + HOPELESS:
            changed = self._descended(changed, frame, self._steps(account, frame) - FEW_STEPS)
        gain = changed.log_evidence - account.log_evidence
        at = np.cumsum([0, *map(len, rows)])
        rivals: list[Rivals] = []
        for k, mine in enumerate(belief.rivals):
            if belief.rounds + 1 < ROUNDS:  # else nobody is asked again
                mine = opened(mine, changed.log_evidence)
            if k not in choice:
                rivals.append(mine)
            elif (won := belief.rivals[k][choice[k]]).is_one:
                alone = len(choice) == 1
                mine = turned(
                    mine,
                    choice[k],
                    account.contacts[k],
                    changed.contacts[at[k]],
                    account.sigmas[k],
                    won.mean(gain) if alone else won.log_odds,
                    alone or won.is_solved,
                    changed.log_evidence,
                )
                rivals.append(mine)
            else:
                rivals += [{}] * len(rows[k])
        return replace(
            belief,
            account=changed,
            rivals=tuple(rivals),
            rounds=belief.rounds + 1,
            lacks_none=False,
            lifts_none=False,
            is_parted=belief.is_parted and _is_light(changed),
            moved=np.zeros((0, 2)),
        )

    def _joined(self, belief: Belief, frame: Frame) -> Belief:
        """The belief with contacts that touch as one, where that is likelier."""
        account = belief.account
        for touching in _touching(account.contacts, self.field.half_width_m):
            now = at_end(self.fit, account, frame).log_evidence
            rest = np.delete(account.contacts, touching, axis=0)
            one = as_one(account.contacts[touching])
            for kind in (Kind.EVEN, Kind.FALLING, Kind.ROUNDED):
                each = np.vstack([rest, as_kind(one, kind)])
                start = self._account(each, account.fitted.log_ratio, frame)
                found = self._checked(start, np.array([len(rest)]), now, frame, FAR_STEPS)
                if found.log_evidence <= now:
                    continue
                end = self._account(found.every, found.log_ratio, frame)
                joined = self._descended(end, frame, STEPS)
                if joined.log_evidence > account.log_evidence:
                    return self._begun(joined, frame, belief.how)
        return replace(belief, is_parted=True)

    # What is missing

    def _with_missing(self, account: Account, frame: Frame, far: bool) -> Account:
        """The same contacts and another, where that is likelier; else the very same account."""
        if account.family.count >= MAX_CONTACTS:
            return account
        frame.budget.spend(account.fitted)  # about what looking takes, too
        each = account.contacts
        for found in self._missing.missing(account, frame, far=far):
            born = np.zeros((1, COLUMNS))
            born[0, [X, Y, SIZE, PEAK]] = (
                found.x_m / UNIT_M,
                found.y_m / UNIT_M,
                np.log(found.radius_m),
                self._start_peak(frame),
            )
            # With a free ratio the first of several contacts would grow over them all.
            holds = self._explains_little(account, frame)
            start = self._account(np.vstack([each, born]), account.fitted.log_ratio, frame)
            steps = STEPS if holds else self._steps(account, frame)
            grown = self._descended(start, frame, steps, holds_ratio=holds)
            # As small as it may be, it is an error of the model, not a contact.
            is_speck = grown.contacts[-1, SIZE] <= self.field.limits[0, SIZE]
            if grown.log_evidence > account.log_evidence and not is_speck:
                return replace(grown, at_minimum=grown.at_minimum and not holds)
        return account

    def _grown(self, belief: Belief, account: Account) -> Belief:
        """The belief with a further contact."""
        rivals = (*(opened(mine, account.log_evidence) for mine in belief.rivals), {})
        return replace(
            belief,
            account=account,
            rivals=rivals,
            rounds=0,
            frames=0,
            lifts_none=False,
            is_parted=False,
            moved=np.zeros((0, 2)),
        )

    def _start_peak(self, frame: Frame) -> float:
        """Peak that a contact starts with: below the onset where the graded sheet rests."""
        if frame.fits_peaks and frame.measured[Channel.MAGNITUDE].quiet:
            return max(self.field.onset / 2, float(self.field.limits[0, PEAK]))
        return self.field.typical_peak

    @staticmethod
    def _steps(account: Account, frame: Frame) -> int:
        """Steps of a fit of something else: unexplained, it may have far to go."""
        return 2 * STEPS if frame.likelihood.explains(account.chi_squared) else FAR_STEPS

    def _fitted(self, each: FloatArray, log_ratio: float, frame: Frame) -> FittedField:
        family = self.field.of(each, fits_peaks=frame.fits_peaks)
        fitted = self.fit.evaluate(
            family, family.bounded(family.join(each)), log_ratio, frame.measured
        )
        frame.budget.spend(fitted)
        return fitted

    def _account(self, each: FloatArray, log_ratio: float, frame: Frame) -> Account:
        return account_of(self.fit, self._fitted(each, log_ratio, frame), frame)

    def _descended(
        self, account: Account, frame: Frame, steps: int, *, holds_ratio: bool = False
    ) -> Account:
        return descended(self.fit, account, frame, steps, holds_ratio=holds_ratio)


def _is_light(account: Account) -> bool:
    """Whether contacts are there, none of which the graded sheet tells to press."""
    return account.family.count > 0 and bool(account.is_hardly_pressed.all())


def _pressed_peaks(account: Account) -> FloatArray:
    """Peaks (K,); 0 where the graded sheet tells none, and so nothing of the kind either."""
    return np.where(account.is_hardly_pressed, 0.0, account.contacts[:, PEAK])


def _touching(contacts: FloatArray, near_m: float) -> Iterator[list[int]]:
    """Groups of contacts whose outlines are so near to each other, the largest group first."""
    near = _gaps_between(contacts) < near_m
    if np.count_nonzero(near) == len(contacts):
        return  # each is near to itself alone
    count, group = connected_components(near)
    groups = [np.flatnonzero(group == number).tolist() for number in range(count)]
    yield from sorted((one for one in groups if len(one) > 1), key=len, reverse=True)


def _gaps_between(contacts: FloatArray) -> FloatArray:
    """Distances (K, K) between outlines of contacts (K, COLUMNS), m, about."""
    place = contacts[:, [X, Y]] * UNIT_M
    reach = np.exp(contacts[:, SIZE] + np.hypot(*contacts[:, [E1, E2]].T))
    apart = np.linalg.norm(place[:, None] - place, axis=2)
    return np.asarray(apart - reach[:, None] - reach)

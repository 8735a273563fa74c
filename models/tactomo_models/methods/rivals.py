"""Rivals: what else a contact may be than what it is taken for, and by what odds.

A rival is kept as its difference from the contact, so that it moves on with it. Odds are of the
evidence of both (`prediction`); what nobody has asked yet is as likely as before any data.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.methods.kinds import SHARES, Kind, as_kind, kind_of, log_prior, marginals
from tactomo_models.methods.prediction import Prediction
from tactomo_models.scene.field_account import Alternative
from tactomo_models.scene.parameters import EDGE

OPEN = -3.0  # log odds: a rival above is asked again once others have become another kind
# Log odds: a rival that is predicted above is solved for, since the place of a contact turns on it.
# Of 150 rivals of mixed presses, predictions were right to 0.3 (median; 1.3 for 95 %). With -2 one
# scene of a ring and a disc loses 0.004 of its correlation, with -1 maps at 20 dB 0.002; with -6, a
# cold frame has more solves and the same maps.
DOUBTFUL = -4.0
# The same of a rival that differs in its outline alone: unless it wins, it hardly changes what is
# shown. Of mixed presses the maps are the same with 0 and with -2, the solves of a cold frame 16.1
# (16.4) and 17.1; of rectangles and rings 24.0 (25.9) with 0.
MAY_WIN = -1.0
# Of chi-squared: a prediction whose step takes off more is solved for, too. Of 456 predictions on
# tuning scenes, 25 did; two of these were told -16 and -22 and came to 4 and 3, so that small balls
# were surely flat. Of the 431 others one was off as far. It costs 2 % of a crowd's time.
FAR_STEP = 1000.0
# Log odds below which such a prediction of two contacts in place of one is believed: that is always
# far. Of 62 that were solved for on tuning scenes none was likelier; in one of ten crowds one was,
# told -6. With half the maps are the same, with twice a cold frame has up to a solve more.
HARDLY_TWO = -12.0
# Change of the predicted log odds below which a rival stays as it was solved for: a prediction errs
# by as much (median).
SAME = 0.3


@dataclass(frozen=True)
class Rival:
    """What else a contact may be."""

    log_odds: float  # over what it is taken for
    # (COLUMNS,) of its parameters; the two contacts (2, COLUMNS) that it is, or none (0, COLUMNS)
    difference: FloatArray
    sigmas: FloatArray  # (COLUMNS,) their standard uncertainties
    is_open: bool = False  # whether it is to be asked once more
    is_solved: bool = False  # whether the odds are of solved fields, not predicted
    predicted: float | None = None  # predicted log odds when it was asked last
    before: float = 0.0  # mean of the log odds in other frames
    frames: int = 0  # how many these are
    found: Prediction | None = None  # where it was asked last, all contacts moved with it
    is_far: bool = False  # whether that was too far a step to predict
    asked_at: float = 0.0  # log evidence of the field when it was asked

    @property
    def is_one(self) -> bool:
        """Whether it is one contact of another kind."""
        return self.difference.ndim == 1

    @property
    def is_unsure(self) -> bool:
        """Whether nothing but a prediction from afar is known of it."""
        return self.is_far and not self.is_solved

    def may_matter(self, now: float) -> bool:
        """Whether it may have become likely, the field having come to such a log evidence."""
        least = min(OPEN, (self.asked_at - now) / 2)
        return self.log_odds >= least or self.is_unsure

    @property
    def is_doubtful(self) -> bool:
        """Whether it is to be solved for."""
        presses_alike = self.is_one and not self.difference[EDGE:].any()
        is_likely = self.log_odds > (MAY_WIN if presses_alike else DOUBTFUL) or self.is_far
        return self.found is not None and not self.is_solved and is_likely

    def mean(self, log_odds: float) -> float:
        """The mean of log odds and those of other frames.

        A mean and no sum: where a contact stays, errors of the sheet repeat themselves.
        """
        return (log_odds + self.frames * self.before) / (self.frames + 1)


Rivals = Mapping[Kind, Rival]

KINDS = list(SHARES)
MAX_LOG_ODDS, MIN_SHARE = 700.0, 1e-300  # what a float holds


def alternatives(
    contacts: FloatArray,  # (K, COLUMNS)
    sigmas: FloatArray,  # (K, COLUMNS) their standard uncertainties
    rivals: Sequence[Rivals],
    may_differ: BoolArray,  # (K,) contacts that have another peak if they are of another kind
) -> list[list[Alternative]]:
    """What else each contact may be, where it is one contact."""
    own = tuple(kind_of(contact) for contact in contacts)
    prior = _prior_odds(own)
    log_odds = _log_odds(own, rivals, prior)
    odds = np.exp(np.minimum(log_odds, MAX_LOG_ODDS))
    likely = marginals(log_odds - prior)
    found: list[list[Alternative]] = []
    for k, mine in enumerate(rivals):
        others: list[Alternative] = []
        for place, kind in enumerate(KINDS):
            if kind is own[k] or not odds[k, place] or not (kind in mine or may_differ[k]):
                continue
            if kind in mine:
                contact, of_contact = contacts[k] + mine[kind].difference, mine[kind].sigmas
            else:
                contact, of_contact = as_kind(contacts[k], kind)[0], sigmas[k]
            marginal = likely[k, place] / max(likely[k, KINDS.index(own[k])], MIN_SHARE)
            others.append(Alternative(odds[k, place], marginal, contact, of_contact))
        found.append(others)
    return found


@lru_cache(maxsize=64)  # a scene's kinds stay the same for many frames
def _prior_odds(own: tuple[Kind, ...]) -> FloatArray:
    """Logarithms (K, kinds) of how likely it is before any data that one contact is another."""
    now = log_prior(own)
    return np.array(
        [
            [log_prior([*own[:k], kind, *own[k + 1 :]]) - now for kind in KINDS]
            for k in range(len(own))
        ]
    ).reshape(-1, len(KINDS))


def _log_odds(own: Sequence[Kind], rivals: Sequence[Rivals], prior: FloatArray) -> FloatArray:
    """The same with the data; what nobody has asked yet is as likely as it is before."""
    log_odds = np.full(prior.shape, -np.inf)
    for k, mine in enumerate(rivals):
        for place, kind in enumerate(KINDS):
            if kind in mine:
                log_odds[k, place] = mine[kind].log_odds
            elif kind is not Kind.ROUNDED and (own[k], kind) != (Kind.ROUNDED, Kind.EVEN):
                log_odds[k, place] = prior[k, place]
        log_odds[k, KINDS.index(own[k])] = 0.0
    return log_odds


def choices(rivals: tuple[Rivals, ...], least: float) -> list[dict[int, Kind]]:
    """What contacts may become: those that are about as sure as the surest at once, or it alone."""
    likeliest = {
        k: max(mine, key=lambda kind: mine[kind].log_odds) for k, mine in enumerate(rivals) if mine
    }
    odds = {k: rivals[k][kind].log_odds for k, kind in likeliest.items()}
    surest = max(odds, key=lambda k: odds[k], default=None)
    if surest is None or odds[surest] < least:
        return []
    many = {k: kind for k, kind in likeliest.items() if odds[k] > odds[surest] / 2}
    alone = {surest: likeliest[surest]}
    return [many, alone] if len(many) > 1 else [alone]


def to_be_asked(kind: Kind, rivals: Rivals) -> bool:
    """Whether a contact is still to be asked for a kind."""
    return kind not in rivals or rivals[kind].is_open


def as_predicted(
    found: Prediction, log_odds: float, contact: FloatArray, before: Rival | None
) -> Rival:
    """A rival as it is predicted; as it was solved for, where the prediction is about the same."""
    if before is not None and before.is_solved:
        predicted = log_odds if before.predicted is None else before.predicted
        if abs(log_odds - predicted) < SAME:
            return replace(before, is_open=False, predicted=predicted, found=found)
    made = _rival_of(found, log_odds, contact, before)
    is_far = found.gain > FAR_STEP and (made.is_one or log_odds > HARDLY_TWO)
    return replace(made, predicted=log_odds, is_far=is_far)


def as_solved(
    found: Prediction, log_odds: float, contact: FloatArray, before: Rival | None
) -> Rival:
    """A rival as it was solved for."""
    made = _rival_of(found, log_odds, contact, before)
    return replace(made, is_solved=True, predicted=before.predicted if before else None)


def _rival_of(
    found: Prediction, log_odds: float, contact: FloatArray, before: Rival | None
) -> Rival:
    asked_at = found.log_evidence - log_odds
    if before is not None:
        log_odds = before.mean(log_odds)
    is_one = len(found.contacts) == 1
    return Rival(
        log_odds,
        found.contacts[0] - contact if is_one else found.contacts,
        found.sigmas[0] if is_one else found.sigmas,
        before=before.before if before else 0.0,
        frames=before.frames if before else 0,
        found=found,
        asked_at=asked_at,
    )


def turned(
    rivals: Rivals,
    kind: Kind,
    before: FloatArray,
    after: FloatArray,
    sigmas: FloatArray,
    log_odds: float,
    is_solved: bool,
    now: float,
) -> Rivals:
    """The rivals of a contact that has become one of them.

    Args:
        rivals: what it might have been.
        kind: what it is.
        before: (COLUMNS,) the contact as it was.
        after: (COLUMNS,) as it is.
        sigmas: (COLUMNS,) standard uncertainties as it was.
        log_odds: of what it is over what it was.
        is_solved: whether these are of solved fields.
        now: log evidence of the field as it is.
    """
    moved = after - before
    others = {
        other: replace(
            rival,
            log_odds=rival.log_odds - log_odds,
            difference=rival.difference - moved * rival.is_one,
            is_solved=rival.is_solved and is_solved,
            predicted=None,
            found=None,
        )
        for other, rival in rivals.items()
        if other is not kind
    }
    back = Rival(-log_odds, -moved, sigmas, is_open=True, is_solved=is_solved, asked_at=now)
    return others | {kind_of(before): back}


def in_another_frame(rivals: Rivals, now: float) -> Rivals:
    """The same, without where they were found: in another frame that is elsewhere.

    `now` is the log evidence of the field there.
    """
    return {
        kind: replace(
            one,
            is_open=one.is_open or one.is_doubtful,
            is_solved=False,
            before=one.log_odds,
            frames=one.frames + (one.is_solved or one.found is not None),
            found=None,
            asked_at=now,
        )
        for kind, one in rivals.items()
    }


def opened(rivals: Rivals, now: float) -> Rivals:
    """The same, to be asked again where so much was gained since they were that it may matter.

    `now` is the log evidence of the field. Whether a contact is there at all costs little to ask.
    """
    return {
        kind: replace(
            one,
            is_open=one.is_open or one.may_matter(now) or kind is Kind.NONE,
            is_solved=one.is_solved and one.predicted is not None,
            frames=0,
            found=None,
        )
        for kind, one in rivals.items()
    }

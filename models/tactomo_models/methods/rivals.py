"""Rivals: what else a contact may be than what it is taken for, and by what odds.

A rival is kept as its difference from the contact, so that it moves on with it. Odds are of the
evidence of both (`foreseen`); what nobody has asked yet is as likely as before any data.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from tactomo_models.arrays import FloatArray
from tactomo_models.methods.foreseen import Foreseen
from tactomo_models.methods.kinds import SHARES, Kind, as_kind, kind_of
from tactomo_models.scene.field_account import Alternative

OPEN = -3.0  # logarithm of odds: a rival above is asked again once others have become another kind


@dataclass(frozen=True)
class Rival:
    """What else a contact may be."""

    log_odds: float  # over what it is taken for
    # (COLUMNS,) of its parameters; the two contacts (2, COLUMNS) that it is, or none (0, COLUMNS)
    difference: FloatArray
    sigmas: FloatArray  # (COLUMNS,) their standard uncertainties
    is_open: bool = False  # whether it is to be asked once more
    found: Foreseen | None = None  # where it was asked last, all contacts moved with it

    @property
    def is_one(self) -> bool:
        """Whether it is one contact of another kind."""
        return self.difference.ndim == 1


Rivals = Mapping[Kind, Rival]


def unasked(contact: FloatArray, sigmas: FloatArray, rivals: Rivals) -> list[Alternative]:
    """Kinds of other peaks that a contact has not been asked for."""
    own = kind_of(contact)
    kinds = {Kind.EVEN, Kind.FALLING, Kind.RING} - {own, *rivals}
    if own is Kind.ROUNDED:
        kinds -= {Kind.EVEN}
    return [
        Alternative(SHARES[kind] / SHARES[own], as_kind(contact, kind)[0], sigmas)
        for kind in sorted(kinds)
    ]


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


def rival_of(found: Foreseen, log_odds: float, contact: FloatArray, before: Rival | None) -> Rival:
    """What is foreseen of a rival; of one that was asked before, the mean of both.

    A mean and no sum: where a contact stays, errors of the sheet repeat themselves.
    """
    if before is not None:
        log_odds = (log_odds + before.log_odds) / 2
    if len(found.contacts) != 1:
        return Rival(log_odds, found.contacts, found.sigmas, found=found)
    return Rival(log_odds, found.contacts[0] - contact, found.sigmas[0], found=found)


def turned(rivals: Rivals, kind: Kind, own: Kind, sigmas: FloatArray) -> Rivals:
    """The rivals of a contact that has become one of them."""
    won = rivals[kind]
    others = {
        other: replace(
            rival,
            log_odds=rival.log_odds - won.log_odds,
            difference=rival.difference - won.difference * rival.is_one,
            found=None,
        )
        for other, rival in rivals.items()
        if other is not kind
    }
    return others | {own: Rival(-won.log_odds, -won.difference, sigmas)}


def in_another_frame(rivals: Rivals) -> Rivals:
    """The same, without where they were found: in another frame that is elsewhere."""
    return {kind: replace(one, found=None) for kind, one in rivals.items()}


def opened(rivals: Rivals, gain: float) -> Rivals:
    """The same, to be asked again where a change of such a gain elsewhere may matter.

    Whether a contact is there at all costs little to ask.
    """
    least = min(OPEN, -gain / 2)
    return {
        kind: replace(one, found=None)
        for kind, one in rivals.items()
        if one.log_odds < least and kind is not Kind.NONE
    }

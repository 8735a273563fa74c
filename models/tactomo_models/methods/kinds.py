"""The kinds of contact that a search tells apart, and where the fit of each starts.

A kind is one form of one contact: an even press on an ellipse, on an egg or rounded rectangle, or
by a ring; or a pressure that falls towards the edge. A contact may also be two, or none at all:
these are asked as the kinds are.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from enum import StrEnum, auto
from functools import cache

import numpy as np
from scipy.special import gammaln

from tactomo_models.arrays import FloatArray
from tactomo_models.scene.parameters import (
    COLUMNS,
    E1,
    E2,
    EDGE,
    FALLING_SHARE,
    HARMONIC,
    HERTZ,
    HOLE,
    PEAK,
    SIZE,
    UNIT_M,
    X,
    Y,
)

# Peak over that of an even press of the same force: of Hertz's pressure on the same area, 3 / 2 by
# its mean; of a ring, 4 / 3 by its area. The fit ends at the same minima from 1.
FALLING_PEAK, RING_PEAK = 3 / 2, 4 / 3
TRACE = 1e-3  # of a harmonic: what is modulated is fitted, and a first step finds by how much


class Kind(StrEnum):
    """What a contact may be."""

    EVEN = auto()  # an even pressure on an ellipse
    ROUNDED = auto()  # an even pressure on a modulated outline
    RING = auto()  # an even pressure on an ellipse but its inner half
    FALLING = auto()  # a pressure that falls towards the edge of an ellipse
    TWO = auto()  # two even presses
    NONE = auto()  # nothing


# How likely each kind is before any data: tools and pads press evenly, fingers and balls fall off,
# few things have corners that a skin can tell, fewer a hole. These shares lie between two that were
# tried, all alike and 0.4, 0.3, 0.2, 0.1 (even, falling, rounded, ring), whose maps correlate on
# tuning rows by: mixed 0.976, 0.961; soft 0.965, 0.979; soft on hand-made skins 0.964, 0.974;
# crowds 0.960, 0.975; moving 0.989, 0.996; ordinary 0.985, 0.986; 10 dB 0.888, 0.896.
SHARES = {Kind.EVEN: 0.35, Kind.FALLING: FALLING_SHARE, Kind.ROUNDED: 0.2, Kind.RING: 0.15}


# Of all kinds together, how many contacts would tell as much of what presses as these shares do: as
# many as there are kinds. With half, peaks of tuning rows are right in: mixed 74 % (78 %), soft on
# hand-made skins 69 % (72 %), crowds 95 % (93 %) and 92 % (92 %); with twice 77, 74, 86 and 83 %;
# with each contact for itself 79, 68, 64 and 57 %.
TOLD = len(SHARES)


def log_prior(kinds: Iterable[Kind]) -> float:
    """Logarithm of how likely the kinds of a scene's contacts are before any data.

    What presses a skin often presses it alike: the kinds are drawn by shares that are the scene's
    own, and these by Dirichlet's distribution around `SHARES` (Polya's urn; Gelman et al.,
    "Bayesian Data Analysis", 2013, section 3.4).
    """
    counts = Counter(kinds)
    found = math.lgamma(TOLD) - math.lgamma(TOLD + counts.total())
    for kind, count in counts.items():
        found += math.lgamma(TOLD * SHARES[kind] + count) - math.lgamma(TOLD * SHARES[kind])
    return found


def marginals(log_ratios: FloatArray) -> FloatArray:
    """How likely each of `SHARES` is of each of K contacts, whatever the others are.

    What one contact may be depends on what the others are, as the kinds of a scene are drawn
    together (`log_prior`): the sum over all that they may be, of which the prior knows the counts
    alone.

    Args:
        log_ratios: (K, kinds) logarithms of likelihoods over any one of each contact; -inf where a
            contact cannot be of a kind.
    """
    likely = np.exp(log_ratios - log_ratios.max(axis=1, keepdims=True))
    count, by_kind = len(likely), _by_counts(len(likely))
    one_more = count ** np.arange(len(SHARES) - 1)[::-1]  # where a count stands that is larger by 1
    found = np.empty_like(likely)
    for k in range(count):
        ways = np.zeros(by_kind.shape[1])
        ways[0] = 1.0
        for others in np.delete(likely, k, axis=0):
            more = others[-1] * ways
            for step, ratio in zip(one_more, others, strict=False):
                more[step:] += ratio * ways[:-step]
            ways = more / more.max()
        found[k] = likely[k] * (by_kind @ ways)
    return np.asarray(found / found.sum(axis=1, keepdims=True))


@cache
def _by_counts(count: int) -> FloatArray:
    """How likely one of so many contacts is of each kind, beside others of counts that are.

    (kinds, count ** (kinds - 1)), by how many of the others are of each kind but the last, which
    has what is left; not normalised.
    """
    prior = TOLD * np.array([*SHARES.values()])
    of_each = np.indices((count,) * (len(SHARES) - 1)).reshape(len(SHARES) - 1, -1)
    of_each = np.vstack([of_each, count - 1 - of_each.sum(axis=0)])
    pseudo = prior[:, None] + of_each
    weight = np.where(
        of_each[-1] >= 0, gammaln(np.maximum(pseudo, prior.min())).sum(axis=0), -np.inf
    )
    return np.asarray(np.exp(weight - weight.max(initial=-np.inf)) * pseudo)


def kind_of(contact: FloatArray) -> Kind:
    """Kind of a contact (COLUMNS,)."""
    if contact[EDGE] > 0:
        return Kind.FALLING
    if contact[HOLE] > 0:
        return Kind.RING
    return Kind.ROUNDED if contact[HARMONIC:PEAK].any() else Kind.EVEN


def as_kind(contact: FloatArray, kind: Kind) -> FloatArray:
    """What presses (m, COLUMNS) where a contact (COLUMNS,) is of another kind, to start from."""
    even = contact.copy()
    even[HARMONIC:PEAK] = even[EDGE:] = 0.0
    even[PEAK] /= {Kind.FALLING: FALLING_PEAK, Kind.RING: RING_PEAK}.get(kind_of(contact), 1.0)
    if kind is Kind.NONE:
        return np.zeros((0, COLUMNS))
    if kind is Kind.TWO:
        return _halves(even)
    if kind is Kind.ROUNDED:
        even[HARMONIC:PEAK] = TRACE
    elif kind is Kind.RING:
        even[HOLE], even[PEAK] = 1.0, RING_PEAK * even[PEAK]
    elif kind is Kind.FALLING:
        even[EDGE], even[PEAK] = HERTZ, FALLING_PEAK * even[PEAK]
    return even[None]


def _halves(even: FloatArray) -> FloatArray:
    """Two circles of half the area, side by side along a contact's longer axis."""
    elongation = np.hypot(even[E1], even[E2])
    angle = np.arctan2(even[E2], even[E1]) / 2
    half = even.copy()
    half[SIZE] -= np.log(2) / 2
    half[E1:HARMONIC] = 0.0
    # They touch where the contact is a circle, and end where a longer one ends.
    apart = max(np.exp(even[SIZE] + elongation) - np.exp(half[SIZE]), np.exp(half[SIZE]))
    away = apart / UNIT_M * np.array([np.cos(angle), np.sin(angle)])
    halves = np.stack([half, half])
    halves[0, [X, Y]] += away
    halves[1, [X, Y]] -= away
    return halves


def as_one(contacts: FloatArray) -> FloatArray:
    """One even ellipse (COLUMNS,) of the centre and moments of contacts (K, COLUMNS) and between.

    It presses with their force, spread over its area, and no harder than any of them.
    Of an even ellipse with half axes a and b the second moments are a^2 / 4 and b^2 / 4, altogether
    exp(2 s) expm(2 E) / 4 with s and E of `pressure_field`.
    """
    area = np.exp(2 * contacts[:, SIZE])
    share = area / area.sum()
    place = contacts[:, [X, Y]] * UNIT_M
    centre = share @ place
    off = place - centre
    moments = (share * off.T) @ off + np.einsum("k,kij->ij", share * area, _stretches(contacts)) / 4
    variance, axes = np.linalg.eigh(moments)
    short, long = 2 * np.sqrt(variance)
    one = np.zeros(COLUMNS)
    angle = np.arctan2(axes[1, 1], axes[0, 1])
    stretch = np.log(long / short) / 2
    one[[X, Y]] = centre / UNIT_M
    one[SIZE] = np.log(long * short) / 2
    one[[E1, E2]] = stretch * np.cos(2 * angle), stretch * np.sin(2 * angle)
    one[PEAK] = min(area @ contacts[:, PEAK] / (long * short), contacts[:, PEAK].max())
    return one


def _stretches(contacts: FloatArray) -> FloatArray:
    """expm(2 E) (K, 2, 2) of each contact's elongation: cosh(2 e) + sinh(2 e) E / e."""
    elongation = np.hypot(contacts[:, E1], contacts[:, E2])
    along = np.sinh(2 * elongation) / np.maximum(elongation, 1e-12)
    e1, e2 = along * contacts[:, E1], along * contacts[:, E2]
    round_ = np.cosh(2 * elongation)
    return np.moveaxis(np.array([[round_ + e1, e2], [e2, round_ - e1]]), 2, 0)

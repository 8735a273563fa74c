"""Kinds of contacts: what a fit of another kind starts from presses in the same place."""

from __future__ import annotations

import math
from itertools import product
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pressed import contact, contacts
from tactomo_models.arrays import FloatArray
from tactomo_models.methods.kinds import (
    SHARES,
    Kind,
    as_kind,
    as_one,
    kind_of,
    log_prior,
    marginals,
)
from tactomo_models.scene.parameters import E1, E2, PEAK, SIZE, UNIT_M, X, Y

ONE = [Kind.EVEN, Kind.ROUNDED, Kind.RING, Kind.FALLING]
places = st.floats(-0.05, 0.05)
radii = st.floats(0.004, 0.03)
elongations = st.floats(0.0, 0.8)
angles = st.floats(-np.pi, np.pi)


def drawn(x: float, y: float, radius: float, elongation: float, angle: float) -> FloatArray:
    e = elongation * np.cos(angle), elongation * np.sin(angle)
    return contact(x, y, radius, peak=0.7, e=e)


def moments_of(each: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Area, centre and second moments of what even ellipses (K, COLUMNS) press together."""
    area = np.pi * np.exp(2 * each[:, SIZE])
    place, share = each[:, [X, Y]] * UNIT_M, area / area.sum()
    centre = share @ place
    second = np.zeros((2, 2))
    for one, weight, away in zip(each, share, place - centre, strict=True):
        # (B^T B)^-1 of `pressure_field`, over 4: half axes exp(s +- e)
        e = np.array([[one[E1], one[E2]], [one[E2], -one[E1]]])
        size, axes = np.linalg.eigh(e)
        half = np.exp(2 * (one[SIZE] + size))
        second += weight * ((axes * half) @ axes.T / 4 + np.outer(away, away))
    return float(area.sum()), centre, second


@given(places, places, radii, elongations, angles, st.sampled_from(ONE))
def test_another_kind_starts_in_the_same_place(
    x: float, y: float, radius: float, elongation: float, angle: float, kind: Kind
) -> None:
    """With the same area and form; and is of that kind."""
    own = drawn(x, y, radius, elongation, angle)
    (other,) = as_kind(own, kind)
    assert kind_of(other) is kind
    np.testing.assert_array_equal(other[: E2 + 1], own[: E2 + 1])


@given(places, places, radii, elongations, angles, st.sampled_from(ONE))
def test_what_is_even_again_is_what_it_was(
    x: float, y: float, radius: float, elongation: float, angle: float, kind: Kind
) -> None:
    own = drawn(x, y, radius, elongation, angle)
    (other,) = as_kind(own, kind)
    (again,) = as_kind(other, Kind.EVEN)
    assert again == pytest.approx(own)


@given(places, places, radii, elongations, angles)
def test_halves_keep_area_and_centre(
    x: float, y: float, radius: float, elongation: float, angle: float
) -> None:
    """And lie along the longer axis, where they do not overlap."""
    own = drawn(x, y, radius, elongation, angle)
    halves = as_kind(own, Kind.TWO)
    (area, centre, _), (own_area, own_centre, _) = moments_of(halves), moments_of(own[None])
    assert area == pytest.approx(own_area)
    assert centre == pytest.approx(own_centre, abs=1e-9)
    assert (halves[:, PEAK] == own[PEAK]).all()
    away = (halves[0] - halves[1])[[X, Y]] * UNIT_M
    assert np.linalg.norm(away) >= 2 * np.exp(halves[0, SIZE]) * (1 - 1e-9)
    if elongation > 1e-6:
        along = np.array([np.cos(angle / 2), np.sin(angle / 2)])
        assert abs(along @ away) == pytest.approx(np.linalg.norm(away))


@pytest.mark.parametrize("count", [1, 2, 4])
def test_kinds_of_a_scene_are_as_likely_altogether_as_one(count: int) -> None:
    """And a contact alone as its share, whatever else there may be."""
    likely = {kinds: math.exp(log_prior(kinds)) for kinds in product(ONE, repeat=count)}
    assert sum(likely.values()) == pytest.approx(1)
    for kind in ONE:
        first = sum(each for kinds, each in likely.items() if kinds[0] is kind)
        assert first == pytest.approx(SHARES[kind])


@given(st.lists(st.sampled_from(ONE), min_size=2, max_size=12), st.randoms())
def test_contacts_of_a_scene_are_more_often_alike(kinds: list[Kind], random: Random) -> None:
    """In any order."""
    alone = sum(log_prior([kind]) for kind in kinds)
    if len(set(kinds)) == 1:
        assert log_prior(kinds) > alone
    if len(set(kinds)) == len(kinds):
        assert log_prior(kinds) < alone
    again = random.sample(kinds, len(kinds))
    assert log_prior(again) == pytest.approx(log_prior(kinds))


@given(
    st.integers(1, 4).flatmap(
        lambda count: arrays(float, (count, len(SHARES)), elements=st.floats(-30, 30))
    )
)
def test_what_one_contact_may_be_is_the_sum_over_all_that_the_others_may_be(
    log_ratios: FloatArray,
) -> None:
    """Each choice of all kinds is as likely as the data and the prior have it."""
    every = list(product(range(len(SHARES)), repeat=len(log_ratios)))
    logs = np.array(
        [
            log_prior([list(SHARES)[kind] for kind in kinds])
            + log_ratios[np.arange(len(kinds)), kinds].sum()
            for kinds in every
        ]
    )
    likely, expected = np.exp(logs - logs.max()), np.zeros(log_ratios.shape)
    for kinds, each in zip(every, likely / likely.sum(), strict=True):
        expected[np.arange(len(kinds)), kinds] += each
    np.testing.assert_allclose(marginals(log_ratios), expected, rtol=1e-9, atol=1e-12)


def test_what_a_crowd_of_twelve_may_be_holds_what_a_float_holds() -> None:
    log_ratios = np.full((12, len(SHARES)), -np.inf)
    log_ratios[:, :2] = 0.0, 700.0
    np.testing.assert_allclose(marginals(log_ratios), np.eye(len(SHARES))[[1] * 12], atol=1e-9)


@given(st.lists(st.tuples(places, places, radii, elongations, angles), min_size=1, max_size=5))
def test_several_as_one_keep_centre_and_moments(
    each: list[tuple[float, float, float, float, float]],
) -> None:
    several = contacts(*(drawn(*one) for one in each))
    one = as_one(several)
    assert kind_of(one) is Kind.EVEN
    (area, centre, second), (own_area, own_centre, own) = moments_of(several), moments_of(one[None])
    assert own_centre == pytest.approx(centre, abs=1e-9)
    np.testing.assert_allclose(own, second, rtol=1e-6, atol=1e-12)
    assert one[PEAK] == pytest.approx(0.7 * min(area / own_area, 1.0))  # the same force

"""What presses: areas are kept, and contacts keep their identity."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tactomo_models import Press
from tactomo_models.arrays import FloatArray
from tactomo_models.scene.press import Profile, strongest
from tactomo_models.scene.tracking import FARTHEST_STEP_M, ContactTracker

STEP_M = 0.001
AXIS_M = np.arange(-0.06, 0.06, STEP_M)
X, Y = np.meshgrid(AXIS_M, AXIS_M)


@given(
    st.floats(-0.02, 0.02),
    st.floats(-0.02, 0.02),
    st.floats(0.006, 0.02),
    st.floats(0.006, 0.02),
    st.floats(0, math.pi),
    st.sampled_from(["ellipse", "rectangle", "ring"]),
)
def test_an_indenter_covers_its_area_wherever_it_stands(
    x: float, y: float, a: float, b: float, angle: float, shape: str
) -> None:
    press = Press(x, y, 100.0, a, b, angle, shape)  # type: ignore[arg-type]
    area = {"ellipse": math.pi, "rectangle": 4.0, "ring": math.pi * 3 / 4}[shape] * a * b
    covered = press.coverage(X, Y, STEP_M)
    assert covered.sum() * STEP_M**2 == pytest.approx(area, rel=0.06)
    assert (covered * X).sum() / covered.sum() == pytest.approx(x, abs=3e-4)


def test_a_ring_is_open_in_the_middle() -> None:
    press = Press(0.0, 0.0, 100.0, 0.02, shape="ring")
    assert press.coverage(np.array([0.0, 0.015]), np.zeros(2), STEP_M).tolist() == [0.0, 1.0]


@pytest.mark.parametrize(
    ("profile", "off_middle", "mean_kpa", "left"),
    [("dome", 1e-3, 100.0, 0.6), ("cone", 0.05, 50.0, 0.2)],
)
def test_a_dome_or_cone_presses_most_in_the_middle_and_not_at_its_rim(
    profile: Profile, off_middle: float, mean_kpa: float, left: float
) -> None:
    """As a ball does (Hertz), the mean pressure is two thirds of the largest; a cone's a third."""
    dome = Press(0.01, -0.005, 150.0, 0.02, 0.012, 0.7, profile=profile)
    pressure, coverage = strongest([dome], X, Y, STEP_M)
    assert pressure.max() == pytest.approx(150.0, rel=off_middle)
    assert (pressure * coverage).sum() / coverage.sum() == pytest.approx(mean_kpa, rel=0.02)
    along, across = (
        dome.pressure_at(np.array(0.01 + r * np.cos(t)), np.array(-0.005 + r * np.sin(t)))
        for r, t in ((0.016, 0.7), (0.0096, 0.7 + np.pi / 2))
    )
    assert along == pytest.approx(150.0 * left)  # at 0.8 of both half axes
    assert across == pytest.approx(along)


def test_the_strongest_of_two_indenters_is_felt_point_by_point() -> None:
    """A dome above a punch: the punch is felt where the dome has fallen below it."""
    dome, punch = Press(0, 0, 200.0, 0.02, profile="dome"), Press(0, 0, 120.0, 0.02)
    pressure, _ = strongest([dome, punch], np.array([0.0, 0.015, 0.017]), np.zeros(3), STEP_M)
    np.testing.assert_allclose(pressure, [200.0, 200.0 * np.sqrt(1 - 0.5625), 120.0])


def update(tracker: ContactTracker, centres_m: FloatArray) -> list[int]:
    """Identities of contacts that are all of one size."""
    return tracker.update(centres_m, np.full(len(centres_m), 200e-6))


def sees(tracker: ContactTracker, *x_mm: float, area_mm2: float = 200.0) -> list[int]:
    """Identities of contacts on the x axis."""
    centres = np.array([[1e-3 * x, 0.0] for x in x_mm])
    return tracker.update(centres, np.full(len(x_mm), 1e-6 * area_mm2))


places = st.lists(st.tuples(st.floats(-0.07, 0.07), st.floats(-0.07, 0.07)), max_size=6)


@given(places, places)
def test_no_identity_is_given_twice(
    before: list[tuple[float, float]], after: list[tuple[float, float]]
) -> None:
    tracker = ContactTracker()
    old = update(tracker, np.array(before).reshape(-1, 2))
    new = update(tracker, np.array(after).reshape(-1, 2))
    assert len(set(new)) == len(new)
    for identity, place in zip(new, after, strict=True):
        if identity in old:
            moved = math.dist(place, before[old.index(identity)])
            assert moved < FARTHEST_STEP_M
        else:
            assert identity > max(old, default=0)


@given(places, places)
def test_identities_are_not_used_again_after_a_tare(
    before: list[tuple[float, float]], after: list[tuple[float, float]]
) -> None:
    tracker = ContactTracker()
    old = update(tracker, np.array(before).reshape(-1, 2))
    tracker.clear()
    new = update(tracker, np.array(after).reshape(-1, 2))
    assert not set(old) & set(new)


@given(st.permutations(range(5)), st.floats(-0.004, 0.004), st.floats(-0.004, 0.004))
def test_identities_follow_contacts_and_not_their_order(
    order: list[int], dx: float, dy: float
) -> None:
    at = np.array([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05], [0.0, 0.0]])
    tracker = ContactTracker()
    first = update(tracker, at)
    again = update(tracker, at[order] + (dx, dy))
    assert again == [first[index] for index in order]


@pytest.mark.parametrize(("gap", "same"), [(1, True), (5, True), (6, False)])
def test_a_contact_outlives_a_short_gap(gap: int, same: bool) -> None:
    tracker = ContactTracker()
    here, beside = np.array([[0.02, 0.03]]), np.array([[0.02, 0.03], [-0.04, 0.0]])
    known, other = update(tracker, beside)
    for _ in range(gap):
        assert update(tracker, beside[1:]) == [other]
    back = update(tracker, np.vstack([here + 0.002, beside[1:]]))
    assert (back[0] == known) is same
    assert back[1] == other


def test_contacts_that_merge_and_part_again_have_their_identities_back() -> None:
    tracker = ContactTracker()
    both = sees(tracker, -12, 10)
    assert sees(tracker, 0) == [both[1]]  # the nearer one lives on
    assert sees(tracker, -12, 10) == both


def test_what_was_missed_does_not_take_the_identity_of_what_moved() -> None:
    tracker = ContactTracker()
    left, right = sees(tracker, -20, 0)
    assert sees(tracker, -2) == [right]
    assert sees(tracker, -18) == [right]  # it moved to where the other was
    assert left != right


@given(st.floats(0.1, 0.9), st.integers(1, 10), st.floats(15.0, 45.0), st.booleans())
def test_the_identity_stays_with_what_never_moved(
    share: float, frames: int, beside_mm: float, swapped: bool
) -> None:
    """A contact lands beside another, and at first both are seen as one, anywhere between them."""
    tracker = ContactTracker()
    between_mm = share * min(beside_mm, 25.0)
    for _ in range(3):
        (held,) = sees(tracker, 0)
    for _ in range(frames):
        assert sees(tracker, between_mm, area_mm2=500) == [held]
    told_apart = [0.5, beside_mm - 1]
    ids = sees(tracker, *(told_apart[::-1] if swapped else told_apart))
    assert ids[:: -1 if swapped else 1][0] == held


def test_a_contact_that_lands_by_and_by_does_not_take_the_identity_beside_it() -> None:
    tracker = ContactTracker()
    held = sees(tracker, 0) + sees(tracker, 0)
    for x_mm, area_mm2 in ((1, 240), (4, 290), (7, 350), (9, 430)):
        assert sees(tracker, x_mm, area_mm2=area_mm2) == held[:1]
    assert sees(tracker, 0, 20)[:1] == held[:1]


def test_the_identity_goes_with_a_contact_that_slides_and_not_to_where_it_was() -> None:
    tracker = ContactTracker()
    for x_mm in (0, 8, 16):
        ids = sees(tracker, x_mm)
    assert sees(tracker, 0, 20)[1:] == ids


def test_a_contact_that_has_long_been_larger_is_no_longer_where_it_was_before() -> None:
    tracker = ContactTracker()
    held = sees(tracker, 0)
    for x_mm in range(20):
        assert sees(tracker, x_mm, area_mm2=500) == held
    assert sees(tracker, 0, 20)[1:] == held

"""What presses: areas are kept, and contacts keep their identity."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tactomo_models import Press
from tactomo_models.scene.press import strongest
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


def test_a_dome_presses_most_in_the_middle_and_not_at_its_rim() -> None:
    """As a ball does (Hertz): the mean pressure is two thirds of the largest."""
    dome = Press(0.01, -0.005, 150.0, 0.02, 0.012, 0.7, profile="dome")
    pressure, coverage = strongest([dome], X, Y, STEP_M)
    assert pressure.max() == pytest.approx(150.0, rel=1e-3)
    assert (pressure * coverage).sum() / coverage.sum() == pytest.approx(100.0, rel=0.02)
    along, across = (
        dome.pressure_at(np.array(0.01 + r * np.cos(t)), np.array(-0.005 + r * np.sin(t)))
        for r, t in ((0.016, 0.7), (0.0096, 0.7 + np.pi / 2))
    )
    assert along == pytest.approx(150.0 * 0.6)  # at 0.8 of both half axes
    assert across == pytest.approx(along)


def test_the_strongest_of_two_indenters_is_felt_point_by_point() -> None:
    """A dome above a punch: the punch is felt where the dome has fallen below it."""
    dome, punch = Press(0, 0, 200.0, 0.02, profile="dome"), Press(0, 0, 120.0, 0.02)
    pressure, _ = strongest([dome, punch], np.array([0.0, 0.015, 0.017]), np.zeros(3), STEP_M)
    np.testing.assert_allclose(pressure, [200.0, 200.0 * np.sqrt(1 - 0.5625), 120.0])


places = st.lists(st.tuples(st.floats(-0.07, 0.07), st.floats(-0.07, 0.07)), max_size=6)


@given(places)
def test_contacts_that_stand_still_keep_their_identity(centres: list[tuple[float, float]]) -> None:
    tracker = ContactTracker()
    at = np.array(centres).reshape(-1, 2)
    first = tracker.update(at)
    assert len(set(first)) == len(first)
    again = tracker.update(at)
    assert sorted(again) == sorted(first)


@given(places, places)
def test_no_identity_is_given_twice(
    before: list[tuple[float, float]], after: list[tuple[float, float]]
) -> None:
    tracker = ContactTracker()
    old = tracker.update(np.array(before).reshape(-1, 2))
    new = tracker.update(np.array(after).reshape(-1, 2))
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
    old = tracker.update(np.array(before).reshape(-1, 2))
    tracker.clear()
    new = tracker.update(np.array(after).reshape(-1, 2))
    assert not set(old) & set(new)


@given(st.permutations(range(5)), st.floats(-0.004, 0.004), st.floats(-0.004, 0.004))
def test_identities_follow_contacts_and_not_their_order(
    order: list[int], dx: float, dy: float
) -> None:
    at = np.array([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05], [0.0, 0.0]])
    tracker = ContactTracker()
    first = tracker.update(at)
    again = tracker.update(at[order] + (dx, dy))
    assert again == [first[index] for index in order]


@pytest.mark.parametrize(("gap", "same"), [(1, True), (5, True), (6, False)])
def test_a_contact_outlives_a_short_gap(gap: int, same: bool) -> None:
    tracker = ContactTracker()
    here, beside = np.array([[0.02, 0.03]]), np.array([[0.02, 0.03], [-0.04, 0.0]])
    known, other = tracker.update(beside)
    for _ in range(gap):
        assert tracker.update(beside[1:]) == [other]
    back = tracker.update(np.vstack([here + 0.002, beside[1:]]))
    assert (back[0] == known) is same
    assert back[1] == other


def test_contacts_that_merge_and_part_again_have_their_identities_back() -> None:
    tracker = ContactTracker()
    apart = np.array([[-0.012, 0.0], [0.010, 0.0]])
    both = tracker.update(apart)
    assert tracker.update(np.array([[0.0, 0.0]])) == [both[1]]  # the nearer one lives on
    assert tracker.update(apart) == both


def test_what_was_missed_does_not_take_the_identity_of_what_moved() -> None:
    tracker = ContactTracker()
    left, right = tracker.update(np.array([[-0.02, 0.0], [0.0, 0.0]]))
    assert tracker.update(np.array([[-0.002, 0.0]])) == [right]
    assert tracker.update(np.array([[-0.018, 0.0]])) == [right]  # it moved to where the other was
    assert left != right

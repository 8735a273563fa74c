"""Measures against cases whose answer is known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_score import made_score
from tactomo_lab.scenes.measures import (
    MATCH_M,
    ContactScore,
    Score,
    correlation,
    full_range,
    match,
    relative_error,
    score_contact,
    summarise,
)
from tactomo_lab.scenes.simulation import TrueContact
from tactomo_models import Contact, SensorDescription
from tactomo_models.scene.pressure import PressureRange

TRUE = TrueContact(0.01, -0.02, 400e-6, 180.0, 0.15, "ellipse")
FOUND = Contact(7, 0.01, -0.02, 400e-6, 0.15, 0.01, 180.0)


def test_a_perfect_image_and_none() -> None:
    truth = np.random.default_rng(0).random((5, 7))
    assert correlation(2 * truth + 1, truth) == pytest.approx(1)
    assert correlation(-truth, truth) == pytest.approx(-1)
    assert relative_error(truth, truth) == 0
    for nothing in (None, np.zeros_like(truth)):
        assert correlation(nothing, truth) == 0
        assert relative_error(nothing, truth) == 1


@given(order=st.permutations(range(5)), known=st.integers(0, 5))
def test_contacts_are_matched_whatever_their_order(order: list[int], known: int) -> None:
    true = [replace(TRUE, x_m=0.025 * k) for k in range(5)]
    found = [replace(FOUND, x_m=0.025 * k + 0.4 * MATCH_M) for k in order[:known]]
    assert sorted(match(found, true)) == sorted(enumerate(order[:known]))


def test_too_far_is_no_match_and_spoils_no_other() -> None:
    far = replace(FOUND, x_m=TRUE.x_m + 1.1 * MATCH_M)
    assert match([far], [TRUE]) == []
    near = replace(FOUND, x_m=TRUE.x_m + 0.9 * MATCH_M)
    assert match([far, near], [TRUE]) == [(1, 0)]


def test_a_false_contact_far_away_does_not_push_the_others() -> None:
    """Least total distance alone would give the near one to the wrong contact."""
    true = [TRUE, replace(TRUE, x_m=TRUE.x_m + 0.011)]
    near, false = (replace(FOUND, x_m=TRUE.x_m + x) for x in (0.010, 0.100))
    assert match([near, false], true) == [(0, 1)]


def test_a_contact_is_scored_in_the_units_it_says(paper: SensorDescription) -> None:
    assert full_range(paper) == 0.25
    off = replace(FOUND, x_m=0.013, y_m=-0.016, magnitude=0.1)
    of_peak = replace(FOUND, peak_kpa=190.0, peak_sigma_kpa=4.0)
    assert score_contact(paper, TRUE, of_peak).peak_error_sigmas == pytest.approx(2.5)
    assert not score_contact(paper, TRUE, of_peak).above
    one = score_contact(paper, TRUE, off)
    assert one.centre_error_mm == pytest.approx(5)
    assert one.magnitude_error == pytest.approx(-0.2)
    assert one.magnitude_sigma == pytest.approx(0.04)
    assert not one.missed
    assert score_contact(paper, TRUE, None).missed


def scene(paper: SensorDescription, *found: Contact | None, **other: object) -> Score:
    contacts = tuple(score_contact(paper, TRUE, contact) for contact in found)
    known = {"contacts": contacts, "groups": len(found), "tier": "levelset"}
    return made_score(**known | {"found": sum(c is not None for c in found)} | other)


def test_a_summary_by_hand(paper: SensorDescription) -> None:
    errors = (-0.02, 0.0, 0.03)  # of magnitude, with a standard uncertainty of 0.01
    found = [replace(FOUND, magnitude=0.15 + error) for error in errors]
    all_of = summarise(
        [
            scene(paper, *found[:2], seconds=0.1),
            scene(paper, found[2], None, icc=0.5, seconds=0.3),
            scene(paper, FOUND, found=3, flags=("misfit_high",), seconds=0.2),
        ]
    )
    assert all_of.frames == 3
    assert all_of.icc == pytest.approx((0.9 + 0.5 + 0.9) / 3)
    assert all_of.count_right == pytest.approx(1 / 3)
    assert all_of.missed == pytest.approx(1 / 5)
    assert all_of.false == pytest.approx(2 / 3)
    assert all_of.centre_mm == 0
    assert all_of.magnitude_error == pytest.approx((0.08 + 0 + 0.12 + 0) / 4)
    assert all_of.within_sigma == pytest.approx(2 / 4)
    peaks = [replace(FOUND, peak_kpa=kpa, peak_sigma_kpa=4.0) for kpa in (177.0, 185.0, 183.0)]
    assert summarise([scene(paper, one) for one in peaks]).peak_within_sigma == pytest.approx(2 / 3)
    assert all_of.warned == pytest.approx(1 / 3)
    assert all_of.seconds == 0.2


def told(paper: SensorDescription, peak_kpa: float, sigma_kpa: float, **other: Any) -> ContactScore:
    found = replace(FOUND, peak_kpa=peak_kpa, peak_sigma_kpa=sigma_kpa, **other)
    return score_contact(paper, replace(TRUE, pressure_kpa=200.0), found)


def test_a_peak_is_surely_wrong_by_three_sigmas_and_ten_percent(paper: SensorDescription) -> None:
    assert told(paper, 170.0, 9.0).surely_wrong is True
    assert told(paper, 170.0, 11.0).surely_wrong is False
    assert told(paper, 181.0, 1.0).surely_wrong is False
    assert told(paper, 230.0, 9.0).surely_wrong is True
    assert told(paper, 150.0, float("nan")).surely_wrong is None


def test_a_peak_told_above_a_range_that_it_lies_in_is_surely_wrong(
    paper: SensorDescription,
) -> None:
    above = {"pressure_range": PressureRange.ABOVE}
    assert told(paper, 225.0, float("nan"), **above).surely_wrong is True
    assert told(paper, 215.0, float("nan"), **above).surely_wrong is False
    assert told(paper, 150.0, float("nan"), **above).surely_wrong is False  # it is above


def test_beyond_the_table_nothing_finite_is_right(paper: SensorDescription) -> None:
    true = replace(TRUE, pressure_kpa=400.0)  # of a table that ends at 300
    unknown, above = float("nan"), PressureRange.ABOVE

    def overload(peak_kpa: float, sigma_kpa: float, **other: Any) -> ContactScore:
        found = replace(FOUND, peak_kpa=peak_kpa, peak_sigma_kpa=sigma_kpa, **other)
        return score_contact(paper, true, found)

    right = [
        overload(300.0, unknown, pressure_range=above),
        overload(280.0, unknown, max_kpa=float("inf")),
    ]
    wide = overload(290.0, 100.0, max_kpa=float("inf"))
    wrong = overload(298.0, 7.0, max_kpa=310.0)
    silent = score_contact(paper, true, None)
    all_of = [*right, wide, wrong, silent]
    assert all(one.beyond for one in all_of)
    assert [one.unbounded for one in all_of] == [True, True, False, False, False]
    assert [one.denied for one in all_of] == [False, False, False, True, False]
    assert [one.peak_right for one in all_of] == [one.unbounded for one in all_of]
    assert wrong.surely_wrong
    assert not right[0].surely_wrong
    frames = [replace(scene(paper, FOUND), contacts=(one,)) for one in all_of]
    counted = summarise([*frames, scene(paper, FOUND)])  # one in range is not counted
    assert counted.overload_right == pytest.approx(2 / 5)
    assert counted.overload_wrong == pytest.approx(1 / 5)
    assert np.isnan(summarise([scene(paper, FOUND)]).overload_right)


def test_shares_of_peaks(paper: SensorDescription) -> None:
    """Of the true contacts, of those with a sigma, and of those with that or told above."""
    unknown = float("nan")
    frames = [
        *(told(paper, 170.0, 9.0), told(paper, 199.0, 2.0), told(paper, 204.0, 2.0)),
        *(told(paper, 215.0, unknown, pressure_range=PressureRange.ABOVE),),
        *(told(paper, 150.0, unknown), score_contact(paper, TRUE, None)),
    ]
    all_of = summarise([replace(scene(paper, FOUND), contacts=(one,)) for one in frames])
    assert all_of.peak_right == pytest.approx(3 / 6)
    assert all_of.peak_within_sigma == pytest.approx(1 / 3)
    assert all_of.peak_surely_wrong == pytest.approx(1 / 4)
    nothing = summarise([scene(paper, None)])
    assert np.isnan(nothing.peak_surely_wrong)


def test_what_was_never_measured_is_nan(paper: SensorDescription) -> None:
    nothing = summarise([scene(paper, None)])
    assert nothing.missed == 1
    assert np.isnan([nothing.centre_mm, nothing.magnitude_error, nothing.within_sigma]).all()
    unknown = replace(FOUND, magnitude=float("nan"), magnitude_sigma=float("nan"))
    assert np.isnan(summarise([scene(paper, unknown)]).within_sigma)

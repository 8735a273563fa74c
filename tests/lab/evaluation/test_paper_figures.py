"""The paper's figures: what is pressed, how it is measured, and what is said of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tactomo_lab.evaluation import paper as figures
from tactomo_lab.evaluation.paper import (
    CASE_KPA,
    image_mass,
    image_of,
    locate,
    magnitude_errors,
    magnitude_estimate,
    paper_scenes,
    places,
    points_of,
    pressed_in_turn,
    single_areas,
)
from tactomo_lab.evaluation.play import Outcome, play
from tactomo_lab.scenes.case import Case
from tactomo_lab.scenes.drawing import BOTH_CHANNELS, outline_of
from tactomo_models import SensorDescription
from tactomo_models.scene.contacts import Contact


@pytest.fixture(scope="module")
def outcome(small: SensorDescription) -> Outcome:
    """One press in the middle, as `fit` has it."""
    (case,) = pressed_in_turn(small, "tuning", 0, single_areas(small)[:1])
    (made,) = play([case], "fit")
    return made


def test_cases_fit_on_the_sheet(paper: SensorDescription) -> None:
    assert len(single_areas(paper)) == 16
    for press in (*single_areas(paper), *places(paper)):
        x, y = outline_of(press)
        assert paper.on_sheet(x, y, paper.sheet.frame_width_m).all()
    there = {(round(press.x_m, 6), round(press.y_m, 6)) for press in places(paper)}
    along_m = (-0.036, -0.018, 0.0, 0.018, 0.036)
    assert there == {(x, y) for x in along_m for y in along_m}


@pytest.mark.slow
def test_scenes_of_the_simulation_study(small: SensorDescription) -> None:
    drawn = list(paper_scenes(small, "tuning", 1, np.inf))
    assert [len(scene.plan.frames[0]) for scene in drawn] == [1, 2, 3, 4]
    for scene in drawn:
        assert {press.shape for press in scene.plan.frames[0]} == {"ellipse"}
        assert 0.05 <= scene.truth.map.max() <= 0.25
        assert scene.tare.magnitude is not None
        assert drawn[0].tare.magnitude is not None
        # One even sheet under all of them.
        np.testing.assert_array_equal(scene.tare.magnitude, drawn[0].tare.magnitude)
        assert scene.description.magnitude is not None
        assert scene.description.magnitude.response.sign == -1
    points = points_of(play(drawn[:2], "tikhonov", "noser"))
    ways = [(method, contacts) for method, _, contacts in points]
    assert ways == [("tikhonov", 1), ("noser", 1), ("tikhonov", 2), ("noser", 2)]
    assert all(summary.icc > 0.3 for summary in points.values())


def test_a_rig_measures_one_uneven_sensor(
    small: SensorDescription, monkeypatch: pytest.MonkeyPatch
) -> None:
    def pressed(sheet: int) -> Case:
        return next(pressed_in_turn(small, "tuning", sheet, single_areas(small)))

    case, again = pressed(0), pressed(0)
    monkeypatch.setattr(figures, "PRESSED_SNR_DB", np.inf)
    silent, other = pressed(0), pressed(1)
    for name in BOTH_CHANNELS:
        scan, same, clean = (one.frames[0].scans[name] for one in (case, again, silent))
        np.testing.assert_array_equal(scan, same)
        rest = getattr(silent.tare, name)
        assert np.std(scan - clean) == pytest.approx(1e-3 * np.sqrt(np.mean(rest**2)), rel=0.4)
        assert 0.003 < np.std(getattr(other.tare, name) / rest) < 0.3
        assert np.abs(clean - rest).max() > 1e-3 * np.abs(rest).max()


def test_a_press_is_located(outcome: Outcome) -> None:
    place = locate(outcome)
    assert place.contacts == 1
    assert place.contact_error_mm < 1
    assert place.mass_error_mm < 1
    nothing = replace(outcome, made=replace(outcome.made, map=None, contacts=()))
    assert not image_of(nothing).any()
    place = locate(nothing)
    assert np.isnan([place.mass_error_mm, place.contact_error_mm]).all()
    assert place.contacts == 0


def test_one_number_for_an_image() -> None:
    image = np.array([0.0, 0.1, 0.76, 0.8, 1.0])
    assert magnitude_estimate(image, "tikhonov") == 1.0
    assert magnitude_estimate(image, "network") == pytest.approx((0.76 + 0.8 + 1.0) / 3)
    assert magnitude_estimate(np.zeros(3), "network") == 0


def test_the_magnitude_error_is_the_largest_spread_at_one_pressure(
    small: SensorDescription, outcome: Outcome
) -> None:
    """Over the largest estimate of all, as the paper normalises, and over the range of 0.25."""
    estimates = np.array(
        [[0.02, 0.04, 0.06, 0.08], [0.05, 0.10, 0.16, 0.20], [0.02, 0.03, 0.06, 0.09]]
    )
    contact = Contact(1, 0.0, 0.0, 1e-4, 0.1)
    made = [
        replace(outcome.made, map=np.full((21, 21), value, np.float32), contacts=(contact,))
        for value in estimates.ravel()
    ]
    (error,) = magnitude_errors([replace(outcome, made=each) for each in made], small)
    assert error.error == pytest.approx(0.12 / 0.20, rel=1e-5)
    assert error.of_range == pytest.approx(0.12 / 0.25, rel=1e-5)
    assert error.of_contacts == 0
    assert error.pressure_kpa == CASE_KPA[-1]
    np.testing.assert_allclose(error.estimates, estimates, rtol=1e-5)


def test_the_mass_of_an_image(small: SensorDescription) -> None:
    image = np.zeros((21, 21))
    image[3, 5], image[7, 5] = 1.0, 3.0
    x_m, y_m = image_mass(image, small)
    assert x_m == pytest.approx(small.map_x_m[5])
    assert y_m == pytest.approx(small.map_y_m[6])
    assert np.isnan(image_mass(np.zeros((21, 21)), small)).all()

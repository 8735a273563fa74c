"""The paper's figures: what is pressed, how it is measured, and what is said of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tactomo_lab.evaluation.paper import (
    CASE_KPA,
    LOCALISATION,
    MORE,
    SINGLE,
    TWO,
    Arrangement,
    Frame,
    Rig,
    cells,
    image_cases,
    image_mass,
    locate,
    magnitude_errors,
    magnitude_estimate,
    paper_scenes,
    presses_of,
    read_areas,
)
from tactomo_lab.evaluation.play import play
from tactomo_lab.scenes.drawing import BOTH_CHANNELS, gap_m, outline_of
from tactomo_lab.scenes.simulation import truth_of
from tactomo_models import Artifact, Reconstruction, SensorDescription, build_artifact
from tactomo_models.arrays import FloatArray
from tactomo_models.scene.contacts import Contact
from tactomo_protocol import Channel

SHORT = [replace(case, pressures_kpa=((200.0,),)) for case in SINGLE[:2]]


@pytest.fixture(scope="module")
def rig(small: SensorDescription) -> Rig:
    return Rig(small, "tuning", 0)


@pytest.fixture(scope="module")
def small_artifact(small: SensorDescription) -> Artifact:
    return build_artifact(small)


@pytest.fixture(autouse=True)
def _built(small_artifact: Artifact, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "tactomo_lab.evaluation.play.load_or_build_artifact"
    monkeypatch.setattr(name, lambda _: small_artifact)


def frame(
    description: SensorDescription,
    case: Arrangement,
    pressures_kpa: tuple[float, ...],
    image: FloatArray | None,
    method: str = "network",
    contacts: tuple[Contact, ...] = (),
) -> Frame:
    shown = None if image is None else image.astype(np.float32)
    made = Reconstruction(shown, None, None, contacts, "noser", "by hand", 1.0)
    truth = truth_of(description, presses_of(description, case, pressures_kpa))
    return Frame(case, pressures_kpa, 0, method, made, truth)


# ------------------------------------------------------------------ what is pressed


def test_cases_fit_on_the_sheet_and_lie_apart(paper: SensorDescription) -> None:
    assert [case.number for case in (*SINGLE, *TWO, *MORE)] == list(range(1, 11))
    assert len(LOCALISATION) == 25
    assert [len(case.pressures_kpa) for case in (*SINGLE, *TWO)] == [4, 4, 4, 4, 4, 4]
    for case in (*SINGLE, *TWO, *MORE, *LOCALISATION):
        for pressures_kpa in case.pressures_kpa:
            presses = presses_of(paper, case, pressures_kpa)
            for number, press in enumerate(presses):
                x, y = outline_of(press)
                assert paper.on_sheet(x, y, paper.sheet.frame_width_m).all()
                assert all(gap_m(press, other) > 0.005 for other in presses[:number])
    places = {(case.areas[0].x_mm, case.areas[0].y_mm) for case in LOCALISATION}
    assert places == {(18.0 * i, 18.0 * j) for i in range(-2, 3) for j in range(-2, 3)}


@pytest.mark.slow
def test_scenes_of_the_simulation_study(small: SensorDescription) -> None:
    drawn = list(paper_scenes(small, "tuning", 1, snr_db=np.inf))
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
    other = next(paper_scenes(small, "reporting", 1))
    assert other.plan.frames != drawn[0].plan.frames


@pytest.mark.slow
def test_points_of_the_simulation_study(small: SensorDescription) -> None:
    drawn = list(paper_scenes(small, "tuning", 1, contacts=(1, 2)))
    points = cells(play(drawn, "tikhonov", "noser"))
    assert [(p.method, p.contacts) for p in points] == [
        ("tikhonov", 1),
        ("noser", 1),
        ("tikhonov", 2),
        ("noser", 2),
    ]
    for point in points:
        (outcome,) = play([drawn[point.contacts - 1]], point.method)
        assert point.summary.icc == outcome.score.icc > 0.3


def test_a_rig_measures_one_uneven_sensor(small: SensorDescription, rig: Rig) -> None:
    presses = presses_of(small, SINGLE[0], (200.0,))
    quiet = Rig(small, "tuning", 0, snr_db=np.inf)
    other = Rig(small, "tuning", 1, snr_db=np.inf)
    case, again, silent = (each.press(presses) for each in (rig, Rig(small, "tuning", 0), quiet))
    (scan,), (same,), (clean,) = ([f.scans for f in one.frames] for one in (case, again, silent))
    for name in BOTH_CHANNELS:
        np.testing.assert_array_equal(scan[name], same[name])
        rest = getattr(quiet.tare, name)
        noise = scan[name] - clean[name]
        assert np.std(noise) == pytest.approx(1e-3 * np.sqrt(np.mean(rest**2)), rel=0.4)
        assert 0.003 < np.std(getattr(other.tare, name) / rest) < 0.3
    bare = rig.press(()).frames[0].scans
    assert not np.array_equal(scan[Channel.MAGNITUDE], bare[Channel.MAGNITUDE])


# ------------------------------------------------------------------ how it is measured


def test_frames_come_from_a_cold_start(small: SensorDescription, rig: Rig) -> None:
    frames = list(image_cases([rig], SHORT, ["fit"]))
    alone = list(image_cases([rig], SHORT[1:], ["fit"]))
    np.testing.assert_array_equal(alone[-1].image, frames[-1].image)
    place = locate(frames[-1], small)
    assert place.contacts == 1
    assert place.contact_error_mm < 1
    assert place.mass_error_mm < 1


def test_one_number_for_an_image() -> None:
    image = np.array([0.0, 0.1, 0.76, 0.8, 1.0])
    assert magnitude_estimate(image, "tikhonov") == 1.0
    assert magnitude_estimate(image, "network") == pytest.approx((0.76 + 0.8 + 1.0) / 3)
    assert magnitude_estimate(np.zeros(3), "network") == 0


def test_the_magnitude_error_is_the_largest_spread_at_one_pressure(
    small: SensorDescription,
) -> None:
    """Over the largest estimate of all, as the paper normalises, and over the range of 0.25."""
    estimates = np.array(
        [[0.02, 0.04, 0.06, 0.08], [0.05, 0.10, 0.16, 0.20], [0.02, 0.03, 0.06, 0.09]]
    )
    estimates = np.vstack([estimates, [0.05, 0.15, 0.12, 0.10]])  # the last one falls again
    contact = Contact(1, 0.0, 0.0, 1e-4, 0.1)
    frames = [
        frame(small, case, (kpa,), np.full((21, 21), value), contacts=(contact,))
        for case, row in zip(SINGLE, estimates, strict=True)
        for kpa, value in zip(CASE_KPA, row, strict=True)
    ]
    (error,) = magnitude_errors(frames, small)
    assert error.error == pytest.approx(0.12 / 0.20, rel=1e-5)
    assert error.of_range == pytest.approx(0.12 / 0.25, rel=1e-5)
    assert error.of_contacts == 0
    assert error.rises == 0.75
    assert error.pressure_kpa in (160.0, 200.0)  # the same at both


def test_the_mass_of_an_image(small: SensorDescription) -> None:
    image = np.zeros((21, 21))
    image[3, 5], image[7, 5] = 1.0, 3.0
    x_m, y_m = image_mass(image, small)
    assert x_m == pytest.approx(small.map_x_m[5])
    assert y_m == pytest.approx(small.map_y_m[6])
    assert np.isnan(image_mass(np.zeros((21, 21)), small)).all()


def test_what_was_not_found_has_no_place(small: SensorDescription) -> None:
    place = locate(frame(small, LOCALISATION[0], (200.0,), None), small)
    assert np.isnan([place.mass_error_mm, place.contact_error_mm]).all()
    assert place.contacts == 0


def test_areas_of_one_image(small: SensorDescription) -> None:
    case, pressures_kpa = TWO[0], (200.0, 140.0)
    truth = frame(small, case, pressures_kpa, None).truth.map
    read = read_areas(frame(small, case, pressures_kpa, truth), small)
    assert read.told_apart
    assert read.ordered == (True,)
    assert read.alike == ()
    assert read.icc == pytest.approx(1)
    assert not read.counted
    merged = read_areas(frame(small, case, pressures_kpa, truth + truth.max()), small)
    assert not merged.told_apart
    nothing = read_areas(frame(small, case, (200.0, 200.0), None), small)
    assert not nothing.told_apart
    assert nothing.alike == (0.0,)
    half = replace(nothing, estimates=(0.1, 0.2))
    assert half.alike == (0.5,)
    assert replace(read, estimates=(0.1, 0.2)).ordered == (False,)

"""Rows of the field's evaluation: each is made of the scenes that it names."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from tactomo_lab.evaluation.field import STILL_ROWS, cases_of_row, frames_of_row
from tactomo_lab.evaluation.moving import draw_sequence
from tactomo_lab.evaluation.play import play
from tactomo_lab.evaluation.regimes import make_case
from tactomo_lab.scenes.case import Case, as_described, measure, simulate
from tactomo_lab.scenes.drawing import seed_of
from tactomo_lab.scenes.measures import summarise
from tactomo_models import SensorDescription
from tactomo_models.scene.press import Press
from tactomo_protocol import Channel


def one_of(small: SensorDescription, row: str) -> dict[str, Case]:
    lines = cases_of_row(small, row, "tuning", 1)
    return {line: scene for line, scenes in lines.items() for scene in scenes}


@pytest.mark.slow
@pytest.mark.parametrize("row", STILL_ROWS)
def test_a_scene_of_each_row_is_reconstructed_and_scored(
    small: SensorDescription, row: str
) -> None:
    scenes = one_of(small, row)
    lines = frames_of_row(small, row, "tikhonov", "tuning", 1)
    assert list(lines) == list(scenes)
    for line, (outcome,) in lines.items():
        assert len(outcome.score.contacts) == len(scenes[line].frames[0].presses)
        assert -1 <= outcome.score.icc <= 1
        assert outcome.score.seconds > 0


@pytest.mark.slow
def test_a_small_ball_in_a_crowd_is_not_surely_flat(paper: SensorDescription) -> None:
    """What was predicted from afar is solved for: here a ball was flat with odds of 10^7 to 1."""
    (outcome,) = play([make_case(paper, "crowded-soft", "tuning", 3)], "auto")
    assert outcome.score.count_right
    assert not any(contact.surely_wrong for contact in outcome.score.contacts)


@pytest.mark.slow
def test_a_scene_that_is_replaced_at_once_is_found_without_a_network(
    paper: SensorDescription,
) -> None:
    """Begun at contacts of before that still explain something, one contact or four were told."""
    rectangle = partial(Press, shape="rectangle")
    ring, ball = partial(Press, shape="ring"), partial(Press, profile="dome")
    scenes = [
        [Press(-0.015, -0.049, 200, 0.0095), rectangle(-0.006, -0.010, 193, 0.0134, 0.0083, 3.05)],
        [ring(0.021, -0.047, 213, 0.0158, 0.0151, 0.35), ball(0.041, 0.012, 158, 0.0088)],
        [ring(-0.025, 0.048, 104, 0.0110)],
        [ball(0.021, 0.002, 125, 0.0169, 0.0092, 1.09), ring(0.019, -0.040, 117, 0.0116)],
    ]
    plan = replace(as_described(paper, *scenes), snr_db=60.0, snr_of="voltage")
    seeds = [seed_of("tuning", what, 0) for what in ("replaced", "noise of replaced")]
    case = measure(simulate(paper, plan, seeds[0]), "tuning", 0, seeds[1])
    found = [outcome.score.found for outcome in play([case], "fit")]
    assert found == [2, 2, 1, 2]


@pytest.mark.slow
def test_a_moving_scene_is_scored_where_no_scan_is_lost(small: SensorDescription) -> None:
    sequence = draw_sequence(small, "tuning", 0)
    (outcomes,) = frames_of_row(small, "moving", "tikhonov", "tuning", 1).values()
    frames = [outcome.score for outcome in outcomes]
    assert len(frames) == sum(len(frame.scans) == 2 for frame in sequence.frames)
    assert 0 < summarise(frames).icc < 1


def assert_ten_times_as_noisy(noisy: Case, quiet: Case) -> None:
    assert quiet.tare.magnitude_noise is not None
    assert noisy.tare.magnitude_noise is not None
    np.testing.assert_allclose(
        noisy.tare.magnitude_noise / quiet.tare.magnitude_noise, 10, rtol=1e-6
    )


def test_ordinary_scenes_are_the_same_ones_at_each_noise(small: SensorDescription) -> None:
    quiet, noisy, noisiest = one_of(small, "ordinary").values()
    assert quiet.frames[0].presses == noisy.frames[0].presses == noisiest.frames[0].presses
    assert [case.plan.snr_db for case in (quiet, noisy, noisiest)] == [40, 20, 10]
    assert_ten_times_as_noisy(noisy, quiet)


def test_a_regime_is_measured_at_its_own_noise_or_of_the_change(small: SensorDescription) -> None:
    own, quiet, noisy = (
        make_case(small, "mixed", "tuning", 0, snr_db=snr_db) for snr_db in (None, 40.0, 20.0)
    )
    assert own.plan.frames == quiet.plan.frames == noisy.plan.frames
    told = [(case.plan.snr_db, case.plan.snr_of) for case in (own, quiet, noisy)]
    assert told == [(60, "voltage"), (40, "change"), (20, "change")]
    assert_ten_times_as_noisy(noisy, quiet)


def test_one_graded_sheet_has_no_structure_scan(small: SensorDescription) -> None:
    (scene,) = one_of(small, "graded").values()
    assert scene.frames[0].scans.keys() == {Channel.MAGNITUDE}
    assert scene.tare.structure is None
    assert scene.description.magnitude is not None
    assert scene.description.channels == ("magnitude",)
    assert scene.description.sha256 == small.sha256  # the same artifact serves
    (press,) = scene.plan.frames[0]
    highest = scene.description.magnitude.response.change(np.array(press.pressure_kpa))
    assert 0.5 * highest < scene.truth.map.max() <= highest


def test_a_ball_has_its_peak_and_the_mean_over_its_area(small: SensorDescription) -> None:
    (scene,) = one_of(small, "soft").values()
    (press,), (contact,) = scene.plan.frames[0], scene.truth.contacts
    assert press.profile == "dome"
    assert contact.pressure_kpa == press.pressure_kpa
    cell_m2 = np.diff(small.map_x_m)[0] * np.diff(small.map_y_m)[0]
    in_all = scene.truth.map.sum() * cell_m2
    assert contact.magnitude * contact.area_m2 == pytest.approx(in_all, rel=1e-6)

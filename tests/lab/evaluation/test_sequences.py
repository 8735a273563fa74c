"""Mixed presses that move: they land, glide, change pressure and lift, apart from each other."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, pairwise

import numpy as np
import pytest
from tactomo_lab.evaluation.field import frames_of_row
from tactomo_lab.evaluation.moving import COMING, Step, mixed_sequence, mixed_steps, palm_sequence
from tactomo_lab.evaluation.play import play
from tactomo_lab.evaluation.regimes import KINDS, PALM_FRAMES, Draw
from tactomo_lab.scenes.case import Case, Frame
from tactomo_lab.scenes.drawing import BOTH_CHANNELS, GAP_M, gap_m, outline_of
from tactomo_models import Press, SensorDescription
from tactomo_models.arrays import FloatArray


@pytest.fixture(scope="module")
def changing(small: SensorDescription) -> Case:
    return mixed_sequence(small, "tuning", 0, "each change")


@pytest.fixture(params=range(4))
def steps(paper: SensorDescription, request: pytest.FixtureRequest) -> list[Step]:
    return mixed_steps(Draw(paper, np.random.default_rng(request.param), request.param))


def turns(steps: list[Step]) -> Iterator[tuple[Press, Press]]:
    """Each press in a frame and in the next one."""
    for before, now in pairwise(steps):
        for name in before.presses.keys() & now.presses.keys():
            yield before.presses[name], now.presses[name]


def test_what_happens_in_it(steps: list[Step]) -> None:
    assert 60 <= len(steps) <= 120
    assert not any(step.presses for step in steps[:4])
    assert max(len(step.presses) for step in steps) == len(names(steps))
    assert max(map(way_m, turns(steps)), default=0) <= 0.006  # 120 mm/s at 20 frames a second


def way_m(turn: tuple[Press, Press]) -> float:
    before, now = turn
    return float(np.hypot(now.x_m - before.x_m, now.y_m - before.y_m))


def test_the_first_sequences_have_most_presses_which_glide_change_and_lift(
    small: SensorDescription,
) -> None:
    drawn = [mixed_steps(Draw(small, np.random.default_rng(number), number)) for number in range(8)]
    assert [len(names(steps)) for steps in drawn] == [4, 3, 2, 1] * 2
    kinds = {
        (p.shape, p.profile) for steps in drawn for step in steps for p in step.presses.values()
    }
    assert kinds == set(KINDS)
    moving = [turn for steps in drawn for turn in turns(steps)]
    assert any(way_m(turn) > 0.001 for turn in moving)
    assert any(0 < abs(a.pressure_kpa - b.pressure_kpa) < 40 for a, b in moving)  # no landing
    lifted = [names(steps) - steps[-1].presses.keys() for steps in drawn]
    assert 0 < sum(map(len, lifted)) < 20


def names(steps: list[Step]) -> set[str]:
    return {name for step in steps for name in step.presses}


def test_presses_stay_on_the_sheet_and_apart(steps: list[Step], paper: SensorDescription) -> None:
    for step in steps:
        presses = step.presses.values()
        assert all(gap_m(one, other) > GAP_M for one, other in combinations(presses, 2))
        for press in presses:
            x, y = outline_of(press)
            assert paper.on_sheet(x, y, paper.sheet.frame_width_m).all()


@pytest.mark.slow
def test_noise_grows_with_each_change_or_stays(changing: Case, small: SensorDescription) -> None:
    steady = mixed_sequence(small, "tuning", 0, "voltage")
    assert [f.presses for f in steady.frames] == [f.presses for f in changing.frames]
    at_rest = not_pressed(changing)
    for name in BOTH_CHANNELS:
        rest = getattr(changing.tare, name)  # without noise
        assert all((frame.scans[name] == rest).all() for frame in at_rest)
        noise = np.concatenate([frame.scans[name] - rest for frame in not_pressed(steady)])
        assert np.std(noise) == pytest.approx(1e-3 * np.sqrt(np.mean(rest**2)), rel=0.1)
        pressed = [number for number, frame in enumerate(steady.frames) if frame.presses]
        off, near = (
            np.array([case.frames[number].scans[name] - rest for number in pressed])
            for case in (changing, steady)
        )
        expected = np.hypot(0.01 * rms(near), 1e-3 * rms(rest))  # of both noises
        assert np.mean(rms(off - near) / expected) == pytest.approx(1, abs=0.1)


def rms(volts: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(volts**2, axis=-1)))


def not_pressed(case: Case) -> list[Frame]:
    return [frame for frame in case.frames if not frame.presses]


@pytest.mark.slow
def test_scans_tell_the_noise_that_those_at_rest_have_not(changing: Case) -> None:
    """Where nothing tells the noise, two frames of three are distrusted."""
    scores = [outcome.score for outcome in play([changing], "fit")]
    assert len(scores) == len(changing.frames)
    assert np.mean([score.warned for score in scores]) < 0.1


@pytest.mark.slow
def test_a_palm_is_followed_while_the_reference_is(small: SensorDescription) -> None:
    case = palm_sequence(small, "tuning", 0)
    assert case.is_followed
    assert 1 <= case.frames[PALM_FRAMES].time_s <= 600
    light, palm = (
        [f.presses["A"].pressure_kpa for f in case.frames if f.phase == phase and f.presses]
        for phase in (COMING, "palm")
    )
    assert max(light, default=0) < 2 <= min(palm)
    (outcomes,) = frames_of_row(small, "palm", "tikhonov", "tuning", 1).values()
    counted = [outcome.score.count_right for outcome in outcomes]
    assert len(counted) == len(palm)
    assert set(counted) <= {True, False}


@pytest.mark.slow
def test_a_palm_that_falls_towards_its_edge_is_told_so_once_the_graded_sheet_feels_it(
    paper: SensorDescription,
) -> None:
    """Its kinds are asked again then: what was told of them below the onset says nothing."""
    case = palm_sequence(paper, "tuning", 5)
    last = [outcome.score for outcome in play([case], "auto")][-1]
    assert case.frames[-1].presses["A"].profile == "dome"
    (contact,) = last.contacts
    assert contact.peak_error is not None
    assert contact.peak_error_sigmas is not None
    assert abs(contact.peak_error) < 0.1
    assert abs(contact.peak_error_sigmas) < 3

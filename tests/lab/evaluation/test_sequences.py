"""Mixed presses that move: they land, glide, change pressure and lift, apart from each other."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, pairwise

import numpy as np
import pytest
from tactomo_lab.evaluation.moving import Sequence, Step, play
from tactomo_lab.evaluation.sequences import mixed_sequence
from tactomo_lab.scenes.still_scenes import BOTH_CHANNELS, gap_m, outline_of
from tactomo_models import DataError, Press, SensorDescription
from variants import variant


@pytest.fixture(scope="module")
def changing(small: SensorDescription) -> Sequence:
    return mixed_sequence(small, "tuning", 0, "each change")


def turns(steps: tuple[Step, ...]) -> Iterator[tuple[Press, Press]]:
    """Each press in a frame and in the next one."""
    for before, now in pairwise(steps):
        for name in before.presses.keys() & now.presses.keys():
            yield before.presses[name], now.presses[name]


def test_what_happens_in_it(changing: Sequence) -> None:
    steps = changing.steps
    assert 60 <= len(steps) <= 120
    assert not steps[0].presses
    assert max(len(step.presses) for step in steps) == 4
    landed = {name for step in steps for name in step.presses}
    assert landed == set("ABCD")
    moved = [np.hypot(b.x_m - a.x_m, b.y_m - a.y_m) for a, b in turns(steps)]
    assert any(moved)
    assert max(moved) <= 0.006  # 120 mm/s at 20 frames a second
    assert any(a.pressure_kpa != b.pressure_kpa for a, b in turns(steps))
    assert any(before.presses.keys() - now.presses.keys() for before, now in pairwise(steps))
    kinds = {(press.shape, press.profile) for step in steps for press in step.presses.values()}
    assert len(kinds) > 1


def test_presses_stay_on_the_sheet_and_apart(changing: Sequence, small: SensorDescription) -> None:
    for step in changing.steps:
        presses = step.presses.values()
        assert all(gap_m(one, other) > 0 for one, other in combinations(presses, 2))
        for press in presses:
            x, y = outline_of(press)
            assert small.on_sheet(x, y, small.sheet.frame_width_m).all()


def test_noise_grows_with_each_change_or_stays(
    changing: Sequence, small: SensorDescription
) -> None:
    steady = mixed_sequence(small, "tuning", 0, "voltage")
    assert steady.steps == changing.steps
    for name in BOTH_CHANNELS:
        rest = changing.volts.rest[name]
        np.testing.assert_array_equal(steady.volts.pressed[name], changing.volts.pressed[name])
        change = np.sqrt(np.mean((changing.volts.pressed[name] - rest) ** 2, axis=1))
        np.testing.assert_allclose(changing.noise[name], 0.01 * change)
        assert changing.rest_noise[name] == 0
        np.testing.assert_allclose(steady.noise[name], 1e-3 * np.sqrt(np.mean(rest**2)))
        np.testing.assert_allclose(steady.noise[name], steady.rest_noise[name])


@pytest.mark.slow
def test_scans_tell_the_noise_that_those_at_rest_have_not(changing: Sequence) -> None:
    """A reference whose noise is unknown takes presses beside it for invalid voltages."""
    scores = list(play(changing, "tikhonov"))
    assert len(scores) == len(changing.steps)
    assert not any(score.found for score in scores if not score.groups)
    assert all(score.found for score in scores if score.groups > 1)
    assert not any(score.distrusted for score in scores if not score.groups)


def test_a_sensor_of_one_channel_has_no_sequences(small: SensorDescription) -> None:
    with pytest.raises(DataError, match="one channel"):
        mixed_sequence(variant(small, magnitude=None), "tuning", 0, "voltage")

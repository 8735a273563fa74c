"""One sheet alone, of any outline: its scenes, its rows, its regimes, its choreography."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from tactomo_lab.evaluation.field import MOVING_ROWS, STILL_ROWS, frames_of_row
from tactomo_lab.evaluation.moving import draw_sequence, mixed_sequence
from tactomo_lab.evaluation.regimes import REGIMES, can_happen, draw_plan, make_case
from tactomo_lab.scenes.case import Plan
from tactomo_lab.scenes.drawing import outline_of
from tactomo_models import DataError, SensorDescription, load_description
from tactomo_protocol import Channel
from variants import variant

OTHER = {Channel.MAGNITUDE: Channel.STRUCTURE, Channel.STRUCTURE: Channel.MAGNITUDE}
OF_BOTH = {"one-scan-apart", "lost-scans"}
OUTLINES = ("palm_l", "insole", "tank_disc")


def alone(small: SensorDescription, channel: Channel) -> SensorDescription:
    return variant(small, **{OTHER[channel]: None})


@pytest.mark.slow
@pytest.mark.parametrize("channel", Channel)
def test_a_sheet_is_scored_by_what_it_shows(small: SensorDescription, channel: Channel) -> None:
    """Without a magnitude channel the pressed shape is the map; without the other there is none."""
    outcome, *_ = frames_of_row(alone(small, channel), "ordinary", "tikhonov", "tuning", 1)[
        "ordinary 40 dB"
    ]
    assert set(outcome.frame.scans) == {channel}
    assert outcome.score.icc > 0.6
    assert (outcome.score.icc_structure > 0.6) is (channel is Channel.STRUCTURE)


@pytest.mark.parametrize("name", OUTLINES)
@pytest.mark.parametrize("regime", REGIMES)
def test_every_regime_that_can_happen_fits_on_the_outline(name: str, regime: str) -> None:
    sensor = load_description(name)
    if not can_happen(regime, sensor):
        with pytest.raises(DataError, match=f"'{regime}' cannot happen to '{name}'"):
            make_case(sensor, regime, "tuning", 0)
        return
    plan = draw_plan(sensor, regime, "tuning", 1)
    assert not plan.opposite  # its conductivity cannot fall by more than all of it
    for press in {press for frame in plan.frames for press in frame}:
        x_m, y_m = outline_of(press)
        assert sensor.on_sheet(x_m, y_m, sensor.sheet.frame_width_m).all()


def test_what_a_sheet_lacks_is_what_cannot_happen() -> None:
    cannot = {
        name: {r for r in REGIMES if not can_happen(r, load_description(name))}
        for name in ("palm_l", "tank_disc", "paper_square")
    }
    assert cannot["palm_l"] == {*OF_BOTH, "wrong-sign", "wrong-contrast"}
    assert cannot["tank_disc"] == {*OF_BOTH, "wrong-sign", "overload"}
    assert not cannot["paper_square"]


@pytest.mark.long
@pytest.mark.parametrize("channel", Channel)
def test_every_row_of_one_sheet(small: SensorDescription, channel: Channel) -> None:
    sensor = alone(small, channel)
    for row in (*STILL_ROWS, *MOVING_ROWS):
        if can_happen(row, sensor):
            for frames in frames_of_row(sensor, row, "tikhonov", "tuning", 1).values():
                for score in (each.score for each in islice(frames, 12, 13)):
                    # A palm may press too lightly for a graded sheet: its true map is all 0.
                    rests = all(contact.magnitude == 0 for contact in score.contacts)
                    assert np.isfinite(score.rie) or rests


@pytest.mark.parametrize("name", OUTLINES)
def test_moving_scenes_stay_on_the_outline(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are drawn before they are simulated, which takes a minute."""
    plans: list[Plan] = []
    sensor = load_description(name)

    def not_simulated(_: SensorDescription, plan: Plan, __: object) -> None:
        plans.append(plan)
        raise KeyboardInterrupt

    monkeypatch.setattr("tactomo_lab.evaluation.moving.simulate", not_simulated)
    with pytest.raises(KeyboardInterrupt):
        draw_sequence(sensor, "tuning", 0)
    with pytest.raises(KeyboardInterrupt):
        mixed_sequence(sensor, "tuning", 0, "voltage")
    assert len(plans) == 2
    for press in {press for plan in plans for frame in plan.frames for press in frame}:
        x_m, y_m = outline_of(press)
        assert sensor.on_sheet(x_m, y_m, sensor.sheet.frame_width_m).all()

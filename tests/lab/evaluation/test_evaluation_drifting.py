"""A simulated day of drift: no ghost, no contact erased; without tracking, both."""

from __future__ import annotations

import numpy as np
import pytest
from tactomo_lab.evaluation.drifting import draw_day
from tactomo_lab.evaluation.play import play
from tactomo_lab.scenes.case import Case
from tactomo_lab.scenes.measures import Summary, summarise
from tactomo_models import SensorDescription
from tactomo_protocol import Channel


def summary(case: Case) -> Summary:
    return summarise([outcome.score for outcome in play([case], "auto")])


@pytest.mark.slow
def test_an_hour_of_drift_leaves_no_ghost_and_erases_nothing(paper: SensorDescription) -> None:
    case = draw_day(paper, "tuning", 3, is_followed=True, hours=0.75)
    again = draw_day(paper, "tuning", 3, is_followed=True, hours=0.75)
    for one, other in zip(case.frames, again.frames, strict=True):
        np.testing.assert_array_equal(one.scans[Channel.STRUCTURE], other.scans[Channel.STRUCTURE])
    pressed = [frame.presses["A"] for frame in case.frames if frame.presses]
    assert len(set(pressed)) == 3
    followed = summary(case)
    assert followed.missed == followed.false == 0


@pytest.mark.long
@pytest.mark.timeout(7200)
def test_a_day_of_drift_leaves_no_ghost_and_erases_nothing(paper: SensorDescription) -> None:
    """Some minutes."""
    followed, bare = (
        summary(draw_day(paper, "reporting", 1, is_followed=way)) for way in (True, False)
    )
    assert followed.missed == followed.false == 0
    assert bare.warned > 0.3
    assert followed.warned < 0.01
    assert bare.magnitude_error > followed.magnitude_error

"""A simulated day of drift: no ghost, no contact erased; without tracking, both."""

from __future__ import annotations

import numpy as np
import pytest
from tactomo_lab.evaluation.drifting import (
    Seen,
    TimedPress,
    draw_day,
    live,
    summarise_day,
)
from tactomo_models import Artifact, SensorDescription
from tactomo_models.scene.press import Press
from tactomo_protocol import Channel


@pytest.fixture(autouse=True)
def _built(artifact: Artifact, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tactomo_lab.evaluation.play.load_or_build_artifact", lambda _: artifact)


@pytest.mark.slow
def test_an_hour_of_drift_leaves_no_ghost_and_erases_nothing(paper: SensorDescription) -> None:
    day = draw_day(paper, "tuning", 3, hours=0.75)
    first, again = (day.case(track=False).frames[-1].scans[Channel.STRUCTURE] for _ in range(2))
    np.testing.assert_array_equal(first, again)
    tracked = summarise_day(list(live(day)), day.hours)
    assert tracked.presses == 3
    assert tracked.ghost_share == tracked.erased == tracked.missed == 0
    assert tracked.refused == 0


@pytest.mark.long
@pytest.mark.timeout(7200)
def test_a_day_of_drift_leaves_no_ghost_and_erases_nothing(paper: SensorDescription) -> None:
    """Some minutes."""
    day = draw_day(paper, "reporting", 1)
    tracked = summarise_day(list(live(day)), day.hours)
    assert tracked.missed == tracked.erased == 0
    assert tracked.ghosts_per_hour == 0
    untracked = summarise_day(list(live(day, track=False, every=10)), day.hours)
    assert untracked.distrusted > 0.3
    assert tracked.distrusted < 0.01
    assert untracked.magnitude_error > tracked.magnitude_error


def test_what_a_summary_counts() -> None:
    press = TimedPress(Press(0.0, 0.0, 180.0), 10.0, 20.0)

    def seen(time_s: float, *, shown: bool = False, ghosts: int = 0) -> Seen:
        pressed = press if press.start_s <= time_s < press.end_s else None
        truth = 0.2 if pressed else float("nan")
        magnitude = 0.22 if shown else float("nan")
        return Seen(time_s, pressed, shown, ghosts, magnitude, truth, False, 0.0, "held")

    frames = [
        *(seen(0.0), seen(5.0, ghosts=2), seen(6.0, ghosts=1), seen(7.0), seen(8.0, ghosts=1)),
        *(seen(10.0), seen(12.0, shown=True), seen(14.0), seen(16.0, shown=True), seen(25.0)),
    ]
    summary = summarise_day(frames, hours=0.5)
    assert (summary.frames, summary.presses) == (10, 1)
    assert summary.ghosts_per_hour == 4.0
    assert summary.ghost_share == 0.3
    assert (summary.missed, summary.erased, summary.erased_share) == (0, 1, 0.5)
    assert summary.magnitude_error == pytest.approx(0.1)
    never = summarise_day([seen(10.0), seen(12.0)], hours=0.5)
    assert (never.missed, never.erased) == (1, 0)

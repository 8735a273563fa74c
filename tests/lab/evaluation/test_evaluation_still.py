"""Still scenes: each is reconstructed as if it were the only one."""

from __future__ import annotations

import numpy as np
import pytest
from tactomo_lab.evaluation.play import play
from tactomo_lab.scenes.still_scenes import scenes
from tactomo_models import Artifact, Reconstructor, SensorDescription
from tactomo_protocol import Channel


@pytest.mark.slow
def test_scenes_do_not_know_of_each_other(
    paper: SensorDescription, artifact: Artifact, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tactomo_lab.evaluation.play.load_or_build_artifact", lambda _: artifact)
    drawn = list(scenes(paper, "tuning", 2, contacts=(1, 2)))[:3]
    assert len({scene.plan.opposite for scene in drawn}) == 2  # or the test would show less
    for outcome in play(drawn, "tikhonov"):
        alone = Reconstructor(outcome.case.description, artifact, method=outcome.made.tier)
        alone.set_reference(outcome.case.tare)
        scans = outcome.frame.scans
        frame = alone.reconstruct(scans[Channel.MAGNITUDE], scans[Channel.STRUCTURE])
        assert frame.map is not None
        assert outcome.made.map is not None
        np.testing.assert_array_equal(outcome.made.map, frame.map)
        assert outcome.score.scene == outcome.case.name
        assert 0.3 < outcome.score.icc < 1
        assert outcome.score.seconds > 0

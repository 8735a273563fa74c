"""Still scenes: each is reconstructed as if it were the only one."""

from __future__ import annotations

import numpy as np
import pytest
from tactomo_lab.evaluation.still import reconstruct_scenes
from tactomo_lab.scenes.still_scenes import scenes
from tactomo_models import Artifact, Reconstructor, SensorDescription


@pytest.mark.slow
def test_scenes_do_not_know_of_each_other(
    paper: SensorDescription, artifact: Artifact, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tactomo_lab.evaluation.still.load_or_build_artifact", lambda _: artifact)
    drawn = list(scenes(paper, "tuning", 2, contacts=(1, 2)))[:3]
    assert len({scene.layout.opposite for scene in drawn}) == 2  # or the test would show less
    for outcome in reconstruct_scenes(drawn, "tikhonov"):
        alone = Reconstructor(outcome.scene.description, artifact, method=outcome.frame.tier)
        alone.set_reference(outcome.scene.reference)
        frame = alone.reconstruct(outcome.scene.magnitude, outcome.scene.structure)
        assert frame.map is not None
        assert outcome.frame.map is not None
        np.testing.assert_array_equal(outcome.frame.map, frame.map)
        assert outcome.score.scene == str(outcome.scene.layout)
        assert 0.3 < outcome.score.icc < 1
        assert outcome.score.seconds > 0

"""The paper's networks: what they are given, and that half of a frame is not enough."""

from __future__ import annotations

import numpy as np
from noisy_skin import Skin
from tactomo_lab.baselines.paper_methods import preprocessed
from tactomo_models import Artifact, Channel, Press, Reconstructor, SensorDescription, SkinSimulator

ONE = Press(0.02, -0.03, 190.0)


def test_the_papers_preprocessing() -> None:
    """Negatives are truncated, magnitudes have one scale, each structure has its own."""
    image = np.array([[-1.0, 2.0]])
    ready = preprocessed({Channel.MAGNITUDE: image, Channel.STRUCTURE: image}, input_scale=4.0)
    np.testing.assert_array_equal(ready["magnitude"], [[0, 0.5]])
    np.testing.assert_array_equal(ready["structure"], [[0, 1]])
    nothing = preprocessed({Channel.STRUCTURE: -image[:, 1:]}, input_scale=4.0)
    np.testing.assert_array_equal(nothing["structure"], [[0]])


def test_the_papers_network_is_not_asked_about_half_of_a_frame(
    paper: SensorDescription, artifact: Artifact, simulator: SkinSimulator
) -> None:
    """Without a channel it would show nothing pressed."""
    skin = Skin(simulator)
    reconstructor = Reconstructor(paper, artifact, method="cnn-multimodal")
    reconstructor.set_reference(skin.reference())
    frame = reconstructor.reconstruct(skin.scan(ONE)["magnitude"], None)
    assert frame.tier == "tikhonov"
    assert "missing" in frame.reason
    assert len(frame.contacts) == 1

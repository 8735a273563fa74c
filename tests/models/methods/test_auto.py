"""The hybrid: the network proposes, the physics fits, a second opinion is weighed by the data."""

from __future__ import annotations

import numpy as np
import pytest
from noisy_skin import Skin
from tactomo_lab.scenes.measures import correlation
from tactomo_lab.scenes.simulation import truth_of
from tactomo_models import (
    Artifact,
    Press,
    Reconstruction,
    Reconstructor,
    SensorDescription,
    SkinSimulator,
)
from tactomo_models.methods.trained_networks import Network

TWO = (Press(-0.035, 0.03, 180.0), Press(0.03, -0.03, 165.0, radius_m=0.012))
RING = Press(0.02, 0.015, 185.0, radius_m=0.019, shape="ring")
BALL = Press(-0.02, -0.01, 250.0, radius_m=0.02, profile="dome")


@pytest.fixture
def methods(paper: SensorDescription, artifact: Artifact, skin: Skin) -> dict[str, Reconstructor]:
    reference = skin.reference()
    made = {}
    for tier in ("fit", "auto"):
        made[tier] = Reconstructor(paper, artifact, method=tier, budget_s=2.0)
        made[tier].set_reference(reference)
    return made


def icc(paper: SensorDescription, frame: Reconstruction, *presses: Press) -> float:
    return correlation(frame.map, truth_of(paper, presses).map)


def test_a_cold_start_takes_fewer_solves_from_a_proposal(
    methods: dict[str, Reconstructor], skin: Skin, solves: list[int]
) -> None:
    scan, needed = skin.scan(*TWO), {}
    for tier, reconstructor in methods.items():
        solves.clear()
        frame = reconstructor.reconstruct(**scan)
        assert len(frame.contacts) == 2
        needed[tier] = len(solves)
    assert frame.reason.startswith("proposed")
    assert needed["auto"] < 0.8 * needed["fit"]


def test_even_discs_stay_as_the_physics_has_them(
    paper: SensorDescription, methods: dict[str, Reconstructor], skin: Skin
) -> None:
    scan = skin.scan(*TWO)
    right = {tier: icc(paper, made.reconstruct(**scan), *TWO) for tier, made in methods.items()}
    assert right["auto"] > 0.98
    assert right["auto"] > right["fit"] - 0.01


def test_the_hole_of_a_ring_is_seen(
    paper: SensorDescription, methods: dict[str, Reconstructor], skin: Skin
) -> None:
    """The structure channel sees a disc; the network knows rings, and the data decide."""
    scan = skin.scan(RING)
    frame, fit = (methods[tier].reconstruct(**scan) for tier in ("auto", "fit"))
    assert frame.map is not None
    row, column = round((0.075 + RING.y_m) / 0.003), round((0.075 + RING.x_m) / 0.003)
    assert frame.map[row, column] < 0.5 * frame.map.max()
    assert icc(paper, frame, RING) > icc(paper, fit, RING) + 0.05
    (contact,) = frame.contacts
    assert contact.pressure_kpa == pytest.approx(RING.pressure_kpa, abs=20)


def test_a_soft_rim_is_left_to_the_network(
    paper: SensorDescription, methods: dict[str, Reconstructor], simulator: SkinSimulator
) -> None:
    """No even press explains a ball, where there is little noise: the physics gives way."""
    skin = Skin(simulator, 1e-4)
    for reconstructor in methods.values():
        reconstructor.set_reference(skin.reference())
    scan = skin.scan(BALL)
    fit, hybrid = (methods[tier].reconstruct(**scan) for tier in ("fit", "auto"))
    assert "misfit_high" in fit.flags.names()
    assert hybrid.tier == "network"
    assert hybrid.reason.startswith("no even presses explain")
    assert icc(paper, hybrid, BALL) > icc(paper, fit, BALL) + 0.05


def test_a_still_scene_asks_no_network(
    methods: dict[str, Reconstructor], skin: Skin, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    run = Network.run

    def counting(self: Network, *arguments: object) -> object:
        asked.append(1)
        return run(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(Network, "run", counting)
    reconstructor = methods["auto"]
    reconstructor.reconstruct(**skin.scan(*TWO))
    assert asked
    asked.clear()
    frames = [reconstructor.reconstruct(**skin.scan(*TWO)) for _ in range(5)]
    assert not asked
    assert all(frame.tier == "hybrid" for frame in frames)
    harder = (Press(-0.035, 0.03, 200.0), TWO[1])  # the shape stays, the magnitude does not
    frame = reconstructor.reconstruct(**skin.scan(*harder))
    assert asked
    strongest = max(frame.contacts, key=lambda contact: contact.pressure_kpa)
    assert strongest.pressure_kpa == pytest.approx(200.0, abs=10)


def test_a_network_that_says_nonsense_does_no_harm(
    paper: SensorDescription,
    methods: dict[str, Reconstructor],
    skin: Skin,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What it proposes and redraws has to explain the data like everything else."""
    run = Network.run

    def upside_down(self: Network, inputs: object) -> dict[str, np.ndarray]:
        made = run(self, inputs)  # type: ignore[arg-type]
        return {name: image[::-1] if image.ndim else image for name, image in made.items()}

    monkeypatch.setattr(Network, "run", upside_down)
    frame = methods["auto"].reconstruct(**skin.scan(*TWO))
    assert len(frame.contacts) == 2
    assert icc(paper, frame, *TWO) > 0.9

"""`auto`: the network proposes, the physics fits, the data judge."""

from __future__ import annotations

import numpy as np
import pytest
from model_fixtures import Tared
from noisy_skin import Skin
from tactomo_lab.scenes.measures import correlation
from tactomo_lab.scenes.simulation import truth_of
from tactomo_models import (
    Flag,
    Press,
    Reconstruction,
    Reconstructor,
    Reference,
    SensorDescription,
    SkinSimulator,
    load_description,
    load_or_build_artifact,
)
from tactomo_models.arrays import FloatArray
from tactomo_models.methods.trained_networks import Network
from tactomo_models.simulation.skin_drift import DriftingSkin, SkinDrift

TWO = (Press(-0.035, 0.03, 180.0), Press(0.03, -0.03, 165.0, radius_m=0.012))
RING = Press(0.02, 0.015, 185.0, radius_m=0.019, shape="ring")
BALL = Press(-0.02, -0.01, 250.0, radius_m=0.02, profile="dome")


@pytest.fixture
def methods(tared: Tared, skin: Skin) -> dict[str, Reconstructor]:
    reference = skin.reference()
    return {tier: tared(reference, method=tier, budget_s=2.0) for tier in ("fit", "auto")}


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


@pytest.mark.parametrize("pressure_kpa", [6.0, 20.0, 180.0])
def test_where_time_ends_before_any_contact_was_tried_the_network_stands_in(
    methods: dict[str, Reconstructor], skin: Skin, pressure_kpa: float
) -> None:
    """What is proposed may begin further from the data than nothing does."""
    made = methods["auto"]
    made.budget_s = 1e-4
    frame = made.reconstruct(**skin.scan(Press(0.02, -0.01, pressure_kpa, radius_m=0.02)))
    assert frame.tier == "network"
    assert frame.flags & Flag.MISFIT_HIGH
    assert frame.structure is not None
    assert frame.structure.max() > 0.3


def test_what_a_field_explains_is_the_fields(
    paper: SensorDescription, methods: dict[str, Reconstructor], skin: Skin
) -> None:
    scan = skin.scan(*TWO)
    frames = {tier: made.reconstruct(**scan) for tier, made in methods.items()}
    right = {tier: icc(paper, frame, *TWO) for tier, frame in frames.items()}
    assert frames["auto"].tier == "fit"
    assert right["auto"] > 0.98
    assert right["auto"] > right["fit"] - 0.01


def test_a_small_contact_beside_a_large_one_is_no_bulge_of_it(
    paper: SensorDescription, methods: dict[str, Reconstructor], skin: Skin
) -> None:
    """The network takes them for one, and one rounded outline would pass for both."""
    pair = (Press(0.011, -0.002, 180.0, radius_m=0.02), Press(0.016, 0.027, 180.0, radius_m=0.0042))
    frame = methods["auto"].reconstruct(**skin.scan(*pair))
    assert len(frame.contacts) == 2
    assert icc(paper, frame, *pair) > 0.97


def test_a_rings_pressure_lies_within_what_is_told(
    methods: dict[str, Reconstructor], skin: Skin
) -> None:
    (contact,) = methods["auto"].reconstruct(**skin.scan(RING)).contacts
    assert abs(contact.pressure_kpa - RING.pressure_kpa) < 2 * contact.pressure_sigma_kpa
    assert contact.pressure_sigma_kpa < 0.1 * RING.pressure_kpa


@pytest.mark.slow
def test_a_soft_rim_is_the_fields(
    paper: SensorDescription, methods: dict[str, Reconstructor], simulator: SkinSimulator
) -> None:
    """Where there is little noise, a flat press would leave a ball unexplained."""
    skin = Skin(simulator, 1e-4)
    methods["auto"].set_reference(skin.reference())
    frame = methods["auto"].reconstruct(**skin.scan(BALL))
    assert (frame.tier, frame.flags) == ("fit", Flag(0))
    assert icc(paper, frame, BALL) > 0.98
    (contact,) = frame.contacts
    assert contact.peak_kpa == pytest.approx(BALL.pressure_kpa, rel=0.1)


def test_where_no_field_explains_the_data_the_network_stands_in(
    methods: dict[str, Reconstructor], skin: Skin
) -> None:
    """Two sheets that are pressed in different places: what lies on both is on both alike."""
    here, there = skin.scan(TWO[0]), skin.scan(TWO[1])
    frame = methods["auto"].reconstruct(here["magnitude"], there["structure"])
    assert frame.tier == "network"
    assert frame.misfit > 2.0
    assert 0 <= frame.confidence <= 1


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
    assert all(frame.tier == "fit" for frame in frames)
    harder = (Press(-0.035, 0.03, 200.0), TWO[1])  # the shape stays, the magnitude does not
    frame = reconstructor.reconstruct(**skin.scan(*harder))
    strongest = max(frame.contacts, key=lambda contact: contact.pressure_kpa)
    assert strongest.pressure_kpa == pytest.approx(200.0, abs=10)


def test_a_network_that_says_nonsense_does_no_harm(
    paper: SensorDescription,
    methods: dict[str, Reconstructor],
    skin: Skin,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What it proposes has to explain the data like everything else."""
    run = Network.run

    def upside_down(self: Network, inputs: object) -> dict[str, np.ndarray]:
        made = run(self, inputs)  # type: ignore[arg-type]
        return {name: image[::-1] if image.ndim else image for name, image in made.items()}

    monkeypatch.setattr(Network, "run", upside_down)
    frame = methods["auto"].reconstruct(**skin.scan(*TWO))
    assert len(frame.contacts) == 2
    assert icc(paper, frame, *TWO) > 0.9


@pytest.mark.parametrize("step_k", [-1.5, pytest.param(1.5, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "presses", [(), TWO[:1], pytest.param(TWO, marks=pytest.mark.slow)], ids=len
)
def test_sheets_that_have_drifted_since_the_tare_hide_no_contact_and_make_none(
    paper: SensorDescription,
    methods: dict[str, Reconstructor],
    simulator: SkinSimulator,
    presses: tuple[Press, ...],
    step_k: float,
) -> None:
    """3 % of warming, 30 times the noise."""
    warm = DriftingSkin(simulator, SkinDrift(step_k=step_k, uneven=0.2))
    rng = np.random.default_rng(3)
    scan = {
        str(name): volts * (1 + 1e-3 * rng.standard_normal(len(volts)))
        for name, volts in warm.voltages(presses, 1.0).items()
    }
    for method in methods.values():
        frame = method.reconstruct(**scan)
        assert frame.misfit < 1.4
        assert not frame.flags & (Flag.MISFIT_HIGH | Flag.LOW_CONFIDENCE)
        assert len(frame.contacts) == len(presses)
        if presses:
            assert icc(paper, frame, *presses) > 0.85  # a mean over what each may be
        for press in presses:
            off = [np.hypot(c.x_m - press.x_m, c.y_m - press.y_m) for c in frame.contacts]
            assert min(off) < 1e-3
        method.reset()


@pytest.mark.slow
def test_a_drift_is_believed_until_the_scene_is_new(
    methods: dict[str, Reconstructor], skin: Skin, simulator: SkinSimulator
) -> None:
    warm = DriftingSkin(simulator, SkinDrift(step_k=1.5))
    rng = np.random.default_rng(3)

    def scan(*presses: Press) -> dict[str, FloatArray]:
        return {
            str(name): volts * (1 + 1e-3 * rng.standard_normal(len(volts)))
            for name, volts in warm.voltages(presses, 1.0).items()
        }

    auto = methods["auto"]
    assert "drifted" in auto.reconstruct(**scan(*TWO)).reason
    frame = auto.reconstruct(**scan(TWO[0]))
    assert "drifted" in frame.reason
    assert len(frame.contacts) == 1
    auto.set_reference(skin.reference(19))
    frame = auto.reconstruct(**skin.scan(*TWO))
    assert "drifted" not in frame.reason
    assert len(frame.contacts) == 2


@pytest.mark.slow
def test_a_drift_that_was_learnt_outlives_the_touch(
    methods: dict[str, Reconstructor], skin: Skin, simulator: SkinSimulator
) -> None:
    warm = DriftingSkin(simulator, SkinDrift(step_k=1.5))
    drifted = {str(name): volts for name, volts in warm.voltages(TWO, 1.0).items()}
    auto = methods["auto"]
    auto.set_reference(skin.reference(19))
    assert "drifted" in auto.reconstruct(**drifted).reason
    assert auto.reconstruct(**skin.scan()).tier == "quiet"
    budget_s, auto.budget_s = auto.budget_s, 0.03  # too little to find it out again
    frame = auto.reconstruct(**drifted)
    auto.reset()
    assert "drifted" not in auto.reconstruct(**drifted).reason
    auto.budget_s = budget_s
    assert "drifted" in frame.reason


@pytest.mark.slow
def test_a_drift_is_told_where_voltages_have_both_signs() -> None:
    sensor = load_description("openeit_disc")
    at_rest = SkinSimulator(sensor)
    reconstructor = Reconstructor(sensor, load_or_build_artifact(sensor), method="fit")
    (rest,) = at_rest.voltages([]).values()
    assert (rest < 0).any()
    assert (rest > 0).any()
    reconstructor.set_reference(Reference(None, rest))
    press = Press(0.15 * sensor.width_m, 0.1 * sensor.width_m, 200.0, radius_m=0.1 * sensor.width_m)
    warm = DriftingSkin(at_rest, SkinDrift(step_k=1.5, uneven=0.2))
    (volts,) = warm.voltages([press], 1.0).values()
    noise = 1e-3 * np.random.default_rng(3).standard_normal(len(volts))
    frame = reconstructor.reconstruct(None, volts * (1 + noise))
    assert "drifted" in frame.reason
    (contact,) = frame.contacts
    assert np.hypot(contact.x_m - press.x_m, contact.y_m - press.y_m) < 1e-3

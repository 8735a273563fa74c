"""How a sheet was made is found by its reference, and presses are then better foretold."""

from __future__ import annotations

import numpy as np
import pytest
from tactomo_models import (
    Flag,
    Press,
    Reference,
    SensorDescription,
    SkinSimulator,
    load_description,
)
from tactomo_models.arrays import FloatArray
from tactomo_models.health.diagnosis import diagnose
from tactomo_models.health.findings import Level
from tactomo_models.physics.actual_sheet import SheetEstimator
from tactomo_models.physics.artifact import Artifact, load_or_build_artifact
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.reconstruct import Reconstructor
from tactomo_protocol import Channel
from variants import variant

EVERY = np.ones(208, bool)
NOISE = np.full(208, 1e-3)


@pytest.fixture(scope="module", autouse=True)
def sheets_once() -> None:
    """Here each estimate is made anew."""


@pytest.fixture
def estimator(paper: SensorDescription, artifact: Artifact) -> SheetEstimator:
    return SheetEstimator(paper, artifact.bare)


def hand_made(paper: SensorDescription, seed: int = 5, unevenness: float = 0.10) -> SkinSimulator:
    """Electrodes up to 1.5 mm off, on a finer mesh than the one that is fitted."""
    made = variant(paper, electrodes={"pitch_m": 0.037})
    return SkinSimulator(made, unevenness=unevenness, impedance_spread=0.30, seed=seed)


def off(voltages: FloatArray, forward: ForwardModel) -> float:
    """Relative error of a model's bare voltages, a common factor aside."""
    ratio = voltages / forward.bare_voltages
    return float(np.std(ratio / np.median(ratio)))


@pytest.mark.parametrize("seed", [5, pytest.param(6, marks=pytest.mark.slow)])
def test_a_hand_made_sheet_is_found_by_its_reference(
    paper: SensorDescription, artifact: Artifact, estimator: SheetEstimator, seed: int
) -> None:
    voltages = hand_made(paper, seed).voltages([])[Channel.MAGNITUDE]
    found = estimator.estimate(voltages, EVERY, NOISE)
    assert found is not None
    assert off(voltages, ForwardModel(paper, artifact.bare)) > 0.05
    assert off(voltages, found) < 0.005


@pytest.mark.slow
def test_voltages_that_are_all_noise_do_not_keep_a_sheet_from_being_found() -> None:
    """On a long sheet most voltages are far from their drive: noise gives them their signs."""
    insole = load_description("insole")
    bare = load_or_build_artifact(insole).bare
    skin = SkinSimulator(insole, unevenness=0.05, impedance_spread=0.2, seed=3)
    voltages = skin.voltages([])[Channel.MAGNITUDE]
    noise = 3e-4 * float(np.sqrt(np.mean(voltages**2)))
    seen = voltages + noise * np.random.default_rng(2).standard_normal(len(voltages))
    assert (np.sign(seen) != np.sign(voltages)).any()
    estimator, every = SheetEstimator(insole, bare), np.ones(len(voltages), bool)
    found = estimator.estimate(seen, every, noise / np.abs(seen))
    assert found is not None
    clear = np.abs(voltages) > 100 * noise
    even = ForwardModel(insole, bare).bare_voltages

    def off_by(told: FloatArray) -> float:
        ratio = voltages[clear] / told[clear]
        return float(np.std(ratio / np.median(ratio)))

    assert off_by(found.bare_voltages) < off_by(even) / 5


@pytest.mark.slow
def test_the_scale_of_the_voltages_is_of_no_matter(
    paper: SensorDescription, estimator: SheetEstimator
) -> None:
    voltages = hand_made(paper).voltages([])[Channel.MAGNITUDE]
    one = estimator.estimate(voltages, EVERY, NOISE)
    two = estimator.estimate(1e4 * voltages, EVERY, NOISE)
    assert one is not None
    assert two is not None
    assert two.bare_voltages == pytest.approx(one.bare_voltages, rel=1e-6)


@pytest.mark.slow
def test_a_press_changes_the_voltages_as_the_found_sheet_foretells(
    paper: SensorDescription, artifact: Artifact, estimator: SheetEstimator
) -> None:
    """The structure sheet, on which a press is a jump of conductivity, whatever its pressure."""
    skin = hand_made(paper)
    rest = skin.voltages([])[Channel.STRUCTURE]
    pressed = skin.voltages([Press(0.03, -0.02, 200.0, 0.012)])[Channel.STRUCTURE]
    found = estimator.estimate(rest, EVERY, NOISE)
    assert found is not None

    def error(forward: ForwardModel) -> float:
        x, y = forward.bare.points[:, forward.bare.pressable]
        inside = np.hypot(x - 0.03, y + 0.02) < 0.012
        change = forward.at_rest * 9.0 * inside
        solved = forward.solve(change, -1.0).voltages
        told = (solved - forward.bare_voltages) / np.abs(forward.bare_voltages)
        seen = (pressed - rest) / np.abs(rest)
        share = told @ seen / (told @ told)  # the strength of the jump is not the question
        return float(np.linalg.norm(seen - share * told) / np.linalg.norm(seen))

    assert error(found) < 0.7 * error(ForwardModel(paper, artifact.bare))


def test_voltages_that_no_such_sheet_has_are_left_to_the_even_one(
    paper: SensorDescription, artifact: Artifact, estimator: SheetEstimator
) -> None:
    bare = ForwardModel(paper, artifact.bare).bare_voltages
    rng = np.random.default_rng(1)
    assert estimator.estimate(bare * np.exp(0.2 * rng.standard_normal(208)), EVERY, NOISE) is None
    assert estimator.estimate(-bare[::-1] * np.sign(bare), EVERY, NOISE) is None
    assert estimator.estimate(bare, ~EVERY, NOISE) is None


@pytest.mark.slow
def test_what_is_not_usable_does_not_count(
    paper: SensorDescription, estimator: SheetEstimator
) -> None:
    voltages = hand_made(paper).voltages([])[Channel.MAGNITUDE]
    whole = estimator.estimate(voltages, EVERY, NOISE)
    usable = EVERY.copy()
    usable[40:53] = False
    part = estimator.estimate(np.where(usable, voltages, 0.0), usable, NOISE)
    assert whole is not None
    assert part is not None
    assert part.bare_voltages == pytest.approx(whole.bare_voltages, rel=0.02)


def test_the_derivatives_of_a_reference_are_right(
    paper: SensorDescription, estimator: SheetEstimator
) -> None:
    """Taylor: what the slopes leave falls by four where the step halves."""
    rng = np.random.default_rng(3)
    at = 0.1 * rng.standard_normal(len(estimator._sigma))
    towards = rng.standard_normal(len(at)) * estimator._sigma
    shape = estimator._shape(at)
    slope = estimator._slopes(at, shape) @ towards
    left = [
        np.linalg.norm(estimator._shape(at + h * towards).voltages - shape.voltages - h * slope)
        for h in (0.4, 0.2, 0.1)
    ]
    # Electrodes' places are differentiated over a tenth of a millimetre: not to the last bit.
    assert left[0] / left[1] == pytest.approx(4, rel=0.25)
    assert left[1] / left[2] == pytest.approx(4, rel=0.35)


@pytest.mark.slow
def test_a_hand_made_skin_is_reconstructed_as_if_it_were_even(
    paper: SensorDescription, artifact: Artifact
) -> None:
    skin = hand_made(paper)
    rest = skin.voltages([])
    reconstructor = Reconstructor(paper, artifact, method="fit", budget_s=1.0)
    reconstructor.set_reference(Reference(rest[Channel.MAGNITUDE], rest[Channel.STRUCTURE]))
    press = Press(0.02, 0.03, 190.0, 0.012)
    by_name = {str(name): volts for name, volts in skin.voltages([press]).items()}
    (contact,) = reconstructor.reconstruct(**by_name).contacts
    assert np.hypot(contact.x_m - press.x_m, contact.y_m - press.y_m) < 5e-4
    assert contact.pressure_kpa == pytest.approx(190, abs=10)


@pytest.fixture(params=[False, True], ids=["unloaded", "pressed"])
def pressed(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.fixture
def far_from_even(paper: SensorDescription) -> SkinSimulator:
    return hand_made(paper, seed=2, unevenness=0.15)


@pytest.fixture
def at_tare(far_from_even: SkinSimulator, pressed: bool) -> dict[Channel, FloatArray]:
    return far_from_even.voltages([Press(0.03, -0.02, 200.0, 0.012)] if pressed else [])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["tikhonov", "fit"])
def test_a_skin_far_from_even_is_no_other_sensor_but_one_that_is_pressed_is_flagged(
    paper: SensorDescription,
    artifact: Artifact,
    far_from_even: SkinSimulator,
    at_tare: dict[Channel, FloatArray],
    pressed: bool,
    method: str,
) -> None:
    """A reference is judged by itself, and not by who uses it."""
    reconstructor = Reconstructor(paper, artifact, method=method, budget_s=1.0)
    reconstructor.set_reference(Reference(None, at_tare[Channel.STRUCTURE]))
    later = far_from_even.voltages([])[Channel.STRUCTURE]
    flags = reconstructor.reconstruct(None, later).flags
    assert (Flag.REFERENCE_MISMATCH in flags) == pressed


@pytest.mark.slow
def test_the_doctor_knows_a_skin_made_by_hand(
    paper: SensorDescription, artifact: Artifact, at_tare: dict[Channel, FloatArray], pressed: bool
) -> None:
    scans = at_tare[Channel.STRUCTURE] * np.ones((20, 1))
    found = {each.about: each.level for each in diagnose(paper, scans, even=artifact.bare).findings}
    assert found["model"] == (Level.FAULT if pressed else Level.OK)

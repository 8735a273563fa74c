"""The paper's level set: its equations, where it works, and that it says where it does not."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from noisy_skin import Skin
from tactomo_lab.baselines.paper_methods import MAX_TRIALS, PaperLevelSet
from tactomo_models import (
    Artifact,
    Flag,
    Press,
    Reconstruction,
    Reconstructor,
    SensorDescription,
    SkinSimulator,
)
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.forward import ForwardModel


@pytest.fixture
def paper_method(reconstructor: Reconstructor) -> Reconstructor:
    reconstructor.method = "pls-paper"
    return reconstructor


@pytest.fixture(scope="module")
def equations(paper: SensorDescription, artifact: Artifact) -> PaperLevelSet:
    return PaperLevelSet(ForwardModel(paper, artifact.bare), artifact.jacobian.T.copy(), 100.0)


def coefficients(equations: PaperLevelSet, x_m: float, y_m: float, radius_m: float) -> FloatArray:
    x, y = equations.forward.bare.points[:, equations.forward.bare.pressable]
    return equations.family.parameters_of((np.hypot(x - x_m, y - y_m) < radius_m).astype(float))


def test_the_prediction_is_equation_8(equations: PaperLevelSet, artifact: Artifact) -> None:
    """Linear in the bare Jacobian, two phases, the change of one inside and nothing outside."""
    mu = coefficients(equations, 0.02, -0.01, 0.02)
    drawing = equations.family.draw(mu)
    inside = np.zeros(artifact.jacobian.shape[1])
    inside[drawing.nodes] = drawing.share
    volts = np.abs(equations.forward.bare_voltages)
    change = 2 * (100 - 1) / (100 + 1) * inside
    np.testing.assert_allclose(equations.predict(mu), volts * (artifact.jacobian @ change))
    assert inside.max() == pytest.approx(1, abs=0.05)
    assert np.mean(inside == 0) > 0.7


def test_the_jacobian_passes_a_taylor_test(equations: PaperLevelSet) -> None:
    rng = np.random.default_rng(2)
    mu = coefficients(equations, 0.01, 0.02, 0.02)
    direction = 0.1 * rng.standard_normal(len(mu))
    slope = equations.jacobian(mu) @ direction
    steps = 2.0 ** -np.arange(3, 9)
    left = [
        np.linalg.norm(equations.predict(mu + h * direction) - equations.predict(mu) - h * slope)
        for h in steps
    ]
    orders = np.log2(np.array(left[:-1]) / np.array(left[1:]))
    assert orders.mean() == pytest.approx(2, abs=0.3)


def frame_of(reconstructor: Reconstructor, skin: Skin, presses: Sequence[Press]) -> Reconstruction:
    return reconstructor.reconstruct(**skin.scan(*presses))


def test_one_press_is_found_cold(paper_method: Reconstructor, skin: Skin) -> None:
    press = Press(0.03, -0.02, 180.0)
    frame = frame_of(paper_method, skin, [press])
    assert (frame.tier, frame.reason) == ("pls-paper", "as requested")
    (contact,) = frame.contacts
    assert math.dist((contact.x_m, contact.y_m), (press.x_m, press.y_m)) < 5e-3
    assert contact.area_m2 == pytest.approx(math.pi * press.radius_m**2, rel=0.5)
    assert contact.magnitude == pytest.approx(0.177, abs=0.08)


def test_every_frame_starts_anew(paper_method: Reconstructor, skin: Skin) -> None:
    scan = skin.scan(Press(0.03, -0.02, 180.0))
    first = paper_method.reconstruct(**scan)
    frame_of(paper_method, skin, [Press(-0.03, 0.04, 180.0)])
    again = paper_method.reconstruct(**scan)
    assert first.structure is not None
    np.testing.assert_array_equal(first.structure, again.structure)
    assert [c.magnitude for c in first.contacts] == [c.magnitude for c in again.contacts]


def test_a_sheet_pressed_nearly_everywhere_ends_and_is_flagged(
    paper_method: Reconstructor, skin: Skin
) -> None:
    frame = frame_of(paper_method, skin, [Press(0.0, 0.0, 180.0, 0.06, shape="rectangle")])
    assert frame.flags & (Flag.MISFIT_HIGH | Flag.NOT_CONVERGED)


@pytest.mark.slow
def test_what_the_linear_equation_explains_wrongly_is_flagged(
    paper: SensorDescription, artifact: Artifact, simulator: SkinSimulator
) -> None:
    """Next to no noise: whatever the outline misses is the linear model's own fault."""
    skin = Skin(simulator, noise_share=1e-4)
    reconstructor = Reconstructor(paper, artifact, method="pls-paper")
    reconstructor.set_reference(skin.reference())
    presses = [Press(x, y, 170.0) for x, y in ((0.0, 0.0), (0.04, 0.03), (-0.04, 0.035))]
    frame = frame_of(reconstructor, skin, presses)
    assert Flag.MISFIT_HIGH in frame.flags
    reconstructor.method = "auto"
    reconstructor.budget_s = 2.0
    assert frame_of(reconstructor, skin, presses).misfit < frame.misfit


def test_steps_that_run_out_are_flagged(
    paper_method: Reconstructor, skin: Skin, monkeypatch: pytest.MonkeyPatch
) -> None:
    press = Press(0.02, 0.03, 180.0)
    assert Flag.NOT_CONVERGED not in frame_of(paper_method, skin, [press]).flags
    assert MAX_TRIALS > 3
    monkeypatch.setattr("tactomo_lab.baselines.paper_methods.MAX_TRIALS", 3)
    assert Flag.NOT_CONVERGED in frame_of(paper_method, skin, [press]).flags

"""Tikhonov and NOSER: the equations, the rule for lambda, and what a frame of them claims."""

from __future__ import annotations

import math

import numpy as np
import pytest
from noisy_skin import Skin
from tactomo_models import (
    Artifact,
    Flag,
    Press,
    Reconstructor,
    SensorDescription,
    SkinSimulator,
)
from tactomo_models.physics.artifact import central_target, nominal_noise
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.tikhonov import (
    EVEN,
    noise_figure_weight,
    noser_scale,
    tikhonov_matrix,
)

PRESS = Press(0.03, -0.02, 180.0)
OTHER = Press(-0.035, 0.03, 170.0)


def magnitude_of(sensor: SensorDescription, press: Press) -> float:
    assert sensor.magnitude is not None
    return float(sensor.magnitude.response.change(np.array([press.pressure_kpa]))[0])


def test_noser_is_one_gauss_newton_step_with_its_prior() -> None:
    rng = np.random.default_rng(3)
    J, noise = rng.standard_normal((12, 30)), rng.uniform(0.5, 2, 12)
    whitened = J / noise[:, None]
    normal = whitened.T @ whitened
    prior = np.diag(np.diag(normal) ** 0.5)
    step = np.linalg.solve(normal + 0.3 * prior, whitened.T / noise)
    made = tikhonov_matrix(J, noise, 0.3, noser_scale(J, noise))
    np.testing.assert_allclose(made, step, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("method", ["tikhonov", "noser"])
def test_the_image_is_as_noisy_as_the_data(
    artifact: Artifact, paper: SensorDescription, method: str
) -> None:
    J, noise = artifact.jacobian, nominal_noise(ForwardModel(paper, artifact.bare).bare_voltages)
    target = central_target(paper, artifact.bare)
    prior_scale = noser_scale(J, noise) if method == "noser" else EVEN
    weight = noise_figure_weight(J, noise, target, prior_scale)
    matrix = tikhonov_matrix(J, noise, weight, prior_scale) * noise  # takes whitened data
    signal = (J / noise[:, None]) @ target
    image_snr = np.mean(np.abs(matrix @ signal)) / np.sqrt(np.mean((matrix**2).sum(axis=1)))
    assert np.mean(np.abs(signal)) / image_snr == pytest.approx(1, rel=0.01)


@pytest.mark.parametrize("method", ["tikhonov", "noser"])
def test_two_presses_are_found_without_a_forward_solve(
    reconstructor: Reconstructor,
    paper: SensorDescription,
    skin: Skin,
    method: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a linear method solved the forward model")

    scan = skin.scan(PRESS, OTHER)
    monkeypatch.setattr(ForwardModel, "solve", refuse)
    reconstructor.method = method
    frame = reconstructor.reconstruct(**scan)
    assert (frame.tier, frame.reason) == (method, "as requested")
    assert len(frame.contacts) == 2
    for press in (PRESS, OTHER):
        distance, contact = min(
            (math.dist((c.x_m, c.y_m), (press.x_m, press.y_m)), c) for c in frame.contacts
        )
        assert distance < 0.01
        assert abs(contact.magnitude - magnitude_of(paper, press)) < 3 * contact.magnitude_sigma


@pytest.mark.parametrize("method", ["tikhonov", "noser"])
def test_an_image_that_leaves_the_changes_unexplained_is_flagged(
    paper: SensorDescription, artifact: Artifact, simulator: SkinSimulator, method: str
) -> None:
    """One contact is shown well; beside it a smaller one pales; the rest is noise."""
    large, smaller = Press(0.03, 0.04, 180.0, 0.02), Press(-0.035, -0.03, 170.0, 0.012)
    for noise_share, presses, flagged in (
        (1e-4, [large], False),
        (1e-4, [large, smaller], True),
        (1e-2, [large], True),
    ):
        skin = Skin(simulator, noise_share)
        reconstructor = Reconstructor(paper, artifact, method=method)
        reconstructor.set_reference(skin.reference())
        frames = [reconstructor.reconstruct(**skin.scan(*presses)) for _ in range(5)]
        assert [bool(frame.flags & Flag.MISFIT_HIGH) for frame in frames] == [flagged] * 5


def test_noser_sees_the_middle_better_than_tikhonov(
    reconstructor: Reconstructor, skin: Skin
) -> None:
    """Its prior expects more where the sheet is seen less: the image there is less pale."""
    peaks = {}
    for method in ("tikhonov", "noser"):
        reconstructor.method = method
        middle, rim = (
            reconstructor.reconstruct(**skin.scan(press)).map
            for press in (Press(0.0, 0.0, 180.0), Press(0.0, 0.055, 180.0))
        )
        assert middle is not None
        assert rim is not None
        peaks[method] = float(middle.max() / rim.max())
    assert peaks["noser"] > peaks["tikhonov"]


def test_a_linear_method_names_itself_where_it_had_to_stand_in(
    reconstructor: Reconstructor, skin: Skin
) -> None:
    reconstructor.method = "fit"  # which has no network to turn to
    frame = reconstructor.reconstruct(skin.scan(PRESS)["magnitude"], None)
    assert (frame.tier, frame.reason) == ("tikhonov", "the structure channel is missing")

"""Magnitudes of areas that a linear image shows, and what they leave unexplained."""

from __future__ import annotations

import numpy as np
import pytest
from measured import measured
from tactomo_models.methods.magnitudes import (
    LINEAR_ERROR,
    Magnitudes,
    Tangent,
    bare_tangent,
    known_magnitudes,
    leaves_unexplained,
    linear_magnitudes,
)
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene.areas import Areas

SIGMA = 0.002  # of each voltage's relative change


@pytest.fixture(scope="module")
def tangent(forward: ForwardModel, two_areas: Areas) -> Tangent:
    nodes = np.arange(two_areas.on_nodes.shape[1])
    bare = forward.solve(np.zeros(len(nodes)))
    by_node = (forward.jacobian(bare, nodes) / np.abs(forward.bare_voltages)[:, None]).T
    return bare_tangent(by_node, two_areas)


def test_the_tangent_is_that_of_the_forward_model(
    forward: ForwardModel, two_areas: Areas, tangent: Tangent
) -> None:
    """What areas change for small changes, to first order: half the change, a quarter the error."""
    bare, change = forward.bare_voltages, np.array([0.02, -0.01])
    left = [
        np.linalg.norm(
            (forward.solve(step * change @ two_areas.on_nodes).voltages - bare) / np.abs(bare)
            - step * tangent.jacobian @ change
        )
        for step in (1.0, 0.5)
    ]
    assert left[0] / left[1] == pytest.approx(4, rel=0.05)


def test_the_linear_ones_are_uncertain_by_their_outlines(tangent: Tangent) -> None:
    truth = np.array([0.1, -0.2])
    fitted = linear_magnitudes(tangent, measured(tangent.jacobian @ truth, 1 / SIGMA))
    np.testing.assert_allclose(fitted.change, truth, rtol=1e-5)
    assert (fitted.sigma > LINEAR_ERROR * np.abs(truth)).all()
    assert fitted.sigma == pytest.approx(LINEAR_ERROR * np.abs(truth), rel=0.2)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_goes_against_the_sign_is_no_press(sign: float) -> None:
    fitted = Magnitudes(sign * np.array([0.1, -0.1]), np.array([0.02, 0.01]), misfit=1.0)
    size, sigma = known_magnitudes(fitted, sign, 2)
    np.testing.assert_array_equal(size, [0.1, 0.0])
    np.testing.assert_array_equal(sigma, fitted.sigma)
    quiet = measured(np.zeros(10))
    assert leaves_unexplained(fitted, quiet, sign)
    along = Magnitudes(np.abs(fitted.change) * sign, fitted.sigma, misfit=1.0)
    assert not leaves_unexplained(along, quiet, sign)


def test_without_areas_there_are_no_magnitudes_and_a_change_is_unexplained() -> None:
    size, sigma = known_magnitudes(None, 1.0, 2)
    assert np.isnan([*size, *sigma]).all()
    assert leaves_unexplained(None, measured(np.ones(10), 10.0), 1.0)
    assert not leaves_unexplained(None, measured(np.ones(10), 0.1), 1.0)

"""Magnitudes of given areas: their derivatives, and how far each may be trusted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from measured import measured
from tactomo_models.arrays import FloatArray
from tactomo_models.methods.magnitudes import (
    LINEAR_ERROR,
    Magnitudes,
    Tangent,
    WarmStartedMagnitudes,
    bare_tangent,
    fit_magnitudes,
    linear_magnitudes,
)
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene.areas import AreaFinder, Areas

SIGMA = 0.002  # of each voltage's relative change


def disc(forward: ForwardModel, x_m: float, y_m: float, radius_m: float) -> FloatArray:
    x, y = forward.bare.points[:, forward.bare.pressable]
    return np.asarray(np.clip(1 - np.hypot(x - x_m, y - y_m) / radius_m / 2, 0, 1))


@pytest.fixture(scope="module")
def two_areas(forward: ForwardModel) -> Areas:
    nodes = np.maximum(disc(forward, -0.012, -0.006, 0.006), disc(forward, 0.014, 0.006, 0.005))
    pressed = np.clip(3 * nodes - 1, 0, 1)
    shape = (forward.description.map.nodes_y, forward.description.map.nodes_x)
    on_map = np.asarray(forward.bare.map_weights @ pressed).reshape(shape)
    areas = AreaFinder(forward).find(on_map, pressed)
    assert len(areas) == 2
    return areas


def tangent_at(forward: ForwardModel, areas: Areas, change: FloatArray) -> Tangent:
    """The fit's own tangent where it starts, and no further solve."""
    data = np.zeros(forward.description.measurements)
    nowhere = Tangent(change, data, np.zeros((len(data), len(change))))
    start = Magnitudes(change, change, 0.0, nowhere)
    return fit_magnitudes(forward, areas.on_nodes, measured(data), start, solves=1).tangent


def test_the_magnitudes_jacobian_passes_a_taylor_test(
    forward: ForwardModel, two_areas: Areas
) -> None:
    change, direction = np.array([0.2, -0.1]), np.array([0.7, 1.1])
    here = tangent_at(forward, two_areas, change)
    steps = 10.0 ** -np.arange(1, 4)
    left = [
        np.linalg.norm(
            tangent_at(forward, two_areas, change + step * direction).voltages
            - here.voltages
            - step * here.jacobian @ direction
        )
        for step in steps
    ]
    orders = np.diff(np.log(left)) / np.diff(np.log(steps))
    assert orders == pytest.approx(2, abs=0.15)


@pytest.mark.parametrize("truth", [(0.25, 0.05), (-0.2, -0.05), (0.2, -0.2)])
def test_magnitudes_come_back_with_their_uncertainty(
    forward: ForwardModel, two_areas: Areas, truth: tuple[float, float]
) -> None:
    """The share of errors within one standard uncertainty is the normal distribution's."""
    exact = tangent_at(forward, two_areas, np.array(truth)).voltages
    sigma = 0.002
    rng = np.random.default_rng(5)
    within = []
    for _ in range(150):
        noisy = exact + sigma * rng.standard_normal(len(exact))
        fit = fit_magnitudes(forward, two_areas.on_nodes, measured(noisy, 1 / sigma))
        assert fit.misfit == pytest.approx(1, abs=0.5)
        within += list(np.abs(fit.change - truth) < fit.sigma)
    assert np.mean(within) == pytest.approx(0.68, abs=0.1)


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_an_area_that_is_uncertain_makes_its_magnitude_so_and_no_other(
    forward: ForwardModel, two_areas: Areas, share: float
) -> None:
    """Where an area is taken too large, its change comes out as much too small."""
    data = measured(tangent_at(forward, two_areas, np.array([0.25, -0.1])).voltages, 1 / SIGMA)
    sigmas = np.zeros((2, 3))
    sigmas[0, 2] = share * two_areas.areas_m2[0]
    known_areas = replace(two_areas, sigmas=sigmas)
    unknown = WarmStartedMagnitudes(forward).fit(two_areas, data, solves=3)  # its sigmas are NaN
    known = WarmStartedMagnitudes(forward).fit(known_areas, data, solves=3)
    assert unknown is not None
    assert known is not None
    np.testing.assert_array_equal(known.change, unknown.change)
    assert known.sigma[0] == pytest.approx(np.hypot(unknown.sigma[0], share * known.change[0]))
    assert known.sigma[0] > 2 * unknown.sigma[0]
    assert known.sigma[1] == unknown.sigma[1]


def test_what_the_data_do_not_explain_makes_all_less_certain(
    forward: ForwardModel, two_areas: Areas
) -> None:
    data = tangent_at(forward, two_areas, np.array([0.25, -0.1])).voltages
    noise = 10 * SIGMA * np.random.default_rng(3).standard_normal(len(data))
    good, bad = (
        fit_magnitudes(forward, two_areas.on_nodes, measured(each, 1 / SIGMA))
        for each in (data, data + noise)
    )
    assert bad.misfit == pytest.approx(10, rel=0.5)
    np.testing.assert_allclose(bad.sigma, bad.misfit * good.sigma, rtol=0.1)


def test_the_linear_ones_are_uncertain_by_their_outlines(
    forward: ForwardModel, two_areas: Areas
) -> None:
    nodes = np.arange(two_areas.on_nodes.shape[1])
    bare = forward.solve(np.zeros(len(nodes)))
    by_node = (forward.jacobian(bare, nodes) / np.abs(forward.bare_voltages)[:, None]).T
    tangent = bare_tangent(by_node, two_areas)
    np.testing.assert_allclose(
        tangent.jacobian, tangent_at(forward, two_areas, np.zeros(2)).jacobian, rtol=1e-9
    )
    truth = np.array([0.1, -0.2])
    fitted = linear_magnitudes(tangent, measured(tangent.jacobian @ truth, 1 / SIGMA))
    np.testing.assert_allclose(fitted.change, truth, rtol=1e-5)
    assert (fitted.sigma > LINEAR_ERROR * np.abs(truth)).all()
    assert fitted.sigma == pytest.approx(LINEAR_ERROR * np.abs(truth), rel=0.2)

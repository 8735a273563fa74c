"""The level set and the fit of magnitudes: derivatives, and steps that only lead downhill."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from tactomo_models import SensorDescription
from tactomo_models.contacts import AreaFinder, Areas, Magnitudes, Tangent, fit_magnitudes
from tactomo_models.forward import ForwardModel, build_forward_model
from tactomo_models.levelset import HALF_WIDTH, LevelSet, Shape, heaviside, heaviside_slope

FloatArray = NDArray[np.float64]


@pytest.fixture(scope="module")
def forward(small: SensorDescription) -> ForwardModel:
    return build_forward_model(small, refinements=1)


@pytest.fixture(scope="module", params=[100.0, 0.01], ids=["conductive", "resistive"])
def level_set(request: pytest.FixtureRequest, forward: ForwardModel) -> LevelSet:
    return LevelSet(forward, request.param)


def likeness(forward: ForwardModel, x_m: float, y_m: float, radius_m: float) -> FloatArray:
    x, y = forward.bare.points[:, forward.bare.pressable]
    distance = np.hypot(x - x_m, y - y_m)
    return np.asarray(np.clip(1 - distance / radius_m / 2, 0, 1))


def shape_at(level_set: LevelSet, x_m: float = 0.004, radius_m: float = 0.008) -> Shape:
    data = np.zeros(level_set.forward.description.measurements)
    start = level_set.start(likeness(level_set.forward, x_m, 0.0, radius_m), data, data + 1)
    assert start is not None
    return start


def test_the_level_set_jacobian_passes_a_taylor_test(level_set: LevelSet) -> None:
    """|r(p + e d) - r(p) - e J d| falls with e squared: coefficients and log ratio together."""
    rng = np.random.default_rng(3)
    here = shape_at(level_set)
    data = 0.1 * rng.normal(size=len(here.residual))
    weight = 1 + rng.random(len(here.residual))
    at = level_set.evaluate(here.mu, here.log_ratio, data, weight)
    assert at is not None
    slope = level_set.jacobian(at, weight)
    direction = rng.standard_normal(len(here.mu) + 1)
    steps = 10.0 ** -np.arange(3, 6)
    left = []
    for step in steps:
        moved = level_set.evaluate(
            at.mu + step * direction[:-1], at.log_ratio + step * direction[-1], data, weight
        )
        assert moved is not None
        left.append(np.linalg.norm(moved.residual - at.residual - step * slope @ direction))
    orders = np.diff(np.log(left)) / np.diff(np.log(steps))
    assert orders == pytest.approx(2, abs=0.1)


def test_far_from_the_outline_nothing_is_pressed_and_nothing_is_solved(
    level_set: LevelSet,
) -> None:
    shape = shape_at(level_set)
    x, y = level_set.forward.bare.points[:, level_set.forward.bare.pressable]
    far = np.hypot(x - 0.004, y) > 0.02
    assert not shape.pressed[far].any()
    assert len(shape.solution.nodes) < 0.5 * len(level_set.forward.bare.support)


def test_the_fit_explains_what_its_own_model_made(level_set: LevelSet) -> None:
    """Without noise or model error the outline comes back from a start beside it."""
    bare = level_set.forward.bare_voltages
    truth = shape_at(level_set)
    data = (truth.solution.voltages - bare) / np.abs(bare)
    weight = np.full(len(data), 1 / 0.003)
    start = level_set.start(likeness(level_set.forward, 0.0, 0.003, 0.009), data, weight)
    assert start is not None
    found = level_set.refine(start, data, weight, budget_s=5.0, good_enough=1.0)
    assert start.misfit > 10
    assert found.misfit <= 1
    assert found.converged
    overlap = np.minimum(found.pressed, truth.pressed).sum() / truth.pressed.sum()
    assert overlap > 0.9


def test_a_budget_that_is_used_up_leaves_a_better_shape_that_has_not_converged(
    level_set: LevelSet,
) -> None:
    bare = level_set.forward.bare_voltages
    truth = shape_at(level_set)
    data = (truth.solution.voltages - bare) / np.abs(bare)
    weight = np.full(len(data), 1 / 0.003)
    shape = level_set.start(likeness(level_set.forward, -0.01, 0.003, 0.009), data, weight)
    assert shape is not None
    for _ in range(3):
        better = level_set.refine(shape, data, weight, budget_s=0.0, good_enough=0.0)
        assert better.cost <= shape.cost
        assert not better.converged
        shape = better


def test_holding_a_shape_against_other_data_is_what_solving_it_would_say(
    level_set: LevelSet,
) -> None:
    shape = shape_at(level_set)
    data = np.linspace(-1, 1, len(shape.residual))
    weight = np.linspace(1, 2, len(data))
    compared = level_set.compare(shape, data, weight)
    solved = level_set.evaluate(shape.mu, shape.log_ratio, data, weight)
    assert solved is not None
    np.testing.assert_array_equal(compared.residual, solved.residual)
    assert compared.cost == solved.cost


@given(st.floats(-2, 2))
def test_the_heaviside_is_smooth_and_of_compact_support(f: float) -> None:
    at, step = np.array([f]), 1e-5
    assert 0 <= heaviside(at)[0] <= 1
    assert (heaviside(at)[0] == 0) == (f <= -HALF_WIDTH)
    assert heaviside(at)[0] + heaviside(-at)[0] == pytest.approx(1)
    numeric = (heaviside(at + step) - heaviside(at - step))[0] / (2 * step)
    assert heaviside_slope(at)[0] == pytest.approx(numeric, abs=1e-3)


@pytest.fixture(scope="module")
def two_areas(forward: ForwardModel) -> Areas:
    nodes = np.maximum(
        likeness(forward, -0.012, -0.006, 0.006), likeness(forward, 0.014, 0.006, 0.005)
    )
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
    return fit_magnitudes(forward, areas, data, data + 1, start, solves=1).tangent


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
    weight = np.full(len(exact), 1 / sigma)
    within = []
    for _ in range(150):
        noisy = exact + sigma * rng.standard_normal(len(exact))
        fit = fit_magnitudes(forward, two_areas, noisy, weight)
        assert fit.misfit == pytest.approx(1, abs=0.5)
        within += list(np.abs(fit.change - truth) < fit.sigma)
    assert np.mean(within) == pytest.approx(0.68, abs=0.1)

"""Shapes: derivatives, and steps that only lead downhill."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from measured import measured
from tactomo_models.arrays import FloatArray
from tactomo_models.methods.contact_search import ContactSearch
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene.level_set import LevelSet
from tactomo_models.scene.outlines import PARAMETERS, UNIT_M, outlines_on
from tactomo_models.scene.shape_fit import (
    Budget,
    Family,
    Shape,
    ShapeFit,
    conductivity,
    heaviside,
    heaviside_slope,
)

SIZE_M = 0.008


@pytest.fixture(scope="module", params=[100.0, 0.01], ids=["conductive", "resistive"])
def fit(request: pytest.FixtureRequest, forward: ForwardModel) -> ShapeFit:
    return ShapeFit(forward, request.param)


@pytest.fixture(
    scope="module", params=[0, 2, 4, None], ids=["circle", "ellipse", "rounded", "free"]
)
def order(request: pytest.FixtureRequest) -> int | None:
    """Of the outlines; None is a level set."""
    return request.param  # type: ignore[no-any-return]


def likeness(forward: ForwardModel, x_m: float, y_m: float, radius_m: float) -> FloatArray:
    x, y = forward.bare.points[:, forward.bare.pressable]
    distance = np.hypot(x - x_m, y - y_m)
    return np.asarray(np.clip(1 - distance / radius_m / 2, 0, 1))


def start_at(
    fit: ShapeFit, order: int | None, x_m: float = 0.004, y_m: float = 0.0, radius_m: float = SIZE_M
) -> tuple[Family, FloatArray]:
    """A family and the parameters of one contact."""
    if order is None:
        free = LevelSet(fit.forward)
        return free, free.parameters_of(likeness(fit.forward, x_m, y_m, radius_m))
    family = outlines_on(fit.forward).of(order, 1)
    form = [x_m / UNIT_M, y_m / UNIT_M, np.log(radius_m), 0.2, -0.1, 0.03, -0.02, 0.04, 0.05]
    return family, np.array(form[: PARAMETERS[order]])


def shape_at(
    fit: ShapeFit,
    order: int | None,
    data: FloatArray | None = None,
    weight: FloatArray | None = None,
    **place: float,
) -> Shape:
    family, parameters = start_at(fit, order, **place)
    none = np.zeros(fit.forward.description.measurements)
    data, weight = none if data is None else data, none + 1 if weight is None else weight
    shape = fit.evaluate(family, parameters, fit.likely, measured(data, weight))
    assert shape is not None
    return shape


def data_of(shape: Shape, fit: ShapeFit) -> FloatArray:
    bare = fit.forward.bare_voltages
    return np.asarray((shape.solution.voltages - bare) / np.abs(bare))


def orders_of_error(errors: list[float], steps: FloatArray) -> FloatArray:
    return np.asarray(np.diff(np.log(errors)) / np.diff(np.log(steps)))


def test_the_jacobian_of_a_shape_passes_a_taylor_test(fit: ShapeFit, order: int | None) -> None:
    """|r(p + e d) - r(p) - e J d| falls with e squared: parameters and log ratio together."""
    rng = np.random.default_rng(3)
    measurements = fit.forward.description.measurements
    data, weight = 0.1 * rng.normal(size=measurements), 1 + rng.random(measurements)
    here = shape_at(fit, order, data, weight)
    slope = fit.jacobian(here, weight)
    direction = rng.standard_normal(len(here.parameters) + 1)
    steps = np.array([1e-3, 1e-4, 1e-5])
    errors = []
    for step in steps:
        moved = fit.evaluate(
            here.family,
            here.parameters + step * direction[:-1],
            here.log_ratio + step * direction[-1],
            measured(data, weight),
        )
        assert moved is not None
        errors.append(
            float(np.linalg.norm(moved.residual - here.residual - step * slope @ direction))
        )
    assert orders_of_error(errors, steps) == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize("order", [0, 2, 4])
def test_two_outlines_that_overlap_pass_a_taylor_test(forward: ForwardModel, order: int) -> None:
    rng = np.random.default_rng(4)
    family = outlines_on(forward).of(order, 2)
    each = np.zeros((2, 9))
    each[:, :3] = [[-0.4, 0.1, np.log(0.009)], [0.5, -0.2, np.log(0.007)]]
    parameters = family.join(each)
    direction = rng.standard_normal(len(parameters))
    here, moving = family.render(parameters)
    slope = np.zeros(len(here))
    slope[moving] = family.slope(parameters, np.flatnonzero(moving)) @ direction
    steps = np.array([1e-3, 1e-4, 1e-5])
    errors = [
        float(np.linalg.norm(family.render(parameters + e * direction)[0] - here - e * slope))
        for e in steps
    ]
    assert orders_of_error(errors, steps) == pytest.approx(2, abs=0.1)


@given(st.floats(0, 1), st.floats(-6, 6).filter(lambda r: abs(r) > 0.1))
def test_conductivity_goes_from_the_sheets_to_the_contacts(h: float, log_ratio: float) -> None:
    at, step = np.array([h]), 1e-6
    sigma, by_h, by_log_ratio = conductivity(at, log_ratio)
    assert min(1, np.exp(log_ratio)) - 1e-9 <= sigma[0] <= max(1, np.exp(log_ratio)) + 1e-9
    numeric_h = (conductivity(at + step, log_ratio)[0] - sigma)[0] / step
    numeric_ratio = (conductivity(at, log_ratio + step)[0] - sigma)[0] / step
    assert by_h[0] == pytest.approx(numeric_h, rel=2e-2, abs=1e-3)
    assert by_log_ratio[0] == pytest.approx(numeric_ratio, rel=1e-2, abs=1e-3)


def test_far_from_the_outline_nothing_is_pressed_and_nothing_is_solved(
    fit: ShapeFit, order: int | None
) -> None:
    shape = shape_at(fit, order)
    x, y = fit.forward.bare.points[:, fit.forward.bare.pressable]
    far = np.hypot(x - 0.004, y) > 0.02
    assert not shape.pressed[far].any()
    assert len(shape.solution.nodes) < 0.5 * len(fit.forward.bare.support)


def test_the_fit_explains_what_its_own_model_made(fit: ShapeFit, order: int | None) -> None:
    """Without noise or model error the outline comes back from a start beside it."""
    truth = shape_at(fit, order)
    data = data_of(truth, fit)
    weight = np.full(len(data), 1 / 0.003)
    start = shape_at(fit, order, data, weight, x_m=0.002, y_m=0.002, radius_m=0.009)
    found = fit.refine(start, measured(data, weight), Budget(5.0), good_enough=1.0)
    assert start.misfit > 10
    assert found.misfit <= 1
    assert found.converged
    overlap = np.minimum(found.pressed, truth.pressed).sum() / truth.pressed.sum()
    assert overlap > 0.9


def test_a_budget_that_is_used_up_leaves_a_better_shape_that_has_not_converged(
    fit: ShapeFit, order: int | None
) -> None:
    data = data_of(shape_at(fit, order), fit)
    weight = np.full(len(data), 1 / 0.003)
    shape = shape_at(fit, order, data, weight, x_m=-0.01, y_m=0.003, radius_m=0.009)
    for _ in range(3):
        better = fit.refine(shape, measured(data, weight), Budget(0.0), good_enough=0.0)
        assert better.cost <= shape.cost
        assert not better.converged
        shape = better


def test_holding_a_shape_against_other_data_is_what_solving_it_would_say(
    fit: ShapeFit, order: int | None
) -> None:
    shape = shape_at(fit, order)
    data = np.linspace(-1, 1, len(shape.residual))
    weight = np.linspace(1, 2, len(data))
    compared = fit.compare(shape, measured(data, weight))
    solved = shape_at(fit, order, data, weight)
    np.testing.assert_array_equal(compared.residual, solved.residual)
    assert compared.cost == solved.cost


@pytest.mark.parametrize("order", [0, 2])
def test_parameters_scatter_as_their_covariance_says(forward: ForwardModel, order: int) -> None:
    fit = ShapeFit(forward, 100.0)
    truth = shape_at(fit, order)
    exact = data_of(truth, fit)
    sigma, rng = 0.01, np.random.default_rng(8)
    off = []
    for _ in range(60):
        data = measured(exact + sigma * rng.standard_normal(len(exact)), 1 / sigma)
        found = fit.refine(fit.compare(truth, data), data, Budget(5.0), 0.0)
        spread = np.sqrt(np.diag(fit.covariance(found, data)))
        off.append(((found.parameters - truth.parameters) / spread)[:2])
    assert np.mean(np.abs(off) < 1) == pytest.approx(0.68, abs=0.12)


@pytest.mark.parametrize("ratio", [100.0, 0.01], ids=["conductive", "resistive"])
def test_the_search_finds_the_contact_that_is_missing(forward: ForwardModel, ratio: float) -> None:
    """Beside one that is known, and about as large as it is."""
    fit = ShapeFit(forward, ratio)
    known = shape_at(fit, 0, x_m=-0.012, y_m=-0.008, radius_m=0.006)
    family = outlines_on(forward).of(0, 2)
    both = np.append(known.parameters, [0.012 / UNIT_M, 0.006 / UNIT_M, np.log(0.004)])
    truth = fit.evaluate(family, both, fit.likely, measured(known.residual))
    assert truth is not None
    weight = np.full(len(known.residual), 100.0)
    found = ContactSearch(forward, ratio).best(
        fit.compare(known, measured(data_of(truth, fit), weight)), weight
    )
    assert np.hypot(found.x_m - 0.012, found.y_m - 0.006) < 0.005
    assert found.radius_m == pytest.approx(0.004, rel=0.35)
    assert found.gain > 10


@given(st.floats(-2, 2))
def test_the_heaviside_is_smooth_and_of_compact_support(t: float) -> None:
    at, step = np.array([t]), 1e-5
    assert 0 <= heaviside(at)[0] <= 1
    assert (heaviside(at)[0] == 0) == (t <= -1)
    assert heaviside(at)[0] + heaviside(-at)[0] == pytest.approx(1)
    numeric = (heaviside(at + step) - heaviside(at - step))[0] / (2 * step)
    assert heaviside_slope(at)[0] == pytest.approx(numeric, abs=1e-3)

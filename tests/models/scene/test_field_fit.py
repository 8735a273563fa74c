"""Fits of a pressure field to all sheets: derivatives, convergence, and what they leave open."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import product

import numpy as np
import pytest
from measured import measured
from pressed import (
    PLENTY_S,
    Sensor,
    contact,
    contacts,
    data_of,
    described,
    evaluated,
)
from tactomo_models import Channel, SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.bare_sheet import solve_bare_sheet
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.mesh import mesh_sheet
from tactomo_models.scene.drawing import Drawing
from tactomo_models.scene.field_fit import Budget, Family, FittedField
from tactomo_models.scene.level_set import LevelSet
from tactomo_models.scene.parameters import (
    EDGE,
    EDGE_LIMITS,
    HERTZ,
    PEAK,
    PRIOR_SIGMA,
    SIZE,
    UNIT_M,
    X,
    Y,
)
from tactomo_models.scene.pressure_field import PressureField
from taylor import taylor_orders
from variants import variant

EGG = (0.03, -0.02, 0.04, 0.05)
SCENES = {
    "circle": contacts(contact()),
    "ellipse": contacts(contact(e=(0.2, -0.1))),
    "rounded": contacts(contact(e=(0.2, -0.1), waves=EGG)),
    "soft": contacts(contact(e=(0.2, -0.1), edge=0.5)),
    "soft ring": contacts(contact(waves=EGG, edge=0.4, hole=0.6)),
    "overlapping": contacts(
        contact(-0.004, 0.001, 0.009, peak=0.9, edge=0.5),
        contact(0.005, -0.002, 0.007, peak=0.6),
    ),
}


@pytest.fixture(scope="module", params=["both", "both falling", "one graded", "structure alone"])
def sensor(
    request: pytest.FixtureRequest, forward: ForwardModel, small: SensorDescription
) -> Sensor:
    return Sensor.of(forward, described(small, request.param))


def level_set_at(sensor: Sensor) -> tuple[LevelSet, FloatArray]:
    """Two parts, with a pressure each where pressures are fitted."""
    centres = np.array([[-0.01, 0.0], [0.012, 0.004]])
    peaks = sensor.field if Channel.MAGNITUDE in sensor.fit.responses else None
    level_set = LevelSet(sensor.fit.forward).owned_by(centres, peaks)
    x, y = sensor.field.x_m, sensor.field.y_m
    near = np.hypot(x - centres[:, :1], y - centres[:, 1:]).min(axis=0)
    image = np.clip(1 - near / 0.016, 0, 1)
    start = level_set.parameters_of(image)
    return level_set, start if peaks is None else np.append(start, [0.8, 0.9])


# What every parameter draws, `test_pressure_field` tests; here, how each sheet answers to it.
@pytest.mark.parametrize("scene", ["rounded", "soft ring", "overlapping", "level set"])
def test_the_jacobian_passes_a_taylor_test(sensor: Sensor, scene: str) -> None:
    """Of all sheets' residuals, by all parameters and the log ratio together."""
    fit, rng = sensor.fit, np.random.default_rng(3)
    data = {
        name: measured(0.1 * rng.normal(size=len(none.change)), 1 + rng.random(len(none.change)))
        for name, none in sensor.no_data().items()
    }
    if scene == "level set":
        family: Family
        family, parameters = level_set_at(sensor)
    else:
        each = SCENES[scene]
        family = sensor.family(each)
        parameters = family.join(each)
    at = np.append(parameters, fit.likely)
    here = evaluated(fit, family, parameters, data)
    direction = rng.standard_normal(len(at))
    orders = taylor_orders(
        lambda p: evaluated(fit, family, p[:-1], data, p[-1]).residual,
        at,
        fit.jacobian(here, data) @ direction,
        direction,
    )
    assert orders == pytest.approx(2, abs=0.1)


def test_a_family_may_lay_out_what_it_draws_as_it_likes(sensor: Sensor) -> None:
    """Families are open: one that draws in strides, by columns, is evaluated as any other."""
    fit, each = sensor.fit, SCENES["soft"]
    family, data = sensor.family(each), sensor.no_data()

    class Strided(PressureField):
        def draw(self, parameters: FloatArray) -> Drawing:
            drawn = super().draw(parameters)
            one, two, three, four = (np.asfortranarray(each) for each in drawn.slopes())
            return Drawing(
                np.repeat(drawn.nodes, 2)[::2],
                np.repeat(drawn.enclosed, 2)[::2],
                np.repeat(drawn.enclosed_kpa, 2)[::2],
                np.repeat(drawn.share, 2)[::2],
                np.repeat(drawn.pressure_kpa, 2)[::2],
                lambda: (one, two, three, four),
            )

    strided = Strided(**{each.name: getattr(family, each.name) for each in fields(family)})
    one = evaluated(fit, family, family.join(each), data)
    other = evaluated(fit, strided, family.join(each), data)
    np.testing.assert_array_equal(one.residual, other.residual)
    np.testing.assert_array_equal(fit.jacobian(one, data), fit.jacobian(other, data))


@pytest.mark.slow
def test_a_small_press_keeps_its_force_where_the_sheet_changes_much(
    forward: ForwardModel, small: SensorDescription
) -> None:
    """As a mesh of a quarter of the distances shows it, sharply drawn; mean of places on the nodes.

    Were conductivities mixed on nodes that are pressed in part, it would be 3 % too strong.
    """
    radius_m = 0.008  # with two nodes' distances, what is made up for is no longer small
    description, step_m = described(small, "one graded"), 0.00075
    sheet = solve_bare_sheet(description, mesh_sheet(description, step_m))
    fine, coarse = (
        Sensor.of(model, description) for model in (ForwardModel(description, sheet), forward)
    )
    sharp = replace(fine, field=replace(fine.field, blur_m2=0.0, half_width_m=2 * step_m))
    forces = []
    for dx_m, dy_m in product((0.0, 0.0015), repeat=2):
        each = contacts(contact(dx_m, dy_m, radius_m, peak=0.9))
        data = data_of(sharp.changes(sharp.at(each, sharp.no_data())), 1e-3)
        found = coarse.settled(coarse.at(each, data), data)
        (one,) = coarse.family(each).split(found.parameters)
        forces.append(one[PEAK] / 0.9 * (np.exp(one[SIZE]) / radius_m) ** 2)
    assert np.mean(forces) == pytest.approx(1, abs=0.015)


@pytest.mark.slow
@pytest.mark.parametrize("edge", [0.0, 0.5], ids=["flat", "soft"])
def test_estimates_converge_at_second_order(small: SensorDescription, edge: float) -> None:
    """Voltages, and what is estimated from those of a finer mesh, as the mesh is refined.

    Outlines are as wide as a coarse map's nodes are apart, so that all meshes resolve them.
    """
    coarse_map = {"nodes_x": 11, "nodes_y": 11}
    description = variant(described(small, "both graded"), map=coarse_map)
    each = contacts(contact(0.003, -0.002, 0.012, edge=edge))
    sensors = [
        Sensor.of(
            ForwardModel(description, solve_bare_sheet(description, mesh_sheet(description, h))),
            description,
        )
        for h in (0.003, 0.0015, 0.00075)
    ]
    # The same is drawn on every mesh: none is made up for its own blur.
    drawn = [replace(sensor, field=replace(sensor.field, blur_m2=0.0)) for sensor in sensors]
    made = [sensor.changes(sensor.at(each, sensor.no_data())) for sensor in drawn]
    for name in made[0]:
        coarse, middle, fine = (changes[name] for changes in made)
        left = np.linalg.norm(coarse - middle) / np.linalg.norm(middle - fine)
        assert np.log2(left) == pytest.approx(2, abs=0.35)
    finest = sensors[-1]
    data = data_of(finest.changes(finest.at(each, finest.no_data())), 1e-3)
    beside = each.copy()
    beside[:, [X, SIZE]] += 0.1
    off = []
    for sensor in sensors[:-1]:
        found = sensor.settled(sensor.at(beside, data), data)
        (one,) = sensor.family(each).split(found.parameters)
        off.append(np.abs(one - each[0])[[SIZE, PEAK]])
    assert (off[1] < [0.01, 0.02]).all()  # of the radius, and of the table's end
    assert (off[1] < 0.4 * off[0]).all()


@pytest.mark.parametrize("scene", ["ellipse", "soft ring", "overlapping"])
def test_the_fit_explains_what_its_own_model_made(sensor: Sensor, scene: str) -> None:
    """Without noise or model error a field comes back from a start beside it."""
    each = SCENES[scene]
    truth = sensor.at(each, sensor.no_data())
    data = data_of(sensor.changes(truth), 0.001)
    beside = each.copy()
    beside[:, X] -= 0.2
    beside[:, Y] += 0.15
    beside[:, SIZE] += 0.1
    beside[:, PEAK] -= 0.07
    start = sensor.at(beside, data)
    found = sensor.fit.refine(start, data, Budget(PLENTY_S), good_enough=0.2)
    assert start.misfit > 3
    # Where outlines overlap the field has a kink, at which steps become short.
    assert found.misfit <= (0.75 if scene == "overlapping" else 0.5)
    assert found.converged
    one, other = on_nodes(truth), on_nodes(found)
    assert np.minimum(one[0], other[0]).sum() / one[0].sum() > 0.95
    if Channel.MAGNITUDE in sensor.fit.responses:
        force, found_force = (
            pressed @ sensor.fit.forward.node_areas_m2 for _, pressed in (one, other)
        )
        assert found_force == pytest.approx(force, rel=0.06)


def test_no_step_is_taken_that_would_gain_nothing(sensor: Sensor) -> None:
    """From next to the minimum one step is enough, and the last Jacobian tells so."""
    each = SCENES["circle"]
    truth = sensor.at(each, sensor.no_data())
    data = data_of(sensor.changes(truth), 0.003, np.random.default_rng(4))
    best = sensor.settled(sensor.fit.compare(truth, data), data)
    beside = best.parameters + 0.01 * (np.arange(len(best.parameters)) == X)
    start = sensor.fit.evaluate(best.family, beside, best.log_ratio, data)
    assert start is not None
    start = replace(start, damping=1e-3)
    budget, work = Budget(PLENTY_S), Budget(PLENTY_S)
    work.spend(start)
    found = sensor.fit.refine(start, data, budget, good_enough=0.0)
    assert found.converged
    assert start.cost - found.cost > 0.01 * start.cost
    solves = (PLENTY_S - budget.left_s) / (PLENTY_S - work.left_s)
    assert solves == pytest.approx(2, abs=0.5)  # one of them stands for the Jacobian
    again = sensor.fit.refine(found, data, Budget(PLENTY_S), good_enough=0.0)
    assert found.cost - again.cost < 2e-3 * found.cost


def on_nodes(fitted: FittedField) -> FloatArray:
    """What is enclosed, and the pressure on what is pressed, (2, P)."""
    assert isinstance(fitted.family, PressureField)
    values = np.zeros((2, len(fitted.family.x_m)))
    drawing = fitted.drawing
    values[:, drawing.nodes] = drawing.enclosed, drawing.share * drawing.pressure_kpa
    return values


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["circle", "soft"])
def test_parameters_scatter_as_their_covariance_says(sensor: Sensor, scene: str) -> None:
    """Place, size, and where the sheet is graded peak and edge.

    What voltages hardly tell is known from before: edges are as wide apart as the prior says.
    """
    each = SCENES[scene]
    sigma, rng = 0.003, np.random.default_rng(8)
    index = sensor.family(each).index[0, [X, Y, SIZE, PEAK, EDGE]]
    index = index[index >= 0]
    off = []
    for _ in range(80):
        true = each.copy()
        if each[0, EDGE]:
            drawn = HERTZ + PRIOR_SIGMA[EDGE] * rng.standard_normal()
            true[0, EDGE] = np.clip(drawn, *EDGE_LIMITS)
        truth = sensor.at(true, sensor.no_data())
        data = data_of(sensor.changes(truth), sigma, rng)
        found = sensor.settled(sensor.fit.compare(truth, data), data)
        J, (precision, _) = sensor.fit.jacobian(found, data), found.prior
        covariance = np.linalg.inv(J.T @ J + np.diag(precision))
        spread = np.sqrt(np.diag(covariance))[:-1]
        off.append(((found.parameters - truth.parameters) / spread)[index])
    within = np.abs(off) < 1
    assert within.mean() == pytest.approx(0.68, abs=0.1)
    assert within.mean(axis=0) == pytest.approx(0.68, abs=0.2)


def test_a_budget_that_is_used_up_leaves_a_better_field_that_has_not_converged(
    sensor: Sensor,
) -> None:
    each = SCENES["ellipse"]
    data = data_of(sensor.changes(sensor.at(each, sensor.no_data())), 0.002)
    field = sensor.at(contacts(contact(-0.01, 0.003, 0.009)), data)
    for _ in range(3):
        better = sensor.fit.refine(field, data, Budget(0.0), good_enough=0.0)
        assert better.cost <= field.cost
        assert not better.converged
        field = better


def test_holding_a_field_against_other_data_is_what_solving_it_would_say(
    sensor: Sensor, solves: list[int]
) -> None:
    each = SCENES["soft"]
    field = sensor.at(each, sensor.no_data())
    change = np.linspace(-1, 1, len(sensor.fit.forward.bare_voltages))
    data = {name: measured(change, np.linspace(1, 2, len(change))) for name in sensor.fit.responses}
    solves.clear()
    compared = sensor.fit.compare(field, data)
    assert not solves
    solved = sensor.at(each, data)
    np.testing.assert_array_equal(compared.residual, solved.residual)
    assert compared.cost == solved.cost
    assert compared.misfit == pytest.approx(
        np.sqrt(np.mean([solved.misfit_of(name) ** 2 for name in data]))
    )


def test_a_sheet_that_is_lost_and_comes_back_is_left_out_and_solved(
    forward: ForwardModel, small: SensorDescription, solves: list[int]
) -> None:
    sensor = Sensor.of(forward, described(small, "both"))
    each = SCENES["circle"]
    both = sensor.at(each, sensor.no_data())
    exact = data_of(sensor.changes(both), 0.002)
    alone = {Channel.STRUCTURE: exact[Channel.STRUCTURE]}
    solves.clear()
    left = sensor.fit.compare(both, alone)
    assert not solves
    assert list(left.residuals) == [Channel.STRUCTURE]
    again = sensor.fit.compare(left, exact)
    assert solves
    assert again.residuals.keys() == exact.keys()
    assert again.misfit == pytest.approx(sensor.fit.compare(both, exact).misfit)


def test_a_field_pushed_off_the_sheet_stays_on_it(sensor: Sensor) -> None:
    """Data of a contact half beyond the rim, and a start in the corner."""
    width, height = 0.06, 0.05
    beyond = contacts(contact(width / 2, 0.005, 0.009))
    made = sensor.changes(sensor.at(beyond, sensor.no_data()))
    data = data_of(made, 0.01, np.random.default_rng(2))
    start = sensor.at(contacts(contact(width / 2 - 0.002, height / 2, 0.006)), data)
    found = sensor.fit.refine(start, data, Budget(PLENTY_S), 1.0)
    assert isinstance(found.family, PressureField)
    (one,) = found.family.split(found.parameters)
    assert np.isfinite(one).all()
    assert abs(one[X]) * UNIT_M <= width / 2
    assert abs(one[Y]) * UNIT_M <= height / 2
    assert found.cost < start.cost

"""Contacts that are frozen: trials of another one are those of all together, at its own cost."""

from __future__ import annotations

import numpy as np
import pytest
from measured import measured
from pressed import contact, contacts
from tactomo_models import Channel, SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.bare_sheet import solve_bare_sheet
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.greens import PackedGreensFunction
from tactomo_models.physics.mesh import mesh_sheet
from tactomo_models.scene.field_fit import Background, Budget, FieldFit, FittedField, Measured
from tactomo_models.scene.parameters import X
from tactomo_models.scene.pressure_field import PressureField
from tactomo_models.scene.sheet_response import GradedResponse
from taylor import taylor_orders

RADIUS_M = 0.009
BESIDE_M = 2 * RADIUS_M + 0.018  # centres of contacts that are only just apart
SCENES = {
    "far apart": contacts(contact(-0.04, -0.03, RADIUS_M), contact(0.03, 0.02, RADIUS_M)),
    "beside each other": contacts(
        contact(0.0, 0.0, RADIUS_M, edge=0.5),
        contact(BESIDE_M, 0.0, RADIUS_M, peak=0.6),
        contact(0.0, -BESIDE_M, RADIUS_M, e=(0.1, -0.1)),
        contact(-0.04, 0.045, RADIUS_M),
    ),
    "at the edge": contacts(contact(-0.066, -0.054, RADIUS_M), contact(-0.066, -0.01, RADIUS_M)),
    "alone": contacts(contact(0.01, 0.0, RADIUS_M)),
}


@pytest.fixture(scope="module", params=["packed", "single precision", "in pieces"])
def fit(request: pytest.FixtureRequest, paper: SensorDescription) -> FieldFit:
    sheet = mesh_sheet(paper, refinements=1)
    single = request.param == "single precision"
    dtype = np.float32 if single else np.float64
    quick = request.param == "in pieces"
    return FieldFit(
        ForwardModel(paper, solve_bare_sheet(paper, sheet, quick=quick, green_dtype=dtype))
    )


@pytest.fixture(scope="module")
def data(fit: FieldFit) -> Measured:
    rng, count = np.random.default_rng(2), len(fit.forward.bare_voltages)
    return {
        name: measured(0.1 * rng.normal(size=count), 1 + rng.random(count)).drifting(
            rng.normal(size=(count, 3))
        )
        for name in fit.responses
    }


def field_of(fit: FieldFit, each: FloatArray) -> PressureField:
    graded = fit.responses[Channel.MAGNITUDE]
    assert isinstance(graded, GradedResponse)
    return PressureField.on(fit.forward, graded).of(each)


def at(
    fit: FieldFit, each: FloatArray, data: Measured, background: Background | None = None
) -> FittedField | None:
    family = field_of(fit, each)
    return fit.evaluate(family, family.join(each), fit.likely, data, background=background)


def moved(each: FloatArray, k: int) -> FloatArray:
    """Contacts, one of which has moved, grown and turned."""
    each = each.copy()
    each[k, :5] += 0.1, -0.15, 0.02, 0.03, -0.02
    return each


def joint_and_alone(
    fit: FieldFit, data: Measured, scene: str, k: int
) -> tuple[FittedField, FittedField]:
    """A contact moved: solved with all others, and before them as a background."""
    before = at(fit, SCENES[scene], data)
    assert before is not None
    background = fit.background(before, [k], data)
    after = moved(SCENES[scene], k)
    alone = at(fit, after[k : k + 1], data, background)
    joint = at(fit, after, data)
    assert alone is not None
    assert joint is not None
    return joint, alone


def rounding_of(fit: FieldFit) -> float:
    """Share to which numbers are the same: fields balance at inner nodes but for rounding."""
    green = fit.forward.bare.green
    single = isinstance(green, PackedGreensFunction) and green.lower.dtype == np.float32
    return 1e-4 if single else 1e-8


@pytest.mark.parametrize("scene", SCENES)
def test_a_trial_is_that_of_all_together(fit: FieldFit, data: Measured, scene: str) -> None:
    k = len(SCENES[scene]) - 1
    joint, alone = joint_and_alone(fit, data, scene, k)
    rounding = rounding_of(fit)

    def agree(one: FloatArray, other: FloatArray, to: float = rounding) -> None:
        np.testing.assert_allclose(one, other, rtol=0, atol=to * np.abs(other).max())

    for name in data:
        one, other = joint.solutions[name], alone.solutions[name]
        agree(one.voltages, other.voltages)
        assert len(SCENES[scene]) == 1 or len(other.nodes) < len(one.nodes)
        assert set(other.rim) == set(one.rim)
        outside = np.setdiff1d(np.arange(len(fit.forward.bare.support)), one.nodes)
        for places in (other.nodes, other.rim, outside):
            agree(fit.forward.potentials(one, places), fit.forward.potentials(other, places))
    agree(joint.residual, alone.residual)
    assert joint.cost == pytest.approx(alone.cost, rel=rounding)
    own = field_of(fit, SCENES[scene]).index[k]
    agree(fit.jacobian(joint, data)[:, own[own >= 0]], fit.jacobian(alone, data)[:, :-1])
    # Other data leave the background where it is.
    again, other_data = fit.compare(alone, data), {name: data[name] for name in [*data][:1]}
    agree(again.residual, alone.residual)
    assert again.cost == pytest.approx(alone.cost)
    fewer = fit.compare(alone, other_data)
    assert fewer.background is alone.background


def test_several_contacts_may_be_free(fit: FieldFit, data: Measured) -> None:
    before = at(fit, SCENES["beside each other"], data)
    assert before is not None
    background = fit.background(before, [2, 0], data)
    after = moved(moved(SCENES["beside each other"], 0), 2)
    free, joint = at(fit, after[[0, 2]], data, background), at(fit, after, data)
    assert background is not None
    assert free is not None
    assert joint is not None
    assert background.family.count == 2
    to = rounding_of(fit) * np.abs(joint.residual).max()
    np.testing.assert_allclose(free.residual, joint.residual, rtol=0, atol=to)
    assert fit.background(before, range(4), data) is None  # nothing is left to be frozen


def test_its_jacobian_passes_a_taylor_test(fit: FieldFit, data: Measured) -> None:
    """By the parameters of the contact that is not frozen, and the log ratio of it alone."""
    _, alone = joint_and_alone(fit, data, "beside each other", 0)
    rng = np.random.default_rng(6)
    here = np.append(alone.parameters, alone.log_ratio)
    direction = rng.standard_normal(len(here))

    def residual(at: FloatArray) -> FloatArray:
        made = fit.evaluate(alone.family, at[:-1], at[-1], data, background=alone.background)
        assert made is not None
        return made.residual

    orders = taylor_orders(residual, here, fit.jacobian(alone, data) @ direction, direction)
    assert orders == pytest.approx(2, abs=0.1)


def test_a_contact_is_refined_before_its_background(fit: FieldFit, data: Measured) -> None:
    """It comes back to where the data have it, and then all of them explain the data."""
    truth = at(fit, SCENES["beside each other"], data)
    assert truth is not None
    bare = fit.forward.bare_voltages
    exact = {
        name: measured((solution.voltages - bare) / np.abs(bare), 1e3)
        for name, solution in truth.solutions.items()
    }
    start = at(fit, SCENES["beside each other"], exact)
    assert start is not None
    background = fit.background(start, [1], exact)
    alone = at(fit, moved(SCENES["beside each other"], 1)[1:2], exact, background)
    assert alone is not None
    found = fit.refine(alone, exact, Budget(30.0), good_enough=0.1)
    assert alone.misfit > 3
    assert found.misfit < 0.1
    assert found.background is background


def test_contacts_are_frozen_only_where_they_are_apart(fit: FieldFit, data: Measured) -> None:
    each = contacts(contact(0.0, 0.0, RADIUS_M), contact(BESIDE_M, 0.0, RADIUS_M))
    far = at(fit, each, data)
    assert far is not None
    background = fit.background(far, [0], data)
    assert background is not None
    nearer = each.copy()
    nearer[1, X] -= 0.7  # then areas do not touch, but soon would
    near = at(fit, nearer, data)
    assert near is not None
    assert fit.background(near, [0], data) is None
    each[0, X] += 1.4
    assert at(fit, each[:1], data, background) is None


def test_a_trial_is_right_until_it_touches_what_is_frozen(fit: FieldFit, data: Measured) -> None:
    """Down to areas that are one node apart."""
    each = contacts(contact(0.0, 0.0, RADIUS_M), contact(BESIDE_M, 0.0, RADIUS_M))
    start = at(fit, each, data)
    assert start is not None
    background = fit.background(start, [0], data)
    steps = 0
    while True:
        each[0, X] += 0.05
        alone, joint = at(fit, each[:1], data, background), at(fit, each, data)
        if alone is None:
            break
        assert joint is not None
        to = rounding_of(fit) * np.abs(joint.residual).max()
        np.testing.assert_allclose(alone.residual, joint.residual, rtol=0, atol=to)
        steps += 1
    gap_mm = 18 - 0.5 * steps  # between outlines, which reach two nodes and a half outwards
    assert gap_mm < 13


def test_what_is_not_known_of_frozen_areas_is_not_told(fit: FieldFit, data: Measured) -> None:
    _, alone = joint_and_alone(fit, data, "far apart", 0)
    assert alone.background is not None
    (frozen, *_), (solution, *_) = alone.background.sheets.values(), alone.solutions.values()
    inner = np.setdiff1d(np.flatnonzero(frozen.inside), frozen.rim)
    with pytest.raises(ValueError, match="inside frozen areas"):
        fit.forward.potentials(solution, inner[:1])
    with pytest.raises(ValueError, match="whole pressure field"):
        fit.background(alone, [0], data)

"""The pressure field: what is pressed and how hard, and how both go with the parameters."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pressed import contact, contacts, with_free
from tactomo_models import SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene.drawing import Drawing, heaviside, heaviside_slope
from tactomo_models.scene.level_set import LevelSet
from tactomo_models.scene.parameters import (
    COLUMNS,
    EDGE,
    EDGE_LIMITS,
    HARMONIC,
    HOLE,
    PEAK,
    SIZE,
    X,
    Y,
)
from tactomo_models.scene.pressure_field import PressureField, ellipses_of
from tactomo_models.scene.sheet_response import GradedResponse
from taylor import taylor_orders

EGG = (0.03, -0.02, 0.04, 0.05)
MOST_BLURRED = 0.4  # as in inner_loop.c
SCENES = {
    "circle": contacts(contact()),
    "ellipse": contacts(contact(e=(0.2, -0.1))),
    "round ellipse": contacts(contact()),
    "rounded": contacts(contact(e=(0.2, -0.1), waves=EGG)),
    "soft circle": contacts(contact(edge=0.5)),
    "soft and rounded": contacts(contact(e=(0.2, -0.1), waves=EGG, edge=0.7)),
    "ring": contacts(contact(e=(0.2, -0.1), hole=0.8)),
    "soft ring": contacts(contact(waves=EGG, edge=0.4, hole=0.6)),
    "overlapping": contacts(
        contact(-0.004, 0.001, 0.009, peak=0.9, edge=0.5),
        contact(0.005, -0.002, 0.007, peak=0.6),
        contact(0.001, 0.007, 0.006, peak=0.7, hole=0.5),
    ),
}
FURTHER = {
    "edges": slice(EDGE, EDGE + 1),
    "holes": slice(HOLE, HOLE + 1),
    "bulges": slice(HARMONIC, PEAK),
}


@pytest.fixture(scope="module")
def field(forward: ForwardModel, small: SensorDescription) -> PressureField:
    assert small.magnitude is not None
    return PressureField.on(forward, GradedResponse.of(small.magnitude.response))


def test_slopes_stay_small_where_a_node_is_in_the_middle_of_a_small_contact(
    field: PressureField,
) -> None:
    """There an outline's distance has no direction: slopes were a million times as large."""
    at = int(np.hypot(field.x_m, field.y_m).argmin())
    for off_m in (0.0, 1e-12, 1e-9, 1e-6, 1e-4):
        each = contacts(contact(field.x_m[at] + off_m, field.y_m[at], 0.003, e=(0.5, 0.3)))
        family = field.of(each)
        drawing = family.draw(family.join(each))
        assert max(np.abs(slope).max() for slope in drawing.slopes()[::2]) < 1000


def on_nodes(drawing: Drawing, count: int, unit_kpa: float) -> FloatArray:
    """What each sheet sees pressed, and the pressure on that in the field's unit: (4, P)."""
    values = np.zeros((4, count))
    enclosed = drawing.enclosed * drawing.enclosed_kpa / unit_kpa
    pressed = drawing.share * drawing.pressure_kpa / unit_kpa
    values[:, drawing.nodes] = drawing.enclosed, enclosed, drawing.share, pressed
    return values


def slope_on_nodes(
    drawing: Drawing, direction: FloatArray, count: int, unit_kpa: float
) -> FloatArray:
    """Derivative of the same along a direction of the parameters."""
    wide, wide_kpa, share, pressure = (each @ direction for each in drawing.slopes())
    slope = np.zeros((4, count))
    enclosed = wide * drawing.enclosed_kpa + drawing.enclosed * wide_kpa
    pressed = share * drawing.pressure_kpa + drawing.share * pressure
    slope[:, drawing.nodes] = wide, enclosed / unit_kpa, share, pressed / unit_kpa
    return slope


def orders_of(field: PressureField, parameters: FloatArray, direction: FloatArray) -> FloatArray:
    count, unit = len(field.x_m), field.unit_kpa
    slope = slope_on_nodes(field.draw(parameters), direction, count, unit)
    return taylor_orders(
        lambda p: on_nodes(field.draw(p), count, unit), parameters, slope, direction
    )


@pytest.mark.parametrize("name", SCENES)
def test_what_is_drawn_passes_a_taylor_test(field: PressureField, name: str) -> None:
    """Every parameter of every contact at once, those of edge and peak too."""
    each = SCENES[name]
    drawn = field.of(each)
    parameters = drawn.join(each)
    direction = np.random.default_rng(3).standard_normal(len(parameters))
    assert orders_of(drawn, parameters, direction) == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize("name", ["ellipse", "overlapping"])
@pytest.mark.parametrize("further", FURTHER)
def test_what_is_not_fitted_yet_passes_it_too(
    field: PressureField, name: str, further: str
) -> None:
    """The data are asked for an edge, a hole or bulges by these slopes, before any is fitted."""
    each = SCENES[name]
    drawn = with_free(field.of(each), FURTHER[further])
    parameters = drawn.join(each)
    direction = np.random.default_rng(4).standard_normal(len(parameters))
    assert orders_of(drawn, parameters, direction) == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize("peaks", [False, True])
def test_a_level_set_passes_a_taylor_test(
    forward: ForwardModel, field: PressureField, peaks: bool
) -> None:
    centres = np.array([[-0.01, 0.0], [0.012, 0.004]])
    level_set = LevelSet(forward).owned_by(centres, field if peaks else None)
    x, y = field.x_m, field.y_m
    near = np.hypot(x - centres[:, :1], y - centres[:, 1:]).min(axis=0)
    parameters = np.append(level_set.parameters_of(np.clip(1 - near / 0.016, 0, 1)), [0.6, 0.9])
    direction = np.random.default_rng(5).standard_normal(len(parameters))
    count, unit = len(x), field.unit_kpa if peaks else level_set.draw(parameters).pressure_kpa[0]
    slope = slope_on_nodes(level_set.draw(parameters), direction, count, unit)
    orders = taylor_orders(
        lambda p: on_nodes(level_set.draw(p), count, unit), parameters, slope, direction
    )
    assert orders == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize("name", SCENES)
def test_shares_and_pressures_stay_what_they_are(field: PressureField, name: str) -> None:
    each = SCENES[name]
    drawing = field.of(each).draw(field.of(each).join(each))
    assert drawing.enclosed.max() <= 1
    assert drawing.share.min() >= 0
    assert drawing.share.max() <= 1 / (1 - MOST_BLURRED)
    assert drawing.pressure_kpa.min() >= 0
    # Averaged over the rim's width, a small contact's falling pressure is a little above its peak.
    rim = 1 + (0.5 * field.half_width_m / np.exp(each[:, SIZE].min())) ** 2
    assert drawing.pressure_kpa.max() <= field.unit_kpa * each[:, PEAK].max() * rim


def test_far_from_contacts_nothing_is_drawn(field: PressureField) -> None:
    each = contacts(contact())
    drawn = field.of(each)
    nodes = drawn.draw(drawn.join(each)).nodes
    assert np.hypot(field.x_m[nodes] - 0.004, field.y_m[nodes]).max() < 0.02
    empty = field.of(np.zeros((0, COLUMNS)))
    assert len(empty.draw(np.zeros(0)).nodes) == 0


def test_what_is_pressed_twice_is_pressed_once(field: PressureField) -> None:
    """Two contacts in one place are one of their mean pressure."""
    one = contacts(contact(peak=0.7))
    two = contacts(contact(peak=0.9), contact(peak=0.5))
    single, both = (field.of(each).draw(field.of(each).join(each)) for each in (one, two))
    inside = single.share > 0.999 * single.share.max()
    np.testing.assert_allclose(both.pressure_kpa[inside], single.pressure_kpa[inside])
    np.testing.assert_allclose(both.share[inside], single.share[inside], rtol=1e-3)


@pytest.mark.parametrize("edge", [0.0, 0.5, 1.0])
def test_a_field_has_its_force(field: PressureField, edge: float) -> None:
    """A circle of radius R, peak P and edge gamma presses with pi R^2 P / (1 + gamma)."""
    each = contacts(contact(0.001, -0.002, 0.012, peak=0.8, edge=edge))
    axis, step = np.linspace(-0.02, 0.02, 401, retstep=True)
    x, y = (places.ravel() for places in np.meshgrid(axis, axis))
    _, share, pressure = field.of(each).sampled(each, x, y, float(step))
    force = 1e3 * (share * pressure).sum() * step**2
    # The rim's width, over which a falling pressure is averaged, is that of the samples.
    assert force == pytest.approx(1e3 * np.pi * 0.012**2 * 0.8 * 200 / (1 + edge), rel=5e-3)


@pytest.mark.parametrize("edge", [0.0, 0.5])
@pytest.mark.parametrize("radius_m", [0.008, 0.012])
def test_a_mesh_shows_area_and_moments_of_what_is_drawn(
    forward: ForwardModel, field: PressureField, edge: float, radius_m: float
) -> None:
    """On the triangles, each the mean of its corners: what the far field of voltages sees."""
    each = contacts(contact(0.0, 0.0, radius_m, peak=0.8, edge=edge))
    points, triangles = forward.bare.points, forward.bare.triangles
    offsets = np.arange(4) / 4 * 0.3  # of the nodes' distance

    def seen(of: PressureField) -> FloatArray:
        """Force and second moment of an axis, as the mean of places between the nodes."""
        found = []
        for place in product(offsets, offsets):
            moved = each.copy()
            moved[0, [X, Y]] = place
            drawing = of.of(moved).draw(of.of(moved).join(moved))
            pressed = np.zeros(points.shape[1])
            pressed[forward.bare.pressable[drawing.nodes]] = drawing.share * drawing.pressure_kpa
            corners = points[:, triangles] - 0.01 * moved[0, [X, Y], None, None]
            (ax, bx, cx), (ay, by, cy) = corners
            area = np.abs((bx - ax) * (cy - ay) - (cx - ax) * (by - ay)) / 2
            mean = pressed[triangles].mean(axis=0) * area
            squares = ((corners.sum(axis=1) ** 2) + (corners**2).sum(axis=1)) / 12
            found.append([mean.sum(), (mean * squares.sum(axis=0) / 2).sum()])
        return np.asarray(np.mean(found, axis=0))

    force = np.pi * radius_m**2 * field.unit_kpa * 0.8 / (1 + edge)
    true = np.array([force, force * radius_m**2 / (2 * edge + 4)])
    assert seen(field) == pytest.approx(true, rel=0.08)
    assert seen(replace(field, blur_m2=0.0))[1] > 1.02 * seen(field)[1]


def test_a_ring_presses_with_its_rim(field: PressureField) -> None:
    each = contacts(contact(0.0, 0.0, 0.012, hole=1.0))
    x, y = np.array([0.0, 0.009, 0.013]), np.zeros(3)
    enclosed, share, _ = field.of(each).sampled(each, x, y, 1e-4)
    np.testing.assert_array_equal(enclosed, [1, 1, 0])
    np.testing.assert_array_equal(share, [0, 1, 0])


@given(st.lists(st.floats(-1e3, 1e3), min_size=2 * COLUMNS, max_size=2 * COLUMNS))
def test_contacts_stay_on_the_sheet_and_of_a_contacts_size(
    field: PressureField, parameters: list[float]
) -> None:
    each = np.array(parameters).reshape(2, COLUMNS)
    each[:, EDGE], each[:, HOLE] = np.abs(each[:, EDGE]), 0.0
    family = field.of(each)
    bounded = family.bounded(family.join(each))
    inside = family.split(bounded)
    assert np.abs(inside[:, X] * 0.01).max() <= np.abs(field.x_m).max() + 1e-12
    assert np.abs(inside[:, Y] * 0.01).max() <= np.abs(field.y_m).max() + 1e-12
    least_size, most_size = field.limits[:, SIZE]
    assert (inside[:, SIZE] >= least_size).all()
    assert (inside[:, SIZE] <= most_size).all()
    least, most = field.limits[:, PEAK]
    assert (inside[:, PEAK] >= least).all()
    assert (inside[:, PEAK] <= most).all()
    np.testing.assert_allclose(family.bounded(bounded), bounded)
    drawing = family.draw(bounded)
    assert np.isfinite(drawing.share).all()
    assert np.isfinite(drawing.pressure_kpa).all()


def test_a_step_makes_no_other_kind_of_a_contact(field: PressureField) -> None:
    """What falls goes on to fall, however far a step leads; what is even stays even."""
    each = contacts(contact(-0.03, edge=0.5), contact(0.03))
    family = field.of(each)
    each[0, EDGE] = -0.2
    inside = family.split(family.bounded(family.join(each)))
    np.testing.assert_array_equal(inside[:, EDGE], [EDGE_LIMITS[0], 0.0])


@given(
    st.floats(-0.01, 0.01),
    st.floats(-0.01, 0.01),
    st.floats(0.005, 0.01),
    st.floats(0, 0.4),
    st.floats(0, np.pi),
)
def test_an_image_becomes_the_ellipse_that_it_shows(
    field: PressureField, x: float, y: float, radius: float, elongation: float, angle: float
) -> None:
    e = elongation * np.cos(2 * angle), elongation * np.sin(2 * angle)
    each = contacts(contact(x, y, radius, e=e))
    axis, step = np.linspace(-0.03, 0.03, 61, retstep=True)
    x_m, y_m = np.meshgrid(axis, axis)
    _, share, _ = field.of(each).sampled(each, x_m.ravel(), y_m.ravel(), float(step))
    (found,) = ellipses_of(share.reshape(1, 61, 61), x_m, y_m, typical_peak=0.5)
    assert found[[X, Y]] * 0.01 == pytest.approx([x, y], abs=2e-4)
    assert np.exp(found[SIZE]) == pytest.approx(radius, rel=0.02)
    assert found[3:5] == pytest.approx(e, abs=0.03)
    assert found[PEAK] == 0.5


@given(st.floats(-2, 2))
def test_the_heaviside_is_smooth_and_of_compact_support(t: float) -> None:
    at, step = np.array([t]), 1e-5
    assert 0 <= heaviside(at)[0] <= 1
    assert (heaviside(at)[0] == 0) == (t <= -1)
    assert heaviside(at)[0] + heaviside(-at)[0] == pytest.approx(1)
    numeric = (heaviside(at + step) - heaviside(at - step))[0] / (2 * step)
    assert heaviside_slope(at)[0] == pytest.approx(numeric, abs=1e-3)


def test_a_sheet_without_a_table_has_a_field_too(forward: ForwardModel) -> None:
    field = PressureField.on(forward, None)
    each = contacts(contact())
    family = field.of(each, fits_peaks=False)
    assert len(family.join(each)) == 5

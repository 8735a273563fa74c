"""Sheets of any outline: their meshes, and voltages against independent and analytic solutions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spla
import skfem
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.special import i0, i1
from skfem.helpers import dot, grad
from tactomo_models import (
    Press,
    Reconstructor,
    Reference,
    SensorDescription,
    SkinSimulator,
    load_description,
)
from tactomo_models.arrays import FloatArray
from tactomo_models.drift.drift_model import DriftSubspace, PressMemory
from tactomo_models.physics.bare_sheet import scan_voltages, solve_bare_sheet, transfer_resistances
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.mesh import mesh_sheet
from tactomo_models.scene.parameters import COLUMNS, SIZE, UNIT_M, X, Y
from tactomo_models.scene.pressure_field import PressureField
from tactomo_protocol import Channel
from variants import variant

POLYGONS = ("palm_l", "insole")


def area_of(mesh: skfem.MeshTri) -> FloatArray:
    a, b, c = mesh.p[:, mesh.t].transpose(1, 0, 2)
    return np.asarray(np.abs((b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0]) / 2)


@pytest.mark.parametrize("name", POLYGONS)
def test_every_map_node_inside_is_a_mesh_node(name: str) -> None:
    sensor = load_description(name)
    sheet = mesh_sheet(sensor)
    step_m = sensor.map_y_m[1] - sensor.map_y_m[0]
    x, y = np.meshgrid(sensor.map_x_m, sensor.map_y_m)
    deep = sensor.on_sheet(x, y, step_m / 2)
    nodes = {(round(a, 9), round(b, 9)) for a, b in sheet.mesh.p.T}
    wanted = {(round(a, 9), round(b, 9)) for a, b in zip(x[deep], y[deep], strict=True)}
    assert wanted <= nodes
    bare = solve_bare_sheet(sensor, sheet, quick=True)
    covered = np.diff(bare.map_weights.tocsr().indptr) > 0
    assert (covered[sensor.on_sheet(x, y, sensor.sheet.frame_width_m + step_m).ravel()]).all()
    assert not covered[~sensor.on_sheet(x, y, -step_m / 2).ravel()].any()


@pytest.mark.parametrize("name", POLYGONS)
def test_squares_of_nodes_are_halved_in_turn(name: str) -> None:
    """So that the mesh prefers no direction: nodes have eight neighbours and four by turns."""
    sensor = load_description(name)
    mesh = mesh_sheet(sensor, refinements=0).mesh
    steps = np.array([np.diff(sensor.map_x_m)[0], np.diff(sensor.map_y_m)[0]])
    deep = sensor.on_sheet(mesh.p[0], mesh.p[1], float(3 * steps.max()))
    column, row = np.round((mesh.p.T - [sensor.map_x_m[0], sensor.map_y_m[0]]) / steps).T[:, deep]
    neighbours = np.bincount(mesh.facets.ravel())[deep]
    by_turns = {tuple(np.unique(neighbours[(column + row) % 2 == odd])) for odd in (0, 1)}
    assert by_turns == {(4,), (8,)}


@pytest.mark.parametrize("name", POLYGONS)
def test_the_rim_is_followed(name: str) -> None:
    sensor = load_description(name)
    sheet = mesh_sheet(sensor)
    outline = sensor.sheet.outline
    assert area_of(sheet.mesh).sum() == pytest.approx(outline.polygon.area, rel=1e-3)
    rim = sheet.mesh.p[:, sheet.mesh.boundary_nodes()]
    assert np.abs(outline.depth(*rim)).max() < 1e-4
    for edges in sheet.electrode_edges:
        ends = sheet.mesh.p[:, edges[:, :2]]
        length = np.linalg.norm(ends[..., 0] - ends[..., 1], axis=0).sum()
        assert length == pytest.approx(sensor.electrodes.length_m, rel=1e-2)


def star(corners: list[float], hole: float, turn: float) -> SensorDescription:
    """A sheet with a corner at each of these radii, and a hole of that share in the middle."""
    angle = turn + 2 * np.pi * np.arange(len(corners)) / len(corners)
    ring = np.array(corners)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ring -= (ring.min(axis=0) + ring.max(axis=0)) / 2
    raw = load_description("palm_l").model_dump(by_alias=True, exclude_none=True)
    middle = ring.mean(axis=0)
    raw["sheet"] |= {
        "outline_m": ring.tolist(),
        "holes_m": [(middle + hole * (ring - middle)).tolist()] if hole else [],
        "frame_width_m": 0.0,
    }
    raw["electrodes"]["positions_m"] = ((ring + np.roll(ring, -1, axis=0)) / 2).tolist()
    raw["map"] = {"nodes_x": 31, "nodes_y": 31}
    return SensorDescription.model_validate(raw)


@settings(max_examples=12, deadline=None)
@given(
    st.lists(st.floats(0.05, 0.1), min_size=6, max_size=14),
    st.sampled_from([0.0, 0.2, 0.5]),
    st.floats(0, 6),
)
@example([0.05, 0.1, 0.05, 0.1, 0.05, 0.1], 0.5, 0.0)
def test_a_polygon_of_any_geometry(corners: list[float], hole: float, turn: float) -> None:
    try:
        sensor = star(corners, hole, turn)
    except ValueError:
        return  # refused by name: see tests/models/sensor/test_polygon.py
    sheet = mesh_sheet(sensor, refinements=1)
    assert area_of(sheet.mesh).min() > 0
    assert area_of(sheet.mesh).sum() == pytest.approx(sensor.sheet.outline.polygon.area, rel=2e-3)
    taken = np.concatenate(sheet.electrode_edges)[:, :2]
    assert len({frozenset(ends) for ends in taken.tolist()}) == len(taken) > 0
    transfer = transfer_resistances(sensor, sheet, np.ones(sheet.mesh.t.shape[1]))
    voltages = scan_voltages(sensor, transfer)
    assert np.isfinite(voltages).all()
    if not hole:
        swapped = scan_voltages(sensor, transfer.T)
        np.testing.assert_allclose(voltages, swapped, rtol=1e-6, atol=1e-9)


@skfem.BilinearForm  # type: ignore[untyped-decorator]
def _laplace(u: Any, v: Any, _: Any) -> Any:
    return dot(grad(u), grad(v))


def l_shaped_transfer(sensor: SensorDescription, refinements: int) -> FloatArray:
    """Transfer resistances by scikit-fem's own L-shaped mesh and an assembly of another form."""
    mesh = skfem.MeshTri.init_lshaped().refined(refinements).scaled(0.06)
    if (mesh.p[0] > 1e-9).any() and ((mesh.p[0] > 1e-9) & (mesh.p[1] > 1e-9)).any():
        mesh = skfem.MeshTri(mesh.p * [[1], [-1]], mesh.t)
    basis = skfem.Basis(mesh, skfem.ElementTriP1())
    nodes, electrodes = mesh.p.shape[1], sensor.electrode_count
    contact_m = sensor.electrodes.contact_impedance_ohm_m * sensor.sheet_conductance_s
    mass = skfem.BilinearForm(lambda u, v, _: u * v)
    load = skfem.LinearForm(lambda v, _: v)
    system = _laplace.assemble(basis)
    couplings, lengths = [], []
    middles = mesh.p[:, mesh.facets].mean(axis=1)
    rim = mesh.boundary_facets()
    for centre in np.array(sensor.electrodes.positions_m):
        off = np.linalg.norm(middles[:, rim] - centre[:, None], axis=0)
        facets = rim[off < sensor.electrodes.length_m / 2]
        side = skfem.FacetBasis(mesh, skfem.ElementTriP1(), facets=facets)
        system = system + mass.assemble(side) / contact_m
        couplings.append(load.assemble(side) / contact_m)
        lengths.append(couplings[-1].sum())
    coupling = sp.csr_matrix(np.array(couplings)).T
    whole = sp.bmat([[system, -coupling], [-coupling.T, sp.diags(lengths)]]).tocsc()[:-1, :-1]
    currents = np.zeros((nodes + electrodes - 1, electrodes - 1))
    currents[nodes:] = np.eye(electrodes - 1)
    transfer = np.zeros((electrodes, electrodes))
    transfer[:-1, :-1] = spla.splu(whole).solve(currents)[nodes:]
    return transfer


def test_an_l_shape_has_the_voltages_of_another_mesh() -> None:
    palm = variant(load_description("palm_l"), electrodes={"length_m": 0.0075})
    coarse, fine, finest = (scan_voltages(palm, l_shaped_transfer(palm, n)) for n in (5, 6, 7))
    rate = np.linalg.norm(fine - coarse) / np.linalg.norm(finest - fine)
    assert rate > 2
    limit = finest + (finest - fine) / (rate - 1)
    sheet = mesh_sheet(palm, 0.001)
    ours = scan_voltages(palm, transfer_resistances(palm, sheet, np.ones(sheet.mesh.t.shape[1])))
    assert np.linalg.norm(ours - limit) < 1e-3 * np.linalg.norm(limit)
    np.testing.assert_allclose(ours, limit, rtol=0.01)


def model(sensor: SensorDescription, spacing_m: float) -> ForwardModel:
    return ForwardModel(sensor, solve_bare_sheet(sensor, mesh_sheet(sensor, spacing_m), quick=True))


def bump(forward: ForwardModel, place: tuple[float, float]) -> FloatArray:
    x, y = forward.bare.points[:, forward.bare.pressable]
    return np.asarray(np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * 0.01**2)))


@pytest.mark.parametrize(
    ("name", "place"),
    [("palm_l", (-0.03, -0.03)), pytest.param("insole", (0.0, 0.06), marks=pytest.mark.slow)],
)
def test_voltages_converge_and_the_jacobian_passes_a_taylor_test(
    name: str, place: tuple[float, float]
) -> None:
    sensor = load_description(name)
    models = [model(sensor, spacing_m) for spacing_m in (0.008, 0.004, 0.002)]
    found = [
        np.concatenate([each.bare_voltages, each.solve(bump(each, place)).voltages])
        for each in models
    ]
    # An L's corner and electrodes' ends are singular: the order is what a rectangle's is, above 1.
    errors = [np.linalg.norm((v - found[2]) / found[2]) for v in found[:2]]
    assert np.log2(errors[0] / errors[1]) > 1
    forward = models[1]
    change = bump(forward, place)
    where = np.flatnonzero(change > 1e-2)
    change[change <= 1e-2] = 0
    solution = forward.solve(change)
    jacobian = forward.jacobian(solution, where)
    step = np.zeros_like(change)
    step[where] = 0.1 * change[where] * np.random.default_rng(0).uniform(-1, 1, len(where))
    left = [
        np.linalg.norm(
            forward.solve(change + size * step).voltages
            - solution.voltages
            - size * jacobian @ step[where]
        )
        for size in (1.0, 0.1)
    ]
    assert left[0] / left[1] == pytest.approx(100, rel=0.1)


def test_a_pad_in_the_middle_of_a_disc_is_as_bessel_functions_say() -> None:
    """Current from a rim that is all electrodes into a pad that it meets all over.

    Under the pad u'' + u'/r = (u - U) / l^2, with l^2 the contact's ohm m^2 times the sheet's S.
    """
    radius, pad, count = 0.1, 0.02, 8
    angle = 2 * np.pi * np.arange(count) / count
    rim = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    raw = load_description("tank_disc").model_dump(by_alias=True, exclude_none=True)
    raw["electrodes"] = {
        "length_m": 2 * np.pi * radius / count - 2e-5,
        "contact_impedance_ohm_m": 0.5,
        "positions_m": [*rim.tolist(), [0.0, 0.0]],
        "pad_radius_m": pad,
    }
    raw["map"] = {"nodes_x": 61, "nodes_y": 61}
    sensor = SensorDescription.model_validate(raw)
    contact_m = sensor.electrodes.contact_impedance_ohm_m * sensor.sheet_conductance_s
    sheet = mesh_sheet(sensor)
    transfer = transfer_resistances(sensor, sheet, np.ones(sheet.mesh.t.shape[1]))
    found = transfer[:-1, :-1].mean()  # an equal current into each of the rim's, out of the pad
    reach = np.sqrt(contact_m * pad / 2)
    under = i0(pad / reach) / (pad / reach * i1(pad / reach))
    wanted = (np.log(radius / pad) + contact_m / radius + under) / (2 * np.pi)
    assert found == pytest.approx(wanted, rel=2e-3)


@pytest.mark.slow
def test_a_frame_is_nan_off_the_sheet() -> None:
    palm = load_description("palm_l")
    skin, rng = SkinSimulator(palm), np.random.default_rng(0)
    rest, pressed = skin.voltages([]), skin.voltages([Press(-0.03, 0.03, 150.0, 0.01)])
    noise_v = 1e-3 * np.sqrt(np.mean(rest[Channel.MAGNITUDE] ** 2))
    tare = rest[Channel.MAGNITUDE] + noise_v * rng.standard_normal((20, palm.measurements))
    reconstructor = Reconstructor(palm)
    reconstructor.set_reference(Reference.from_scans(tare, None))
    for volts, count in ((rest, 0), (pressed, 1)):
        frame = reconstructor.reconstruct(
            volts[Channel.MAGNITUDE] + noise_v * rng.standard_normal(palm.measurements), None
        )
        assert len(frame.contacts) == count
        for image in (frame.map, frame.pressure_kpa):
            assert image is not None
            np.testing.assert_array_equal(np.isnan(image), palm.off_sheet)
    memory = PressMemory(palm, DriftSubspace(reconstructor.sensor))
    memory.add(0.0, 600.0, frame)
    creep = memory.creep(1.0, Channel.MAGNITUDE)
    assert np.isfinite(creep).all()
    assert 0 < np.count_nonzero(creep) < 50  # where it was pressed
    [contact] = frame.contacts
    assert np.hypot(contact.x_m + 0.03, contact.y_m - 0.03) < 0.002


def test_a_fitted_press_never_leaves_the_sheet() -> None:
    palm = load_description("palm_l")
    field = PressureField.on(model(palm, 0.0025), None)
    one = np.zeros((1, COLUMNS))
    one[0, [X, Y, SIZE]] = 0.04 / UNIT_M, 0.03 / UNIT_M, np.log(0.01)  # in the notch
    bounded = field.of(one).bounded(field.of(one).join(one))
    x_m, y_m = UNIT_M * field.of(one).split(bounded)[0, [X, Y]]
    assert palm.on_sheet(np.array([x_m]), np.array([y_m])).all()
    assert np.hypot(x_m - 0.04, y_m) < 0.006  # straight down onto it

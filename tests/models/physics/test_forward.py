"""The forward model, verified: derivatives, reciprocity, independent solves, and refinement."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyeit.eit import fem, protocol  # type: ignore[import-untyped]
from pyeit.mesh import PyEITMesh  # type: ignore[import-untyped]
from tactomo_models import Artifact, SensorDescription, load_description
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.bare_sheet import scan_voltages, solve_bare_sheet, transfer_resistances
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.mesh import SheetMesh, mesh_sheet
from taylor import taylor_orders
from variants import variant

STEPS = np.array([1e-2, 1e-3, 1e-4])


@pytest.fixture(scope="module")
def sheet(small: SensorDescription) -> SheetMesh:
    return mesh_sheet(small, refinements=1)


@pytest.fixture(scope="module")
def model(small: SensorDescription, sheet: SheetMesh) -> ForwardModel:
    return ForwardModel(small, solve_bare_sheet(small, sheet))


@pytest.fixture(scope="module")
def uneven(small: SensorDescription, sheet: SheetMesh) -> ForwardModel:
    """A sheet whose conductivity differs from node to node."""
    x, y = sheet.mesh.p / small.width_m
    return ForwardModel(small, solve_bare_sheet(small, sheet, 1 + 0.2 * np.sin(9 * x + 7 * y)))


def bump(model: ForwardModel, contrast: float) -> FloatArray:
    """Smooth contact of compact support: relative conductivity change at the pressable nodes."""
    x, y = model.bare.points[:, model.bare.pressable]
    near = np.clip(1 - ((x - 0.006) ** 2 + (y + 0.004) ** 2) / 0.012**2, 0, None)
    return np.asarray(np.expm1(near * np.log(contrast)))


@pytest.mark.parametrize("contrast", [1.2, 100.0, 0.01])
def test_the_jacobian_passes_a_taylor_test(model: ForwardModel, contrast: float) -> None:
    """In the contact, beside it and far away."""
    change = bump(model, contrast)
    direction = np.random.default_rng(1).normal(size=len(change)) * (1 + change)
    slope = model.jacobian(model.solve(change), np.arange(len(change))) @ direction
    found = taylor_orders(lambda at: model.solve(at).voltages, change, slope, direction, STEPS)
    assert found == pytest.approx(2, abs=0.1)


def test_the_jacobian_of_the_bare_sheet_passes_a_taylor_test(model: ForwardModel) -> None:
    slope = model.bare_jacobian()
    direction = np.random.default_rng(2).normal(size=slope.shape[1:])
    found = taylor_orders(
        lambda at: model.solve(at).voltages, 0 * direction, slope @ direction, direction, STEPS
    )
    assert found == pytest.approx(2, abs=0.1)


def test_the_derivative_by_parameters_is_the_one_by_nodes_times_theirs(
    paper: SensorDescription, artifact: Artifact
) -> None:
    model = ForwardModel(paper, artifact.bare)
    here = model.solve(bump(model, 100.0))
    where = np.random.default_rng(4).permutation(len(artifact.bare.pressable))[:600]
    onto = np.random.default_rng(5).normal(size=(len(where), 3))
    by_nodes = model.jacobian(here, where)
    np.testing.assert_allclose(
        model.jacobian(here, where, onto), by_nodes @ onto, atol=1e-12 * np.abs(by_nodes).max()
    )


def solve_directly(model: ForwardModel, sheet: SheetMesh, change: FloatArray) -> FloatArray:
    """Voltages by an assembly and factorisation of the pressed sheet itself."""
    nodes = sheet.mesh.p.shape[1]
    bare = model.bare.conductivity
    conductivity = np.ones(nodes) if bare is None else bare.copy()
    conductivity[model.bare.pressable] += change
    by_triangle = conductivity[sheet.mesh.t].mean(axis=0)
    return scan_voltages(
        model.description, transfer_resistances(model.description, sheet, by_triangle)
    )


def test_an_uneven_sheet_leaves_no_more_to_be_solved(
    model: ForwardModel, uneven: ForwardModel
) -> None:
    change = bump(model, 2.0)
    solution = uneven.solve(change)
    np.testing.assert_array_equal(solution.rim, model.solve(change).rim)
    assert len(solution.rim) < 0.5 * len(solution.nodes)


spots = st.lists(
    st.tuples(
        st.floats(-0.03, 0.03),
        st.floats(-0.025, 0.025),
        st.floats(0.001, 0.02),
        st.floats(0, 0.9),
        st.sampled_from([0.01, 0.8, 1.3, 100.0]),
    ),
    min_size=1,
    max_size=4,
)


@given(spots)
def test_whatever_is_pressed_equals_a_solve_of_the_whole_system(
    sheet: SheetMesh, uneven: ForwardModel, spots: list[tuple[float, float, float, float, float]]
) -> None:
    """Discs and rings of sharp edge: apart, in one another, at the frame, over the whole sheet."""
    x, y = uneven.bare.points[:, uneven.bare.pressable]
    ratio = np.ones(len(x))
    for x_m, y_m, radius_m, hole, contrast in spots:
        distance = np.hypot(x - x_m, y - y_m)
        ratio[(distance < radius_m) & (distance >= hole * radius_m)] = contrast
    assert uneven.bare.conductivity is not None
    change = uneven.bare.conductivity[uneven.bare.pressable] * (ratio - 1)
    off = uneven.solve(change).voltages - solve_directly(uneven, sheet, change)
    assert np.abs(off / uneven.bare_voltages).max() < 1e-7


@pytest.mark.parametrize("exponent", [-0.9, -0.3, 0.0, 0.5, 1.0])
@pytest.mark.parametrize("contrast", [0.01, 3.0])
def test_the_jacobian_is_the_slope_however_triangles_mix(
    uneven: ForwardModel, exponent: float, contrast: float
) -> None:
    """Of an uneven sheet, up to where a press leaves it next to no conductivity."""
    x, y = uneven.bare.points[:, uneven.bare.pressable]
    where = np.flatnonzero(np.hypot(x - 0.004, y) < 0.008)
    change, aside = np.zeros((2, len(x)))
    change[where] = uneven.at_rest[where] * (contrast - 1)
    aside[where] = uneven.at_rest[where] * np.cos(300 * x[where])
    step = 1e-4 * contrast
    up, down = (uneven.solve(change + side * step * aside, exponent).voltages for side in (1, -1))
    solution = uneven.solve(change, exponent)
    slope = uneven.jacobian(solution, where, aside[where, None])[:, 0]
    np.testing.assert_allclose(slope, (up - down) / (2 * step), rtol=1e-5, atol=1e-8)


def test_what_has_no_conductivity_left_has_no_solution(model: ForwardModel) -> None:
    with pytest.raises(np.linalg.LinAlgError, match="conductivity"):
        model.solve(np.where(bump(model, 2.0) > 0, -2.0, 0.0))


def test_a_larger_sheet_leaves_as_much_to_be_solved(small: SensorDescription) -> None:
    """The same contact and nodes' distance: the same unknowns, on three times the area."""
    large = variant(
        small,
        sheet={"width_m": 0.1, "height_m": 0.09, "frame_width_m": 0.019},
        electrodes={"pitch_m": 0.03},
    )
    unknowns = []
    for sensor in (small, large):
        model = ForwardModel(sensor, solve_bare_sheet(sensor, mesh_sheet(sensor, 0.0025, 1)))
        x, y = model.bare.points[:, model.bare.pressable]
        solution = model.solve(np.where(np.hypot(x, y) < 0.0101, 99.0, 0.0))
        unknowns.append((len(solution.rim), len(solution.nodes)))
    assert unknowns[0] == unknowns[1]
    assert unknowns[0][0] < 0.5 * unknowns[0][1]


@pytest.fixture(scope="module")
def halved(small: SensorDescription) -> list[ForwardModel]:
    """One sheet at halved spacings, each electrode a whole number of edges."""
    aligned = variant(
        small, sheet={"height_m": 0.06, "frame_width_m": 0.0149}, electrodes={"pitch_m": 0.024}
    )
    return [
        ForwardModel(aligned, solve_bare_sheet(aligned, mesh_sheet(aligned, spacing_m)))
        for spacing_m in (0.003, 0.0015, 0.00075)
    ]


def test_voltages_converge_at_first_order_at_least(halved: list[ForwardModel]) -> None:
    """Differences fall by the order.

    Near an electrode's end the field goes as the root of the distance and triangles are as fine
    as they are near: halving the spacing halves the area where they are too coarse. That part is
    of first order, all else of second.
    """
    coarse, middle, fine = (each.bare_voltages for each in halved)
    order = np.log2(np.linalg.norm(coarse - middle) / np.linalg.norm(middle - fine))
    assert order > 1
    assert np.linalg.norm(middle - fine) < 2e-3 * np.linalg.norm(fine)


@pytest.mark.parametrize("contrast", [1.2, 100.0, 0.01])
def test_what_a_contact_changes_converges_at_second_order(
    halved: list[ForwardModel], contrast: float
) -> None:
    """A smooth contact, far from the electrodes' ends: linear triangles at their full order."""

    def relative_change(model: ForwardModel) -> FloatArray:
        x, y = model.bare.points[:, model.bare.pressable]
        near = np.clip(1 - ((x - 0.003) ** 2 + (y + 0.002) ** 2) / 0.0105**2, 0, None) ** 2
        pressed = model.solve(np.expm1(near * np.log(contrast))).voltages
        return np.asarray(pressed / model.bare_voltages - 1)

    coarse, middle, fine = map(relative_change, halved)
    order = np.log2(np.linalg.norm(coarse - middle) / np.linalg.norm(middle - fine))
    assert order == pytest.approx(2, abs=0.35)
    assert np.linalg.norm(middle - fine) < 0.04 * np.linalg.norm(fine)


@pytest.mark.parametrize("shape", ["rectangle", "disc"])
def test_drive_and_measurement_may_change_places(small: SensorDescription, shape: str) -> None:
    """V(k, m) of one pattern is V(m, k) of the pattern with the offsets exchanged."""
    if shape == "disc":
        small = variant(load_description("tank_disc"), map={"nodes_x": 21, "nodes_y": 21})
    sheet = mesh_sheet(small, refinements=1)
    half = small.electrode_count // 2
    by_pair = []
    for drive, measure in [(half, 1), (1, half)]:
        sensor = variant(small, pattern={"drive_offset": drive, "measure_offset": measure})
        model = ForwardModel(sensor, solve_bare_sheet(sensor, sheet))
        voltages = model.solve(bump(model, 50.0)).voltages
        pairs = zip(
            sensor.pairs.drive.tolist(), sensor.pairs.measure.tolist(), voltages, strict=True
        )
        by_pair.append({(tuple(d), tuple(m)): v for d, m, v in pairs})
    opposite, adjacent = by_pair
    assert opposite
    for (driven, measured), value in opposite.items():
        assert adjacent[measured, driven] == pytest.approx(value, rel=1e-8)


def test_a_solve_does_not_depend_on_the_one_before(model: ForwardModel) -> None:
    """What is known of an area serves again while the same triangles change, and then only."""
    changes = [bump(model, 2.0), bump(model, 50.0), bump(model, 2.0) * (bump(model, 2.0) > 0.3)]
    fresh = [ForwardModel(model.description, model.bare).solve(change) for change in changes]
    for change, alone in zip(changes, fresh, strict=True):
        after = model.solve(change)
        np.testing.assert_array_equal(after.voltages, alone.voltages)
        np.testing.assert_array_equal(after.potentials, alone.potentials)


def test_the_frame_cannot_be_pressed(paper: SensorDescription, artifact: Artifact) -> None:
    x, y = np.abs(artifact.bare.points[:, artifact.bare.pressable])
    edge = paper.width_m / 2 - paper.sheet.frame_width_m
    assert max(x.max(), y.max()) <= edge + 1e-9


def test_small_electrodes_agree_with_pyeits_point_electrodes(small: SensorDescription) -> None:
    """The same triangles, the same unit current: what is left is how large the electrodes are.

    Seen from others, an electrode of length l at a distance D is a point up to (l / D)^2: 0.1 % of
    a voltage for 1 mm at 20 mm or more. Halving l must make the two differ a quarter as much, in
    the voltages and in what a mild contact changes. No scale is fitted; pyEIT's voltages are
    V(m + 1) - V(m).
    """
    differences = []
    for length_m in (0.002, 0.001):
        sensor = variant(small, electrodes={"length_m": length_m})
        sheet = mesh_sheet(sensor, 0.0025)  # a node at the middle of every electrode
        ours = ForwardModel(sensor, solve_bare_sheet(sensor, sheet))
        points, triangles = sheet.mesh.p, sheet.mesh.t.T.copy()
        (ax, bx, cx), (ay, by, cy) = points[:, triangles.T]
        clockwise = (bx - ax) * (cy - ay) < (cx - ax) * (by - ay)
        triangles[clockwise] = triangles[clockwise, ::-1]
        distance = np.linalg.norm(points.T[:, None] - sensor.electrode_centres_m, axis=2)
        assert distance.min(axis=0).max() < 1e-9
        mesh = PyEITMesh(
            node=points.T,
            element=triangles,
            perm=np.ones(len(triangles)),
            el_pos=distance.argmin(axis=0),
            ref_node=int(np.hypot(*points).argmin()),
        )
        theirs = fem.EITForward(mesh, protocol.create(sensor.electrode_count, 1, 1, "std"))
        change = bump(ours, 1.2)
        conductivity = np.ones(points.shape[1])
        conductivity[ours.bare.pressable] += change
        bare = -theirs.solve_eit()
        pressed = -theirs.solve_eit(conductivity[triangles].mean(axis=1))
        changed = ours.solve(change).voltages / ours.bare_voltages - 1
        differences.append(
            [
                np.abs(bare / ours.bare_voltages - 1).max(),
                np.linalg.norm(pressed / bare - 1 - changed) / np.linalg.norm(changed),
            ]
        )
    larger, smaller = np.array(differences)
    assert smaller.max() < 1e-3
    assert np.log2(larger / smaller) == pytest.approx(2, abs=0.3)


@pytest.mark.parametrize("name", ["paper_square", "skin_round"])
@pytest.mark.parametrize("quick", [False, True])
def test_a_sheet_of_many_boxes_equals_a_solve_of_the_whole_system(name: str, quick: bool) -> None:
    """With the Green's function whole and in pieces; presses across boxes, and at the rim."""
    sensor = load_description(name)
    sheet = mesh_sheet(sensor, refinements=1)
    conductivity = 1 + 0.2 * np.sin(90 * sheet.mesh.p[0])
    model = ForwardModel(sensor, solve_bare_sheet(sensor, sheet, conductivity, quick=quick))
    x, y = model.bare.points[:, model.bare.pressable] / sensor.width_m
    for centre_x, centre_y, radius in ((0.0, 0.0, 0.3), (0.35, -0.3, 0.1), (-0.1, 0.2, 0.04)):
        change = 5.0 * (np.hypot(x - centre_x, y - centre_y) < radius)
        off = model.solve(change).voltages - solve_directly(model, sheet, change)
        assert np.abs(off / model.bare_voltages).max() < 1e-7

"""The forward model, verified: derivatives, reciprocity, an independent solve, and refinement."""

from __future__ import annotations

import numpy as np
import pytest
import skfem
from numpy.typing import NDArray
from tactomo_models import Artifact, SensorDescription, load_description
from tactomo_models.forward import (
    ForwardModel,
    solve_bare_sheet,
)
from tactomo_models.mesh import SheetMesh, mesh_sheet
from variants import variant

FloatArray = NDArray[np.float64]


@pytest.fixture(scope="module")
def sheet(small: SensorDescription) -> SheetMesh:
    return mesh_sheet(small, refinements=1)


@pytest.fixture(scope="module")
def model(small: SensorDescription, sheet: SheetMesh) -> ForwardModel:
    return ForwardModel(small, solve_bare_sheet(small, sheet))


def bump(model: ForwardModel, contrast: float) -> FloatArray:
    """Smooth contact of compact support: relative conductivity change at the pressable nodes."""
    x, y = model.bare.points[:, model.bare.pressable]
    near = np.clip(1 - ((x - 0.006) ** 2 + (y + 0.004) ** 2) / 0.012**2, 0, None)
    return np.asarray(np.expm1(near * np.log(contrast)))


@pytest.mark.parametrize("contrast", [1.0, 1.2, 100.0, 0.01])
def test_the_jacobian_passes_a_taylor_test(model: ForwardModel, contrast: float) -> None:
    """|V(s + e d) - V(s) - e J d| falls with e squared."""
    change = bump(model, contrast) if contrast != 1 else np.zeros(len(model.bare.pressable))
    moved = bump(model, 2.0) != 0
    direction = np.random.default_rng(1).normal(size=len(change)) * moved * (1 + change)
    here = model.solve(change, also=moved)
    where = np.flatnonzero(moved)
    slope = model.jacobian(here, where) @ direction[where]
    steps = 10.0 ** -np.arange(2, 5)
    left = [
        np.linalg.norm(model.solve(change + e * direction).voltages - here.voltages - e * slope)
        for e in steps
    ]
    orders = np.diff(np.log(left)) / np.diff(np.log(steps))
    assert orders == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize("contrast", [1.2, 100.0, 0.01])
def test_a_pressed_sheet_equals_a_solve_of_the_whole_system(
    small: SensorDescription, sheet: SheetMesh, model: ForwardModel, contrast: float
) -> None:
    """The Woodbury identity against an assembly and factorisation of the pressed sheet itself."""
    change = bump(model, contrast)
    conductivity = np.ones(sheet.mesh.p.shape[1])
    conductivity[model.bare.pressable] += change
    whole = ForwardModel(small, solve_bare_sheet(small, sheet, conductivity))
    pressed = model.solve(change).voltages
    np.testing.assert_allclose(pressed, whole.bare_voltages, rtol=1e-8)
    assert np.abs(pressed / model.bare_voltages - 1).max() > 0.01


def test_reciprocity_holds_to_rounding(model: ForwardModel, small: SensorDescription) -> None:
    pairs = small.pairs
    voltages = model.solve(bump(model, 100.0)).voltages
    by_pair = {
        (*d, *m): v
        for d, m, v in zip(pairs.drive.tolist(), pairs.measure.tolist(), voltages, strict=True)
    }
    for (a, b, c, d), value in by_pair.items():
        assert by_pair[c, d, a, b] == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize("name", ["paper_square", "tank_disc"])
def test_electrodes_have_their_length_and_the_sheet_its_area(name: str) -> None:
    description = load_description(name)
    sheet = mesh_sheet(description)
    mesh = sheet.mesh
    for facets in sheet.electrode_facets:
        ends = mesh.facets[:, facets]
        length = np.linalg.norm(mesh.p[:, ends[0]] - mesh.p[:, ends[1]], axis=0).sum()
        assert length == pytest.approx(description.electrodes.length_m, rel=2e-3)
    ones = skfem.Functional(lambda w: 1.0 + 0 * w.x[0])
    area = ones.assemble(skfem.Basis(mesh, skfem.ElementTriP1()))
    width = description.width_m
    expected = np.pi * width**2 / 4 if name == "tank_disc" else width * description.height_m
    assert area == pytest.approx(expected, rel=1e-3)


def test_voltages_converge_at_first_order_at_least(small: SensorDescription) -> None:
    """Halved spacings, each electrode a whole number of edges; differences fall by the order.

    Near an electrode's end the field goes as the root of the distance and triangles are as fine
    as they are near: halving the spacing halves the area where they are too coarse. That part is
    of first order, all else of second.
    """
    aligned = variant(
        small,
        sheet={"height_m": 0.06, "frame_width_m": 0.0149},
        electrodes={"pitch_m": 0.024},
    )
    coarse, middle, fine = (
        ForwardModel(
            aligned, solve_bare_sheet(aligned, mesh_sheet(aligned, spacing_m))
        ).bare_voltages
        for spacing_m in (0.003, 0.0015, 0.00075)
    )
    order = np.log2(np.linalg.norm(coarse - middle) / np.linalg.norm(middle - fine))
    assert order > 1
    assert np.linalg.norm(middle - fine) < 2e-3 * np.linalg.norm(fine)


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


def test_driving_the_other_way_round_turns_the_sign(small: SensorDescription) -> None:
    """With opposite drive each pair is driven twice, once in either direction."""
    half = small.electrode_count // 2
    sensor = variant(small, pattern={"drive_offset": half})
    model = ForwardModel(sensor, solve_bare_sheet(sensor, mesh_sheet(sensor, refinements=1)))
    change = bump(model, 50.0)
    solution = model.solve(change)
    there, back = np.split(solution.voltages, 2)
    np.testing.assert_allclose(there, -back, rtol=1e-12)
    J_there, J_back = np.split(model.jacobian(solution, np.flatnonzero(change)), 2)
    np.testing.assert_allclose(J_there, -J_back, rtol=1e-9, atol=1e-15)


def test_nothing_pressed_is_the_bare_sheet(model: ForwardModel) -> None:
    np.testing.assert_array_equal(
        model.solve(np.zeros(len(model.bare.pressable))).voltages, model.bare_voltages
    )


def test_the_frame_cannot_be_pressed(paper: SensorDescription, artifact: Artifact) -> None:
    x, y = np.abs(artifact.bare.points[:, artifact.bare.pressable])
    edge = paper.width_m / 2 - paper.sheet.frame_width_m
    assert max(x.max(), y.max()) <= edge + 1e-9


def test_a_thicker_sheet_gives_smaller_voltages(small: SensorDescription) -> None:
    """Twice as thick with contacts twice as good: half the volts, in the same proportions."""
    thick = variant(
        small,
        sheet={"thickness_m": 2e-4},
        electrodes={"contact_impedance_ohm_m": 5.0},
    )
    volts = []
    for sensor in (small, thick):
        model = ForwardModel(sensor, solve_bare_sheet(sensor, mesh_sheet(sensor, refinements=1)))
        volts.append(model.bare_voltages * model.volts_per_unit)
    np.testing.assert_allclose(volts[0], 2 * volts[1], rtol=1e-9)

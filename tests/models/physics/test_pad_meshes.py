"""Meshes of sheets with electrodes inside, and voltages of pads that are off their places."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import skfem
from tactomo_models import SensorDescription, load_description
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.actual_sheet import SheetEstimator
from tactomo_models.physics.bare_sheet import (
    assemble_sheet,
    scan_voltages,
    solve_bare_sheet,
    transfer_resistances,
)
from tactomo_models.physics.mesh import SheetMesh, mesh_sheet

GRID = tuple((0.024 * i - 0.036, 0.024 * j - 0.036) for j in range(4) for i in range(4))
CROSS = tuple((x, 0.0) for x in (-0.03, -0.015, 0.015, 0.03)) + tuple(
    (0.0, y) for y in (-0.03, -0.015, 0.015, 0.03)
)


def sheet_of_pads(
    shape: str, places: tuple[tuple[float, float], ...], nodes: int = 51
) -> SensorDescription:
    raw = load_description("paper_square").model_dump(by_alias=True, exclude_none=True)
    raw["sheet"] |= {"shape": shape, "width_m": 0.1, "frame_width_m": 0.0}
    raw["sheet"] |= {"height_m": 0.1} if shape == "rectangle" else {}
    if shape == "disc":
        del raw["sheet"]["height_m"]
    raw["electrodes"] = {
        "length_m": 0.005,
        "contact_impedance_ohm_m": 10.0,
        "positions_m": places,
        "pad_radius_m": 0.003,
    }
    raw["map"] = {"nodes_x": nodes, "nodes_y": nodes}
    return SensorDescription.model_validate(raw)


def voltages_of(sensor: SensorDescription, sheet: SheetMesh) -> FloatArray:
    ones = np.ones(sheet.mesh.t.shape[1])
    return scan_voltages(sensor, transfer_resistances(sensor, sheet, ones))


def error(found: FloatArray, wanted: FloatArray) -> float:
    """Of the voltages that are not next to nothing by symmetry, rms."""
    counts = np.abs(wanted) > 0.2 * np.sqrt(np.mean(wanted**2))
    return float(np.sqrt(np.mean((found / wanted - 1)[counts] ** 2)))


def test_pads_leave_a_rectangles_rim_alone() -> None:
    """Nodes of the rim were moved to the nearest ends of pads, as to those of rim electrodes."""
    sensor = sheet_of_pads("rectangle", GRID)
    sheet = mesh_sheet(sensor, refinements=2)
    rim = sheet.mesh.p[:, sheet.mesh.boundary_nodes()]
    assert np.abs(rim).max(axis=0) == pytest.approx(0.05)
    assert len(sheet.mesh.p[0]) < 2 * sensor.map.nodes_x**2
    finer = mesh_sheet(sensor, 0.001, refinements=3)
    assert error(voltages_of(sensor, sheet), voltages_of(sensor, finer)) < 5e-3


def test_pads_in_a_row_through_a_discs_middle_are_meshed() -> None:
    """Each of their ends had a node of the rim at the same angle: the system was singular."""
    sensor = sheet_of_pads("disc", CROSS, 41)
    bare = solve_bare_sheet(sensor, mesh_sheet(sensor, refinements=2), quick=True)
    assert np.isfinite(bare.transfer).all()
    finer = voltages_of(sensor, mesh_sheet(sensor, 0.001, refinements=3))
    assert error(scan_voltages(sensor, bare.transfer), finer) < 5e-3


@pytest.mark.parametrize("number", [0, 5])
def test_a_pad_that_is_moved_with_its_mesh_is_the_pad_described_there(number: int) -> None:
    """As much current leaves the sheet as enters it, however large the pad's triangles become."""
    sensor, off_m = sheet_of_pads("rectangle", GRID), 5e-4
    sheet = mesh_sheet(sensor, 0.0012, refinements=3)
    points = sheet.mesh.p.copy()
    centre = np.array(GRID[number])[:, None]
    pull = np.exp(-0.5 * ((points - centre) ** 2).sum(axis=0) / 0.0072**2)
    points[0] += off_m * pull
    moved = replace(sheet, mesh=skfem.MeshTri(points, sheet.mesh.t))
    system = assemble_sheet(sensor, moved, np.ones(sheet.mesh.t.shape[1]))
    *_, (_, _, under_last, _) = moved.pads  # through the last pad, all currents leave
    out = np.asarray(system.sum(axis=1)).ravel()
    out[np.unique(moved.mesh.t[:, under_last])] = 0.0
    assert np.abs(out).max() < 1e-9 * np.abs(system.diagonal()).max()
    x, y = GRID[number]
    there = sheet_of_pads("rectangle", (*GRID[:number], (x + off_m, y), *GRID[number + 1 :]))
    at_rest = voltages_of(sensor, sheet)
    change = voltages_of(sensor, moved) - at_rest
    wanted = voltages_of(there, mesh_sheet(there, 0.0012, refinements=3)) - at_rest
    counts = np.abs(at_rest) > 0.2 * np.sqrt(np.mean(at_rest**2))
    left = np.linalg.norm(((change - wanted) / at_rest)[counts])
    assert left < 0.15 * np.linalg.norm((wanted / at_rest)[counts])


@pytest.mark.slow
def test_a_tare_finds_pads_that_are_off_their_places() -> None:
    """Current that left a moved pad looked like no sheet at all: each skin was taken as even."""
    sensor = sheet_of_pads("rectangle", GRID)
    sheet = mesh_sheet(sensor, 0.0012, refinements=3)
    points = sheet.mesh.p.copy()
    for centre, off in zip(GRID, np.random.default_rng(0).normal(0, 5e-4, len(GRID)), strict=True):
        apart = ((sheet.mesh.p - np.array(centre)[:, None]) ** 2).sum(axis=0)
        points[0] += off * np.exp(-0.5 * apart / 0.006**2)
    moved = replace(sheet, mesh=skfem.MeshTri(points, sheet.mesh.t))
    voltages = voltages_of(sensor, moved)
    usable = np.abs(voltages) > 0.2 * np.sqrt(np.mean(voltages**2))
    even = solve_bare_sheet(sensor, mesh_sheet(sensor, refinements=2))
    found = SheetEstimator(sensor, even).estimate(voltages, usable, np.full(len(voltages), 1e-3))
    assert found is not None
    taken_as_even = scan_voltages(sensor, even.transfer)
    assert error(found.bare_voltages, voltages) < 0.1 * error(taken_as_even, voltages)

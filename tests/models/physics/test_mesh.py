"""Meshes: whatever the geometry, no triangle folds and every electrode has its length."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from tactomo_models import SensorDescription
from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.physics.mesh import SheetMesh, mesh_sheet
from tactomo_models.sensor.sheet import MAX_SHEET_M

ROUNDING = 1e-9


def sensor(sheet: dict[str, Any], electrodes: dict[str, Any], nodes: int) -> SensorDescription:
    return SensorDescription.model_validate(
        {
            "schema": 1,
            "name": "some",
            "sheet": {**sheet, "conductivity_s_m": 1.0, "thickness_m": 1e-4},
            "electrodes": {**electrodes, "contact_impedance_ohm_m": 1.0},
            "pattern": {"current_a": 1e-3},
            "map": {"nodes_x": nodes, "nodes_y": nodes + 3},
            "structure": {"conductivity_ratio": 10.0},
        }
    )


def rectangle(
    width: float, height: float, per_side: int, spread: float, share: float, nodes: int
) -> SensorDescription:
    """`spread` 1 takes the outer electrodes to the corners, `share` 1 lets neighbours touch."""
    side = min(width, height)
    pitch = spread * side / (per_side - 1 + share)
    sheet = {"shape": "rectangle", "width_m": width, "height_m": height}
    electrodes = {"per_side": per_side, "pitch_m": pitch, "length_m": share * pitch}
    return sensor(sheet, electrodes, nodes)


def disc(width: float, count: int, share: float, first_deg: float, nodes: int) -> SensorDescription:
    length = share * math.pi * width / count
    electrodes = {"count": count, "length_m": length, "first_angle_deg": first_deg}
    return sensor({"shape": "disc", "width_m": width}, electrodes, nodes)


def edge_lengths(sheet: SheetMesh, edges: IntArray) -> FloatArray:
    ends = sheet.mesh.p[:, edges[:, :2]]
    return np.asarray(np.linalg.norm(ends[..., 0] - ends[..., 1], axis=0))


def triangle_areas(sheet: SheetMesh) -> FloatArray:
    a, b, c = sheet.mesh.p[:, sheet.mesh.t].transpose(1, 0, 2)
    return np.asarray(np.abs((b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0]) / 2)


def rim_area(sheet: SheetMesh) -> float:
    """Area within the rim: a rim that is no simple polygon gives another one than its triangles."""
    x, y = sheet.mesh.p[:, sheet.mesh.boundary_nodes()]
    order = np.argsort(np.arctan2(y, x))
    x, y = x[order], y[order]
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)


def check(description: SensorDescription) -> SheetMesh:
    sheet = mesh_sheet(description, refinements=2)
    areas = triangle_areas(sheet)
    assert areas.min() > 0
    assert areas.sum() == pytest.approx(rim_area(sheet), rel=ROUNDING)  # no fold, no overlap
    taken = np.concatenate(sheet.electrode_edges)[:, :2]
    assert len({frozenset(ends) for ends in taken.tolist()}) == len(taken)
    for ends, edges in zip(description.electrode_ends_m, sheet.electrode_edges, strict=True):
        chord = math.dist(*ends)
        covered = edge_lengths(sheet, edges).sum()
        if description.sheet.shape == "rectangle":
            assert covered == pytest.approx(chord, rel=1e-6)
        else:  # the rim is a polygon: between the chord and the arc
            assert chord * (1 - 1e-6) <= covered <= description.electrodes.length_m * (1 + 1e-6)
    return sheet


sizes = st.floats(0.01, 2.0)
# Gaps down to a thousandth of the pitch, electrodes down to a hundredth.
shares = st.one_of(st.floats(0.01, 0.99), st.floats(0.99, 0.999))


@pytest.mark.slow
@settings(max_examples=8)
@given(sizes, st.floats(0.3, 3), st.integers(2, 8), st.floats(0.3, 1), shares, st.integers(11, 30))
@example(0.15, 1.0, 4, 1.0, 0.2, 16)  # the outer electrodes end on the corners
@example(0.15, 1.0, 4, 0.999, 0.2, 16)  # and a hair away from them
@example(0.3, 0.95, 8, 0.85, 0.96, 11)  # gaps of a millimetre between nodes of thirty
def test_a_rectangle_of_any_geometry(
    width: float, aspect: float, per_side: int, spread: float, share: float, nodes: int
) -> None:
    spread *= 1 - 1e-12  # the sum that the description checks may round up
    share = max(share, 20e-6 * per_side / (spread * width * min(aspect, 1)))  # none below 10 um
    assume((nodes + 2) / (nodes - 1) < 4 * aspect)  # else map nodes are too far apart one way
    description = rectangle(width, min(width * aspect, MAX_SHEET_M), per_side, spread, share, nodes)
    areas = triangle_areas(check(description))
    assert areas.sum() == pytest.approx(description.width_m * description.height_m, rel=ROUNDING)


@settings(max_examples=8)
@given(sizes, st.integers(6, 24), shares, st.floats(-360, 360), st.integers(11, 24))
def test_a_disc_of_any_geometry(
    width: float, count: int, share: float, first_deg: float, nodes: int
) -> None:
    sheet = check(disc(width, count, share, first_deg, nodes))
    rim = sheet.mesh.p[:, sheet.mesh.boundary_nodes()]
    np.testing.assert_allclose(np.hypot(*rim), width / 2, rtol=ROUNDING)
    assert triangle_areas(sheet).sum() == pytest.approx(math.pi * width**2 / 4, rel=0.05)


def test_every_map_node_of_a_rectangle_is_a_mesh_node(paper: SensorDescription) -> None:
    nodes = {(round(x, 9), round(y, 9)) for x, y in mesh_sheet(paper).mesh.p.T}
    x, y = np.meshgrid(paper.map_x_m, paper.map_y_m)
    inside = paper.on_sheet(x, y, 0.004)
    assert all(
        (round(a, 9), round(b, 9)) in nodes for a, b in zip(x[inside], y[inside], strict=True)
    )


def test_triangles_are_refined_at_electrode_ends(paper: SensorDescription) -> None:
    coarse, fine = (mesh_sheet(paper, refinements=n) for n in (0, 3))
    smallest = [
        min(edge_lengths(sheet, edges).min() for edges in sheet.electrode_edges)
        for sheet in (coarse, fine)
    ]
    assert smallest[0] == pytest.approx(8 * smallest[1])

"""The forward model, verified: derivatives, reciprocity, an independent solve, and refinement."""

from __future__ import annotations

import numpy as np
import pytest
import skfem
from numpy.typing import NDArray
from tactomo_models import SensorDescription, load_description
from tactomo_models.forward import (
    ForwardModel,
    solve_bare_sheet,
)
from tactomo_models.mesh import SheetMesh, mesh_sheet

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

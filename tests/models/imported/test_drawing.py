"""Drawings, DXF and SVG, become descriptions: in the file's unit, with electrodes and holes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from ezdxf.filemanagement import new, readfile
from tactomo_models import DataError, SensorDescription
from tactomo_models.imported.drawing import read_drawing
from tactomo_models.imported.model import describe, evenly_placed

L_SHAPE = np.array([[0, 0], [120, 0], [120, 60], [60, 60], [60, 120], [0, 120]], float)
AWAY = np.array([500.0, 300.0])
PLACES = np.array([[20, 0], [60, 0], [100, 0], [120, 30], [60, 90], [30, 120], [0, 60]], float)


def dxf(path: Path, units: int = 4, mm: float = 1.0) -> Path:
    """An L of two polylines whose ends meet, one drawn backwards, a round hole, and electrodes."""
    document = new(units=units)
    space = document.modelspace()
    shifted = (L_SHAPE + AWAY) / mm
    space.add_lwpolyline(shifted[:4])
    space.add_lwpolyline(np.vstack([shifted[3:], shifted[:1]])[::-1])
    space.add_circle((530 / mm, 330 / mm), 5 / mm)
    space.add_text("sheet 1")
    for x, y in (PLACES + AWAY) / mm:
        space.add_circle((x, y), 3 / mm, dxfattribs={"layer": "Electrodes"})
    document.saveas(path)
    return path


def svg(path: Path, size: str) -> Path:
    """The same L in SVG, whose y points down; a view box scales by two."""
    corners = " ".join(f"{2 * x},{240 - 2 * y}" for x, y in L_SHAPE)
    dots = "".join(f'<circle cx="{x}" cy="{120 - y}" r="3"/>' for x, y in PLACES)
    path.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} viewBox="0 0 240 240">'
        f'<polygon points="{corners}"/><circle cx="60" cy="180" r="10"/>'
        f'<g id="electrodes" transform="scale(2)">{dots}</g></svg>'
    )
    return path


def described(path: Path, unit_mm: float | None = None) -> SensorDescription:
    model = read_drawing(path, "electrodes", None, unit_mm)
    return describe(model, path, "palm", None)[1]


@pytest.mark.parametrize("kind", ["mm", "inches", "no unit", "svg", "svg in pixels"])
def test_a_drawing_becomes_the_sheet_that_it_shows(tmp_path: Path, kind: str) -> None:
    if kind.startswith("svg"):
        size = 'width="120mm" height="120mm"' if kind == "svg" else 'width="960" height="960"'
        path, unit_mm = svg(tmp_path / "palm.svg", size), None if kind == "svg" else 0.5
    else:
        units, mm = {"mm": (4, 1.0), "inches": (1, 25.4), "no unit": (0, 10.0)}[kind]
        path, unit_mm = dxf(tmp_path / "palm.dxf", units, mm), mm if units == 0 else None
    sensor = described(path, unit_mm)
    assert (sensor.width_m, sensor.height_m) == pytest.approx((0.12, 0.12), abs=2e-6)
    polygon = sensor.sheet.outline.polygon
    assert polygon.area == pytest.approx(0.0108 - np.pi * 0.005**2, rel=1e-3)
    np.testing.assert_allclose(polygon.interiors[0].centroid.coords[0], -0.03, atol=1e-4)
    np.testing.assert_allclose(sensor.electrode_centres_m, 1e-3 * (PLACES - 60), atol=1e-4)
    assert sensor.electrodes.length_m == pytest.approx(0.006, rel=0.02)
    if unit_mm is not None:
        with pytest.raises(DataError, match="--unit-mm"):
            described(path)


def test_electrodes_are_placed_evenly_along_an_outline(tmp_path: Path) -> None:
    path = dxf(tmp_path / "palm.dxf")
    model = evenly_placed(read_drawing(path, "electrodes"), 24)
    sensor = describe(model, path, "palm", 6.0)[1]
    assert set(np.diff(sensor.rim_order) % 24) == {1}
    assert sensor.electrode_centres_m[0][1] == pytest.approx(-0.06)
    apart = np.diff([e.middle_m for e in sensor.placed_electrodes if hasattr(e, "middle_m")])
    np.testing.assert_allclose(np.mod(apart, 0.48), 0.02, atol=1e-5)


def test_a_drawing_that_shows_no_sheet_is_refused_with_what_to_do(tmp_path: Path) -> None:
    path = dxf(tmp_path / "open.dxf")
    torn = readfile(path)
    torn.modelspace().query("LWPOLYLINE")[0].translate(1, 0, 0)
    torn.saveas(path)
    with pytest.raises(DataError, match=r"ends at .* close the outline"):
        described(path)
    torn.modelspace().add_lwpolyline([(0, 0), (900, 0), (900, 1), (0, 1)], close=True)
    with pytest.raises(DataError, match="its layers or groups are: 0, electrodes"):
        read_drawing(path, "electrodes", "cut")
    path = tmp_path / "broken.dxf"
    path.write_bytes(b"0\nSECTION\n 2\nHEADER\nx")
    with pytest.raises(DataError, match="as DXF"):
        described(path)
    path = tmp_path / "broken.svg"
    path.write_text("<svg><polygon points=")
    with pytest.raises(DataError, match="as SVG"):
        described(path)


def nested_dxf(path: Path, depth: int = 9) -> None:
    """Blocks of ten blocks each, of one square in the end."""
    document = new(units=4)
    document.blocks.new("0-").add_lwpolyline([(0, 0), (9, 0), (9, 9), (0, 9)], close=True)
    for level in range(1, depth):
        block = document.blocks.new(f"{level}-")
        for place in range(10):
            block.add_blockref(f"{level - 1}-", (place, 0))
    document.modelspace().add_blockref(f"{depth - 1}-", (0, 0))
    document.saveas(path)


def gridded_dxf(path: Path) -> None:
    """One square, in so many rows and columns."""
    document = new(units=4)
    document.blocks.new("0-").add_lwpolyline([(0, 0), (9, 0), (9, 9), (0, 9)], close=True)
    grid = {"row_count": 30_000, "column_count": 30_000, "row_spacing": 1, "column_spacing": 1}
    document.modelspace().add_blockref("0-", (0, 0), dxfattribs=grid)
    document.saveas(path)


def wide_dxf(path: Path) -> None:
    """A circle of millions of corners, if each is to be near it."""
    document = new(units=4)
    document.modelspace().add_circle((0, 0), 1e12)
    document.saveas(path)


def nested_svg(path: Path, depth: int = 9) -> None:
    """Groups that use a group ten times each."""
    groups = '<g id="0"><rect width="9" height="9"/></g>'
    for level in range(1, depth):
        groups += f'<g id="{level}">' + f'<use href="#{level - 1}"/>' * 10 + "</g>"
    path.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" width="9mm" height="9mm"><defs>{groups}</defs>'
        f'<use href="#{depth - 1}"/></svg>'
    )


def long_svg(path: Path) -> None:
    """A path without end."""
    path.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" width="9mm" height="9mm"><path d="M0 0'
        + " C1 1 2 2 3 3" * 300_000
        + '"/></svg>'
    )


def closed_svg(path: Path) -> None:
    """A path that closes again and again, for which its reader looks back over all of it."""
    path.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" width="9mm" height="9mm"><path d="M0 0'
        + "z" * 90_000
        + '"/></svg>'
    )


def used_svg(path: Path) -> None:
    """A long path, drawn many times."""
    path.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" width="9mm" height="9mm"><path id="0" d="M0 0'
        + "h1" * 40_000
        + '"/>'
        + '<use href="#0"/>' * 5_000
        + "</svg>"
    )


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("nested.dxf", nested_dxf),
        ("grid.dxf", gridded_dxf),
        ("nested.svg", nested_svg),
        ("long.svg", long_svg),
        ("closed.svg", closed_svg),
        ("used.svg", used_svg),
    ],
)
def test_a_small_file_that_draws_without_end_is_refused(
    tmp_path: Path, name: str, write: Callable[[Path], None]
) -> None:
    write(tmp_path / name)
    with pytest.raises(DataError, match="parts"):
        read_drawing(tmp_path / name, "electrodes")


def test_a_huge_circle_has_few_corners(tmp_path: Path) -> None:
    wide_dxf(tmp_path / "wide.dxf")
    model = read_drawing(tmp_path / "wide.dxf", "electrodes")
    assert len(model.polygon.exterior.coords) < 10_000


def test_lettering_beside_the_layers_asked_for_costs_nothing(tmp_path: Path) -> None:
    """300 kB of curves, as a drawing program makes of a title."""
    letter = "".join(f"c{n}.125 1.250 2.375 3.500 4.625 5.750 " for n in range(20))
    letters = "".join(f'<path d="M{n} 20 {letter}z"/>' for n in range(400))
    (tmp_path / "titled.svg").write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" width="120mm" height="80mm" viewBox="0 0 120 80">'
        f'<g id="sheet"><rect x="10" y="10" width="100" height="60"/></g><g>{letters}</g></svg>'
    )
    model = read_drawing(tmp_path / "titled.svg", "electrodes", "sheet")
    assert model.polygon.area == pytest.approx(6000, rel=1e-5)

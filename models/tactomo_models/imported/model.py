"""A sensor as another program has it, and its description."""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import shapely
from pydantic import ValidationError

from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.errors import DataError, DescriptionError, explain_all
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.sensor.pattern import ring_pairs
from tactomo_models.toml_file import parse_toml

FOLLOWED_MM: Final = 0.05  # the outline's corners are left out as long as it stays so near
MAX_CORNERS: Final = 400
NODES: Final = 1500  # of the map, on the sheet
ROUND: Final = 0.005  # an outline within this share of a circle's radius is a disc
MIN_ROUND: Final = 12  # corners of a circle


class Model(NamedTuple):
    """What another program's file says of a sensor."""

    polygon: shapely.Polygon  # in units of the file
    centres: FloatArray  # (E, 2) of the electrodes, in the order of their numbers, likewise
    sizes: FloatArray  # (E,) their lengths, 0 of points
    unit_mm: float
    pattern: Pattern | None = None


class Pattern(NamedTuple):
    """Drive and measuring pairs, each (n, 2), as in a description."""

    drive: IntArray
    measure: IntArray
    current_a: float
    note: str = ""  # what a user must know of the order of voltages


def no_unit(what: str, why: str) -> DataError:
    """Return the error for a file without a unit of length."""
    return DataError(
        f"{what} names no unit of length ({why}); give --unit-mm, the millimetres of one unit of "
        "the file: 1 for mm, 10 for cm, 25.4 for inches, 1000 for m"
    )


def evenly_placed(model: Model, count: int) -> Model:
    """Return the model with electrodes evenly along its outline, from the bottom."""
    rim = shapely.orient_polygons(model.polygon).exterior
    low = rim.interpolate(rim.project(shapely.Point(model.polygon.centroid.x, rim.bounds[1])))
    along = rim.project(low) + rim.length * np.arange(count) / count
    centres = shapely.get_coordinates(shapely.line_interpolate_point(rim, along % rim.length))
    return model._replace(centres=centres, sizes=np.zeros(count))


def describe(
    model: Model, source: Path, name: str, electrode_mm: float | None
) -> tuple[str, SensorDescription]:
    """Return a description's TOML text, and the description.

    Args:
        model: the sensor, with electrodes.
        source: the file that the model was read from, for the title and errors.
        name: the description's name.
        electrode_mm: length of an electrode, where the file has points or another length.

    Raises:
        DataError: the file's electrodes are points, and no length is given; or the outline
            encloses nothing.
        DescriptionError: there can be no such sensor; says what to change.
    """
    lengths_mm = model.sizes * model.unit_mm
    if electrode_mm is None and not (lengths_mm > 0).all():
        raise DataError(
            f"{source}: its electrodes are points; give --electrode-mm, their length along the rim"
        )
    length_mm = electrode_mm or float(np.median(lengths_mm))
    scale = 1e-3 * model.unit_mm
    low_x, low_y, high_x, high_y = model.polygon.bounds
    origin = np.array([low_x + high_x, low_y + high_y]) / 2
    moved = shapely.transform(model.polygon, lambda points: scale * (points - origin))
    polygon, spare_mm = _simplified(moved)
    if not polygon.area:
        raise DataError(
            f"{source}: its outline crosses itself or encloses nothing; draw it in the order in "
            "which one walks round the sheet"
        )
    corners = [_listed(ring.coords[:-1]) for ring in (polygon.exterior, *polygon.interiors)]
    offset = (np.min(corners[0], axis=0) + np.max(corners[0], axis=0)) / 2  # of rounding
    corners = [_listed(np.array(each) - offset) for each in corners]
    places = _listed(scale * (model.centres - origin))
    deep = shapely.distance(polygon.boundary, shapely.points(places)) > 5e-4 * length_mm
    x_mm, y_mm = 1e3 * scale * origin
    text = "\n".join(
        [
            f"# From {source.name}. Its point ({x_mm:.6g}, {y_mm:.6g}) mm is the origin here.",
            "schema = 1",
            f'name = "{name}"',
            "",
            "[sheet]",
            *_sheet(polygon, corners, spare_mm),
            "conductivity_s_m = 1.0            # a guess does: changes are relative",
            "thickness_m = 1e-4",
            "",
            "[electrodes]                      # 0 first: lead 0 of the device",
            f"length_m = {1e-3 * length_mm:.6g}",
            *(
                [f"pad_radius_m = {5e-4 * (electrode_mm or np.median(lengths_mm[deep])):.6g}"]
                if deep.any()
                else []
            ),
            "contact_impedance_ohm_m = 10.0    # per metre of electrode: a guess",
            *_rows("positions_m", places),
            "",
            "[pattern]",
            *_pattern(model.pattern, len(places)),
            "",
            "[map]",
            *_map(polygon),
            "",
            "# The response to pressure: a guess until you calibrate. See docs/your_own_sensor.md.",
            "[magnitude.response]",
            "pressure_kpa    = [0.0, 300.0]",
            "relative_change = [0.0, 2.0]",
            "",
        ]
    )
    try:
        return text, SensorDescription.model_validate(parse_toml(text))
    except ValidationError as error:
        why = "\n".join(f"{source}: {each}" for each in explain_all(error.errors()))
        wide = " x ".join(f"{1e3 * side:.4g}" for side in np.ptp(corners[0], axis=0))
        raise DescriptionError(
            f"{why}\n(the outline is {wide} mm; if this is wrong, give --unit-mm)"
        ) from error


def _simplified(polygon: shapely.Polygon) -> tuple[shapely.Polygon, float]:
    """Leave out corners; return by how many millimetres the outline may differ, too."""
    spare_mm = FOLLOWED_MM
    while True:
        simple = polygon.simplify(1e-3 * spare_mm)
        if shapely.get_num_coordinates(simple) <= MAX_CORNERS:
            return simple, spare_mm
        spare_mm *= 2


def _listed(points: FloatArray) -> list[list[float]]:
    rounded: list[list[float]] = (np.round(points, 6) + 0.0).tolist()
    return rounded


def _sheet(
    polygon: shapely.Polygon, corners: list[list[list[float]]], spare_mm: float
) -> list[str]:
    width_m, height_m = np.ptp(corners[0], axis=0)
    radius = np.hypot(*np.array(corners[0]).T)
    is_whole = len(corners) == 1
    if is_whole and len(radius) >= MIN_ROUND and np.ptp(radius) < ROUND * radius.max():
        return ['shape = "disc"', f"width_m = {2 * radius.max():.6g}"]
    if is_whole and len(corners[0]) == 4 and np.isclose(polygon.area, width_m * height_m):
        return ['shape = "rectangle"', f"width_m = {width_m:.6g}", f"height_m = {height_m:.6g}"]
    outer, *holes = corners
    return [
        'shape = "polygon"',
        f"# Within {spare_mm:g} mm of the file's outline.",
        *_rows("outline_m", outer),
        *(["holes_m = [", *("    " + str(hole) + "," for hole in holes), "]"] if holes else []),
    ]


def _rows(key: str, points: list[list[float]]) -> list[str]:
    rows = [", ".join(map(str, points[at : at + 4])) for at in range(0, len(points), 4)]
    return [f"{key} = [", *(f"    {row}," for row in rows), "]"]


def _pattern(pattern: Pattern | None, electrodes: int) -> list[str]:
    if pattern is None:
        return ["drive_offset = 1", "measure_offset = 1", "current_a = 1e-4"]
    lines = [f"# {pattern.note}"] if pattern.note else []
    drive, measure = pattern.drive, pattern.measure
    if all(_is_ring(each[:, ::-1], electrodes) for each in (drive, measure)):  # the same voltages
        drive, measure = drive[:, ::-1], measure[:, ::-1]
    for key, pairs in (("drive", drive), ("measure", measure)):
        is_ring = _is_ring(pairs, electrodes)
        step = (pairs[0, 1] - pairs[0, 0]) % electrodes
        lines += [f"{key}_offset = {step}"] if is_ring else _rows(key, pairs.tolist())
    return [*lines, f"current_a = {pattern.current_a:g}"]


def _is_ring(pairs: IntArray, electrodes: int) -> bool:
    step = int(pairs[0, 1] - pairs[0, 0]) % electrodes
    return 0 < step <= 32 and np.array_equal(pairs, ring_pairs(electrodes, step))


def _map(polygon: shapely.Polygon) -> list[str]:
    low_x, low_y, high_x, high_y = polygon.bounds
    apart = np.sqrt(polygon.area / NODES)
    return [
        f"nodes_{axis} = {int(np.clip(round(side / apart) + 1, 11, 401))}"
        for axis, side in (("x", high_x - low_x), ("y", high_y - low_y))
    ]

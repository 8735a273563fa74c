"""The outline and the electrodes of a drawing: DXF or SVG.

Closed lines are the outline and its holes. What lies on the layer of the electrodes is electrodes:
a point, or anything that has a size. SVG has groups for layers, by `id` or Inkscape's label.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple
from xml.etree.ElementTree import Element, iterparse

import numpy as np
import shapely

from tactomo_models.arrays import FloatArray
from tactomo_models.errors import DataError
from tactomo_models.foreign_file import read_regular
from tactomo_models.imported.model import Model, no_unit

MAX_BYTES: Final = 5_000_000
MAX_PARTS: Final = 20_000
"""Lines, blocks and groups, as often as they are drawn: a kilobyte may draw one a billion times."""
MAX_POINTS: Final = 200_000
MAX_MM: Final = 1e15  # from the drawing's origin: GEOS ends the process beyond numbers
PART_BYTES: Final = 50  # of an SVG path are a part: its reader is slow
CLOSED_PARTS: Final = 2  # parts of each closed line of an SVG path: its reader walks back for it
MAX_LINES: Final = 5_000
FLAT_MM: Final = 0.02  # curves become straight lines that are so near
FLAT_SHARE: Final = 1e-6  # of a line's size, likewise: nobody's sheet is that large
JOIN_MM: Final = 0.05  # ends so near are one corner
POINTS: Final = 33  # of a curve of SVG
NO_LINE: Final = {"TEXT", "MTEXT", "ATTDEF", "DIMENSION", "LEADER", "MULTILEADER", "HATCH", "IMAGE"}
PHYSICAL: Final = re.compile(r"\s*[\d.eE+-]+\s*(mm|cm|in|pt|pc|q)\s*$", re.IGNORECASE)
HREF: Final = "{http://www.w3.org/1999/xlink}href"
LABEL: Final = "{http://www.inkscape.org/namespaces/inkscape}label"


class Line(NamedTuple):
    """Points (n, 2) of a line, mm, and the names of the layers that hold the line."""

    layers: tuple[str, ...]
    points: FloatArray


def read_drawing(
    path: Path, electrodes: str, outline: str | None = None, unit_mm: float | None = None
) -> Model:
    """Read a DXF or SVG file.

    Args:
        path: the file, by its ending.
        electrodes: the layer of the electrodes, in any case.
        outline: the layer of the outline; every other layer, if None.
        unit_mm: millimetres of one unit of the file; by default the file's own unit.

    Raises:
        OSError: the file cannot be read.
        DataError: the file is damaged, names no unit, or has no closed outline.
        ImportError: ezdxf (DXF) or svgelements (SVG) is missing.
    """
    layers_wanted = None if outline is None else {outline.lower(), electrodes.lower()}

    def wanted(layers: tuple[str, ...]) -> bool:
        return layers_wanted is None or not layers_wanted.isdisjoint(layers)

    read = _dxf if path.suffix.lower() == ".dxf" else _svg
    content = read_regular(path, MAX_BYTES)
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # `_bounded` tells
            lines = list(_bounded(read(content, unit_mm, wanted)))
    except (ImportError, DataError):
        raise
    except Exception as error:  # parsers raise almost anything
        raise DataError(
            f"cannot read {path} as {path.suffix[1:].upper()}: {error}; save the drawing anew"
        ) from error
    of_electrodes = [line for line in lines if electrodes.lower() in line.layers]
    others = [line for line in lines if electrodes.lower() not in line.layers]
    if outline is not None:
        others = [line for line in others if outline.lower() in line.layers]
    if not any(len(line.points) > 1 for line in others):
        layers = sorted({layer for line in lines for layer in line.layers})
        raise DataError(
            f"{path} has no lines for an outline; its layers or groups are: "
            f"{', '.join(layers) or 'none'}"
        )
    polygon = _polygon(path, [line.points for line in others if len(line.points) > 1])
    centres, sizes = _electrodes([line.points for line in of_electrodes])
    return Model(polygon, centres, sizes, 1.0)


def _bounded(lines: Iterator[Line]) -> Iterator[Line]:
    points = 0
    for number, line in enumerate(lines):
        points += len(line.points)
        if number == MAX_PARTS or points > MAX_POINTS:
            raise _too_much()
        _check_places(line.points)
        yield line


def _check_places(points_mm: FloatArray) -> None:
    """Raise DataError where a line goes so far that GEOS ends the process, or flattens no curve."""
    if not (np.abs(points_mm) < MAX_MM).all():
        raise DataError(
            f"a line of the drawing goes beyond {MAX_MM * 1e-6:,.0f} km, or to no place at all; "
            "delete it, or give the drawing's --unit-mm"
        )


def _too_much() -> DataError:
    return DataError(
        f"the drawing has more than {MAX_PARTS} parts or {MAX_POINTS} points; name the "
        "outline's layer by --outline, or save the sheet's outline and electrodes alone"
    )


def _check_count(root: Any, below: Callable[[Any], Iterable[tuple[int, Any]]]) -> None:
    """Raise DataError where a drawing has too many parts, each counted as often as it is drawn.

    `below` gives what a part draws, and how often; what draws itself is left to the parser.
    """
    counted: dict[int, int] = {}

    def count(part: Any) -> int:
        if id(part) not in counted:
            counted[id(part)] = 0
            counted[id(part)] = 1 + sum(often * count(each) for often, each in below(part))
        return counted[id(part)]

    if count(root) > MAX_PARTS:
        raise _too_much()


def _dxf(
    content: bytes, unit_mm: float | None, wanted: Callable[[tuple[str, ...]], bool]
) -> Iterator[Line]:
    from ezdxf import disassemble, path, recover, units
    from ezdxf.enums import InsertUnits

    document, _ = recover.read(io.BytesIO(content))
    if unit_mm is None:
        if not document.units:
            raise no_unit("the drawing", "$INSUNITS is 0")
        unit_mm = units.conversion_factor(InsertUnits(document.units), InsertUnits.Millimeters)
    blocks = document.blocks

    def below(part: Any) -> Iterator[tuple[int, Any]]:
        if not hasattr(part, "dxftype"):  # a layout
            yield from ((1, entity) for entity in part)
            return
        key = "name" if part.dxftype() == "INSERT" else "geometry"  # of a dimension
        name = part.dxf.get(key) if part.dxf.is_supported(key) else None
        if name and name in blocks:
            yield getattr(part, "mcount", 1), blocks.get(name)

    _check_count(document.modelspace(), below)
    for entity in document.modelspace():
        if entity.dxftype() in NO_LINE:
            continue
        layer = (str(entity.dxf.layer).lower(),)
        if not wanted(layer):
            yield Line(layer, np.zeros((0, 2)))
            continue
        for part in disassemble.recursive_decompose([entity]):
            if part.dxftype() == "POINT":
                yield Line(layer, unit_mm * np.array([part.dxf.location[:2]]))
                continue
            try:
                drawn = path.make_path(part)
            except TypeError:  # no line, such as a text of a block
                continue
            for sub in drawn.sub_paths():
                corners = np.array([tuple(point) for point in sub.control_vertices()])
                _check_places(unit_mm * corners)
                size = np.ptp(corners, axis=0).max()
                flat = max(FLAT_MM / unit_mm, FLAT_SHARE * size)
                points = np.array([(p.x, p.y) for p in sub.flattening(flat)])
                yield Line(layer, unit_mm * points)


def _svg(
    content: bytes, unit_mm: float | None, wanted: Callable[[tuple[str, ...]], bool]
) -> Iterator[Line]:
    import svgelements

    _check_svg(content)
    drawing = svgelements.SVG.parse(io.BytesIO(content), reify=True, ppi=96)
    if unit_mm is not None:  # of the drawing's own coordinates, which a view box scales
        own = drawing.viewbox.width if drawing.viewbox is not None else None
        unit_mm = unit_mm * own / drawing.width if own else unit_mm
    elif not PHYSICAL.match(str(drawing.values.get("width", ""))):
        raise no_unit("the drawing", "its width is not in mm, cm or in")
    scale = np.array([1.0, -1.0]) * (unit_mm or 25.4 / 96)  # y points down

    def walk(group: Any, layers: tuple[str, ...]) -> Iterator[Line]:
        for element in group:
            names = (element.values.get("id"), element.values.get(LABEL))
            inside = tuple({*layers, *(str(name).lower() for name in names if name)})
            if isinstance(element, svgelements.Group):
                yield from walk(element, inside)
            elif isinstance(element, svgelements.Shape) and not wanted(inside):
                yield Line(inside, np.zeros((0, 2)))
            elif isinstance(element, svgelements.Shape):
                for sub in svgelements.Path(element).as_subpaths():
                    segments = svgelements.Path(sub)
                    if len(segments) > MAX_POINTS / POINTS:  # before its curves are drawn
                        raise _too_much()
                    points = [_along(segment) for segment in segments]
                    yield Line(inside, scale * np.concatenate([np.zeros((0, 2)), *points]))

    yield from walk(drawing, ())


def _check_svg(content: bytes) -> None:
    """Raise DataError where an SVG file draws too much, before anything of it is drawn."""
    held: dict[str, Element] = {}
    stretch = Element("stretch")  # of a path
    elements: list[Element] = []
    for _, element in iterparse(io.BytesIO(content), ("start",)):
        elements.append(element)
        if len(elements) > MAX_PARTS:
            raise _too_much()
        held[f"#{element.get('id')}"] = element

    def below(part: Element) -> Iterator[tuple[int, Element]]:
        yield from ((1, each) for each in part)
        path = part.get("d", "")
        yield len(path) // PART_BYTES + CLOSED_PARTS * path.lower().count("z"), stretch
        used = held.get(part.get(HREF, part.get("href", "")))
        if part.tag.endswith("use") and used is not None:
            yield 1, used

    _check_count(elements[0], below)


def _along(segment: Any) -> FloatArray:
    if type(segment).__name__ == "Move" or segment.start is None:
        return np.zeros((0, 2))
    straight = type(segment).__name__ in ("Line", "Close")
    places = np.linspace(0, 1, 2 if straight else POINTS)
    return np.array([(p.x, p.y) for p in map(segment.point, places)])


def _polygon(path: Path, lines: list[FloatArray]) -> shapely.Polygon:
    rings = sorted(map(shapely.Polygon, _rings(path, lines)), key=lambda ring: -ring.area)
    outer, *holes = rings
    for hole in holes:
        if not outer.intersects(hole):
            x, y = hole.bounds[:2]
            raise DataError(
                f"{path}: a closed line at ({x:.4g}, {y:.4g}) mm lies beside the largest one; put "
                "the sheet's outline and holes on a layer of their own, and name it by --outline"
            )
    return shapely.Polygon(outer.exterior, [hole.exterior for hole in holes])


def _rings(path: Path, lines: list[FloatArray]) -> Iterator[FloatArray]:
    """Join lines end to end to closed ones."""
    if len(lines) > MAX_LINES:
        raise DataError(
            f"{path} has {len(lines)} lines, and up to {MAX_LINES} are read; put the outline on a "
            "layer of its own, and name it by --outline"
        )
    pool = [line for line in lines if np.ptp(line, axis=0).max() > JOIN_MM]
    while pool:
        line = pool.pop(0)
        while len(line) < 3 or np.hypot(*(line[0] - line[-1])) > JOIN_MM:
            ends = np.array([[each[0], each[-1]] for each in pool]).reshape(-1, 2)
            apart = np.hypot(*(ends - line[-1]).T)
            if not len(apart) or apart.min() > JOIN_MM:
                x, y = line[-1]
                raise DataError(
                    f"{path}: a line ends at ({x:.4g}, {y:.4g}) mm, where no other begins (within "
                    f"{JOIN_MM} mm); close the outline in the drawing, or put lines that are no "
                    "outline on another layer and name the outline's by --outline"
                )
            nearest = int(apart.argmin())
            following = pool.pop(nearest // 2)
            line = np.concatenate([line, (following[::-1] if nearest % 2 else following)[1:]])
        yield line


def _electrodes(lines: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Middles (E, 2) and lengths (E,) of electrodes, in the order of the file; 0 of points."""
    shapes = [
        shapely.LineString(line) if len(line) > 1 else shapely.Point(line[0])
        for line in lines
        if len(line)
    ]
    parts = shapely.get_parts(shapely.union_all([each.buffer(JOIN_MM / 2) for each in shapes]))
    first = [int(np.argmax(shapely.intersects(part, shapes))) for part in parts]
    centres, sizes = np.zeros((len(parts), 2)), np.zeros(len(parts))
    for row, which in enumerate(np.argsort(first)):
        box = np.array(shapely.oriented_envelope(parts[which]).exterior.coords)
        centres[row] = (box[0] + box[2]) / 2
        length = max(np.hypot(*(box[1] - box[0])), np.hypot(*(box[2] - box[1]))) - JOIN_MM
        sizes[row] = length if length > JOIN_MM else 0.0
    return centres, sizes

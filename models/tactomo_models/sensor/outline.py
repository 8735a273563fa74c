"""The outline of a sheet: how deep a place lies inside, and what places lie along the rim.

A place on the rim is a ring and a distance along that ring, counter-clockwise on the outer one. A
rectangle is a polygon of four corners; a disc is a circle, not the polygon that is drawn for one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import shapely

from tactomo_models.arrays import FloatArray, IntArray

DRAWN_CORNERS = 96  # of a disc, where it is drawn
MAX_POINTS = 1000  # of an outline with its holes


class Outline:
    """A polygon with holes.

    Args:
        polygon: valid, counter-clockwise, metres; its holes are clockwise.
    """

    def __init__(self, polygon: shapely.Polygon) -> None:
        self.polygon = polygon
        self._rings = [polygon.exterior, *polygon.interiors]

    @cached_property
    def lengths_m(self) -> FloatArray:
        """Length of each ring, the outer one first, (R,)."""
        return np.array([ring.length for ring in self._rings])

    def depth(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """Distance of places from the rim, metres, negative off the sheet."""
        points = shapely.points(x_m, y_m)
        distance = shapely.distance(self.polygon.boundary, points)
        shapely.prepare(self.polygon)
        return np.asarray(np.where(shapely.intersects(self.polygon, points), distance, -distance))

    def at(self, ring: int, along_m: FloatArray) -> FloatArray:
        """Places (..., 2) so far along a ring."""
        along_m = np.mod(along_m, self.lengths_m[ring])
        return np.asarray(
            shapely.get_coordinates(
                shapely.line_interpolate_point(self._rings[ring], along_m)
            ).reshape(*np.shape(along_m), 2)
        )

    def locate(self, places_m: FloatArray) -> tuple[IntArray, FloatArray]:
        """The nearest place on the rim to each of the places (n, 2): ring and distance along it."""
        points = shapely.points(places_m)
        distance = np.stack([shapely.distance(ring, points) for ring in self._rings])
        ring = distance.argmin(axis=0)
        along = [shapely.line_locate_point(each, points) for each in self._rings]
        return ring, np.stack(along)[ring, np.arange(len(ring))]

    def inward_corners(self, least_deg: float) -> FloatArray:
        """Corners (n, 2) that point into the sheet, which has more than that angle there."""
        found = [np.zeros((0, 2))]
        for ring in self.drawn():
            ahead = np.roll(ring, -1, axis=0) - ring
            turn = np.angle((ahead @ [1, 1j]) / (np.roll(ahead, 1, axis=0) @ [1, 1j]), deg=True)
            found.append(ring[turn < 180 - least_deg])
        return np.concatenate(found)

    def drawn(self, inset_m: float = 0.0) -> list[FloatArray]:
        """Corners (n, 2) of each ring of the outline, so far inside: to draw, the first not again.

        Where that cuts the sheet in two, the rings of both.
        """
        inner = self.polygon.buffer(-inset_m, join_style="mitre") if inset_m else self.polygon
        parts = [part for part in shapely.get_parts(inner) if not part.is_empty]
        rings = [ring for part in parts for ring in (part.exterior, *part.interiors)]
        return [np.asarray(ring.coords)[:-1] for ring in rings]


class Circle(Outline):
    """A disc of which the polygon is but a drawing."""

    def __init__(self, radius_m: float) -> None:
        self.radius_m = radius_m
        angle = 2 * np.pi * np.arange(DRAWN_CORNERS) / DRAWN_CORNERS
        super().__init__(
            shapely.Polygon(radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        )

    @cached_property
    def lengths_m(self) -> FloatArray:
        """Its circumference, (1,)."""
        return np.array([2 * np.pi * self.radius_m])

    def depth(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """Distance of places from the rim, metres, negative off the sheet."""
        return np.asarray(self.radius_m - np.hypot(x_m, y_m))

    def at(self, ring: int, along_m: FloatArray) -> FloatArray:
        """Places (..., 2) so far along the circle, from angle 0."""
        angle = along_m / self.radius_m
        return np.asarray(self.radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1))

    def locate(self, places_m: FloatArray) -> tuple[IntArray, FloatArray]:
        """The circle, and how far along it each of the places (n, 2) is."""
        along = self.radius_m * (np.arctan2(places_m[:, 1], places_m[:, 0]) % (2 * np.pi))
        return np.zeros(len(along), np.intp), np.asarray(along)


def rectangle_outline(width_m: float, height_m: float) -> Outline:
    """The outline of a rectangle, which begins at its lower left corner."""
    w, h = width_m / 2, height_m / 2
    return Outline(shapely.Polygon([(-w, -h), (w, -h), (w, h), (-w, h)]))


def polygon_outline(
    outline_m: tuple[tuple[float, float], ...], holes_m: tuple[tuple[tuple[float, float], ...], ...]
) -> Outline:
    """The outline of a polygon, either way round.

    Raises ValueError, with what to change, where it is none of one piece about the origin.
    """
    count = len(outline_m) + sum(map(len, holes_m))
    if count > MAX_POINTS:
        raise ValueError(
            f"outline_m and holes_m have {count} points, more than {MAX_POINTS}: leave out those "
            "that lie within a tenth of a millimetre of the line through their neighbours "
            "(shapely's simplify does)"
        )
    shell = _simple("outline_m", outline_m)
    rest: shapely.Geometry = shell
    for number, corners in enumerate(holes_m):
        key = f"holes_m[{number}]"
        hole = _simple(key, corners)
        if not shell.intersects(hole):
            raise ValueError(f"{key} lies outside outline_m: leave it out, or move it")
        if not rest.contains_properly(hole):
            after = rest.difference(hole)
            if after.is_empty:
                raise ValueError(f"{key} covers the whole sheet: check its lengths")
            if len(shapely.get_parts(after)) > 1:
                raise ValueError(
                    f"{key} cuts the sheet in two, and no current crosses it: describe each part "
                    "as a sensor of its own"
                )
            raise ValueError(
                f"{key} touches outline_m or another hole: draw both as one line, round the outside"
            )
        rest = rest.difference(hole)
    low_x, low_y, high_x, high_y = shell.bounds
    off = (low_x + high_x) / 2, (low_y + high_y) / 2
    if max(map(abs, off)) > 1e-6:  # a micrometre
        raise ValueError(
            f"outline_m: the middle of its bounding box is {off[0]:.6g}, {off[1]:.6g}, and places "
            "are counted from there: subtract these from all of outline_m, holes_m and positions_m"
        )
    assert isinstance(rest, shapely.Polygon)
    return Outline(shapely.orient_polygons(rest))


def uncrossed(key: str, corners: tuple[tuple[float, float], ...]) -> shapely.Polygon:
    """The polygon of corners.

    Raises ValueError where it crosses or touches itself.
    """
    ring = shapely.Polygon(corners)
    if not ring.is_valid:
        why = shapely.is_valid_reason(ring)
        at = why[why.find("[") + 1 : -1].replace(" ", ", ") if "[" in why else ""
        raise ValueError(
            f"{key} crosses or touches itself{f' at {at}' if at else ''}: give its corners in the "
            "order in which one walks round, each once"
        )
    return ring


def _simple(key: str, corners: tuple[tuple[float, float], ...]) -> shapely.Polygon:
    closed = corners[:-1] if len(corners) > 3 and corners[0] == corners[-1] else corners
    for number, (before, corner) in enumerate(pairwise(closed), start=1):
        if corner == before:
            raise ValueError(
                f"{key}[{number}] is the corner before it once more: give each corner once"
            )
    ring = uncrossed(key, closed)
    if len(closed) < 3 or ring.area < 1e-10:
        raise ValueError(f"{key} encloses no area: give three corners or more, in metres")
    sharp = _sharpest(np.array(closed))
    if sharp[0] < MIN_ANGLE_DEG:
        raise ValueError(
            f"{key}[{sharp[1]}] is a corner of {sharp[0]:.3g} degrees, sharper than "
            f"{MIN_ANGLE_DEG:g}: cut its tip off"
        )
    return ring


# Triangles at a corner are as sharp as that corner: their stiffness grows as the cotangent.
MIN_ANGLE_DEG = 10.0


def _sharpest(corners: FloatArray) -> tuple[float, int]:
    """The sharpest corner's angle in degrees, and which corner that is."""
    before, after = np.roll(corners, 1, axis=0) - corners, np.roll(corners, -1, axis=0) - corners
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    angle = np.degrees(np.arctan2(np.abs(cross), (before * after).sum(axis=1)))
    return float(angle.min()), int(angle.argmin())


@dataclass(frozen=True)
class RimElectrode:
    """An electrode along the rim."""

    ring: int  # 0 the outer one
    middle_m: float  # along that ring
    length_m: float

    def ends_m(self) -> FloatArray:
        """Where it begins and ends, along its ring, (2,)."""
        return self.middle_m + np.array([-0.5, 0.5]) * self.length_m


@dataclass(frozen=True)
class Pad:
    """A round electrode inside."""

    centre_m: tuple[float, float]
    radius_m: float

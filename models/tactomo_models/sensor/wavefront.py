"""A surface of triangles from a Wavefront OBJ file, with a place on the sheet for each corner.

Source: Wavefront, Object Files (.obj), specification version 3.0: `v`, `vt` and `f` alone are read.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import shapely

from tactomo_models.arrays import FloatArray, IntArray

MAX_TRIANGLES: Final = 10_000
LARGEST: Final = 1e6  # of a coordinate: a kilometre in millimetres; beyond, products overflow
ON_EDGE: Final = 1e-6
"""In barycentric coordinates: what is nearer to an edge is on either side of it."""
ROUND: Final = float(np.cos(np.radians(15)))
"""Cosine of the largest angle from a triangle's own normal to its corner's mean, up to which the
triangles there stand for a round surface; beyond, they meet in a fold and each is flat."""


@dataclass(frozen=True)
class Triangles:
    """Triangles in space and, corner by corner, on the sheet."""

    corners_m: FloatArray  # (T, 3, 3) points
    sheet_m: FloatArray  # (T, 3, 2) places on the sheet
    normals: FloatArray  # (T, 3, 3) unit normals at the corners, out of the pressed side

    @cached_property
    def _to_barycentric(self) -> FloatArray:
        """(T, 2, 2): by this from a place, less the first corner's, to two coordinates."""
        return np.asarray(np.linalg.inv(_edges(self.sheet_m)), float)

    @cached_property
    def stretches(self) -> FloatArray:
        """How many times as long as on the sheet each triangle is: (T, 2), least and most."""
        return np.asarray(np.linalg.svd(self._slopes, compute_uv=False)[:, ::-1], float)

    @cached_property
    def _slopes(self) -> FloatArray:
        """(T, 3, 2): by how much a point moves with its place on the sheet."""
        return _edges(self.corners_m) @ self._to_barycentric

    @cached_property
    def _tree(self) -> shapely.STRtree:
        return shapely.STRtree(shapely.polygons(self.sheet_m))

    @property
    def sheet_extent_m(self) -> tuple[FloatArray, FloatArray]:
        """The lowest and the highest place on the sheet, each (2,)."""
        return self.sheet_m.min(axis=(0, 1)), self.sheet_m.max(axis=(0, 1))

    def covering(self, xy_m: FloatArray) -> tuple[IntArray, IntArray]:
        """Which triangle is at each place (N,), or is the nearest, and how many are there (N,)."""
        points = shapely.points(xy_m)
        triangle = np.asarray(self._tree.nearest(points), np.intp)
        near_m = ON_EDGE * float(np.linalg.norm(_edges(self.sheet_m), axis=1).max())
        place, found = self._tree.query(points, "dwithin", near_m)
        least = self._barycentric(xy_m[place], found).min(axis=1)
        deepest_last = np.argsort(least)
        triangle[place[deepest_last]] = found[deepest_last]
        inside, near = (
            np.bincount(place[least > depth], minlength=len(xy_m)) for depth in (ON_EDGE, -ON_EDGE)
        )
        return triangle, np.maximum(inside, near > 0)

    def place(self, xy_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points and normals, each (N, 3), of places (N, 2) on the sheet."""
        triangle, _ = self.covering(xy_m)
        weights = self._barycentric(xy_m, triangle)
        points = np.einsum("nk,nkd->nd", weights, self.corners_m[triangle])
        normals = np.einsum("nk,nkd->nd", weights, self.normals[triangle])
        return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def stretch_of(self, xy_m: FloatArray) -> FloatArray:
        """How a surface stretches n pieces of the sheet, by k places (n, k, 2) on each: (n, 2, 2).

        The symmetric root of the mean metric there: what is this times a vector on the sheet is as
        long as that vector is on the surface.
        """
        triangle, _ = self.covering(xy_m.reshape(-1, 2))
        slope = self._slopes[triangle].reshape(*xy_m.shape[:2], 3, 2)
        squares, axes = np.linalg.eigh((slope.swapaxes(2, 3) @ slope).mean(axis=1))
        return np.asarray((axes * np.sqrt(squares)[:, None]) @ axes.swapaxes(1, 2))

    def unplace(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places on the sheet (N, 2) below points (N, 3), and how far above it those are (N,)."""
        to_barycentric = np.linalg.pinv(_edges(self.corners_m))  # (T, 2, 3)
        places, heights = np.zeros((len(points_m), 2)), np.zeros(len(points_m))
        for row, point in enumerate(points_m):
            two = np.einsum("tij,tj->ti", to_barycentric, point - self.corners_m[:, 0])
            weights = np.maximum(np.column_stack([1 - two.sum(axis=1), two]), 0.0)
            weights /= weights.sum(axis=1, keepdims=True)
            foot = np.einsum("tk,tkd->td", weights, self.corners_m)
            nearest = int(np.linalg.norm(point - foot, axis=1).argmin())
            places[row] = weights[nearest] @ self.sheet_m[nearest]
            heights[row] = (point - foot[nearest]) @ (weights[nearest] @ self.normals[nearest])
        return places, heights

    def _barycentric(self, xy_m: FloatArray, triangle: IntArray) -> FloatArray:
        """Coordinates (N, 3) of places (N, 2), each in a triangle of its own."""
        off = xy_m - self.sheet_m[triangle, 0]
        two = np.einsum("nij,nj->ni", self._to_barycentric[triangle], off)
        return np.column_stack([1 - two.sum(axis=1), two])


def _edges(corners: FloatArray) -> FloatArray:
    """Two edges of each triangle as columns, (T, D, 2)."""
    return np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=-1)


def read_obj(text: str, name: str) -> Triangles:
    """Return the triangles of an OBJ file's text; polygons are cut into fans.

    Raises ValueError where it has no triangles, or one without texture coordinates, or without an
    area in space or on the sheet; says where, and what to do.
    """
    points: list[list[float]] = []
    places: list[list[float]] = []
    faces: list[tuple[list[int], list[int]]] = []
    for number, line in enumerate(text.splitlines(), 1):
        kind, *words = line.partition("#")[0].split() or [""]
        try:
            if kind == "v":
                points.append(_numbers(words, 3))
            elif kind == "vt":
                places.append(_numbers(words, 2))
            elif kind == "f":
                corners = [_corner(word, len(points), len(places)) for word in words]
                faces += [
                    (list(of_point), list(of_place))
                    for of_point, of_place in (
                        zip(corners[0], corners[at], corners[at + 1], strict=True)
                        for at in range(1, len(corners) - 1)
                    )
                ]
        except _NoTextureError:
            raise ValueError(
                f"{name}, line {number}: a face without texture coordinates: {line[:60]!r}; export "
                "the surface with UVs (f v/vt ...), whose vt are places on the sheet in metres"
            ) from None
        except (ValueError, IndexError):
            raise ValueError(
                f"{name}, line {number}: not OBJ: {line[:60]!r}; give finite numbers, and faces of "
                "vertices that come before them"
            ) from None
        if len(faces) > MAX_TRIANGLES:
            raise ValueError(
                f"{name}: more than {MAX_TRIANGLES} triangles; export the surface more coarsely"
            )
    if not faces:
        raise ValueError(f"{name}: no faces (f); export the surface's triangles as OBJ")
    of_points, of_places = (np.array(each) for each in zip(*faces, strict=True))
    return _triangles(np.array(points), of_points, np.array(places)[of_places], name)


def _triangles(points: FloatArray, of_points: IntArray, sheet: FloatArray, name: str) -> Triangles:
    corners = points[of_points]
    across = _edges(sheet)
    turn = np.linalg.det(across)
    spanned = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = (np.abs(turn) < 1e-15) | (np.linalg.norm(spanned, axis=1) < 1e-15)
    if flat.any():
        x, y, z = corners[flat][0].mean(axis=0)
        raise ValueError(
            f"{name}: the triangle at ({x:.4g}, {y:.4g}, {z:.4g}) has no area, there or on the "
            "sheet; merge its corners, or unwrap it"
        )
    # By the sheet's own x and y, not by the order of corners, which exporters turn at will.
    outward = spanned * np.sign(turn)[:, None]
    at_points = np.zeros_like(points)
    for corner in range(3):
        np.add.at(at_points, of_points[:, corner], outward)
    lengths = np.linalg.norm(at_points, axis=1, keepdims=True)
    normals = np.divide(at_points, lengths, out=np.zeros_like(points), where=lengths > 0)[of_points]
    own = (outward / np.linalg.norm(outward, axis=1, keepdims=True))[:, None]
    least = np.ones(len(points))
    np.minimum.at(least, of_points, (normals * own).sum(axis=2))
    is_round = least[of_points][..., None] >= ROUND
    return Triangles(corners, sheet, np.where(is_round, normals, own))


class _NoTextureError(Exception):
    """A corner has no texture coordinate."""


def _numbers(words: list[str], count: int) -> list[float]:
    values = [float(word) for word in words[:count]]
    if len(values) < count or not (np.abs(values) < LARGEST).all():
        raise ValueError
    return values


def _corner(word: str, points: int, places: int) -> tuple[int, int]:
    """Return the indices of a corner's vertex and place; negative ones count from the last."""
    parts = word.split("/")
    if len(parts) < 2 or not parts[1]:
        raise _NoTextureError
    of_point, of_place = (
        number - 1 if number > 0 else count + number
        for number, count in ((int(parts[0]), points), (int(parts[1]), places))
    )
    if not (0 <= of_point < points and 0 <= of_place < places):
        raise IndexError
    return of_point, of_place

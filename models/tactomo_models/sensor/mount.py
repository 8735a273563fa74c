"""Where a sheet lies on a robot: from a place on the sheet to a point and a normal on a link.

A plane, a cylinder or a surface of triangles carries the sheet. A sheet that is bent without being
stretched conducts as the flat one does: the physics stays the flat sheet's, and the places change.
On a surface that stretches it, lengths and areas are the surface's.
Points are metres in the link's frame; the normal points out of the pressed side.
"""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Final, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from tactomo_models.arrays import FloatArray
from tactomo_models.sensor.section import Section, spelt
from tactomo_models.sensor.sheet import Metres
from tactomo_models.sensor.wavefront import Triangles, read_obj

Vector = Annotated[tuple[float, float, float], Field(strict=False)]
Coordinate = Annotated[float, Field(ge=-10, le=10)]
Point = Annotated[tuple[Coordinate, Coordinate, Coordinate], Field(strict=False)]
Quaternion = Annotated[tuple[float, float, float, float], Field(strict=False)]

UNIT_TOLERANCE: Final = 1e-3  # of a unit vector's length: three decimals are enough
NEARLY_FLAT: Final = 0.01
"""By which a surface may stretch or shrink the sheet, and the sheet still counts as bent alone:
places are then wrong by 0.1 to 0.2 mm."""
MAX_STRETCH: Final = 2.0
"""Times by which a surface may stretch or shrink the sheet: the mesh is even on the flat one."""
CHECKED_PLACES: Final = 500  # of the sheet: as many as take 0.1 s on 2,000 triangles
MILLIMETRES: Final = 100.0  # lengths so many times too long are in another unit


def _unit(key: str, given: tuple[float, ...]) -> FloatArray:
    """Return a unit vector as it was meant; raise ValueError where its length is not 1."""
    vector = np.array(given)
    length = float(np.linalg.norm(vector))
    if abs(length - 1) > UNIT_TOLERANCE:
        hint = "it has no direction" if length == 0 else f"use {_told(vector / length)}"
        raise ValueError(f"{key} = {list(given)}: its length is {length:.4g} and must be 1; {hint}")
    return np.asarray(vector / length)


def _told(vector: FloatArray) -> str:
    return f"[{', '.join(f'{value + 0.0:.4f}' for value in vector)}]"


class PlaneMount(Section):
    """A flat sheet: where its middle is, and how it is turned (x, y, z, w)."""

    position_m: Point = (0.0, 0.0, 0.0)
    quaternion: Quaternion = (0.0, 0.0, 0.0, 1.0)

    @model_validator(mode="after")
    def _is_turned(self) -> Self:
        _unit("quaternion", self.quaternion)
        return self

    @cached_property
    def axes(self) -> FloatArray:
        """The sheet's x, y and normal in the link's frame: the rows of (3, 3)."""
        x, y, z, w = _unit("quaternion", self.quaternion)
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)],
                [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)],
                [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)],
            ]
        )

    def check(self, size_m: tuple[float, float], nodes_m: FloatArray) -> None:
        """Every sheet lies flat."""

    def place(self, xy_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points and normals, each (N, 3), of places (N, 2) on the sheet."""
        points = np.array(self.position_m) + xy_m @ self.axes[:2]
        return points, np.broadcast_to(self.axes[2], points.shape)

    def unplace(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places on the sheet (N, 2) below points (N, 3), and how far above it those are (N,)."""
        within = (points_m - np.array(self.position_m)) @ self.axes.T
        return within[:, :2], within[:, 2]


class CylinderMount(Section):
    """A sheet around a cylinder, pressed from outside.

    `position_m` is on the axis, level with the sheet's middle. `seam` points from the axis to where
    the sheet's ends meet or would meet: the sheet's middle is opposite. The direction `along` of
    the sheet runs along the axis, the other one around it.
    """

    radius_m: Metres
    position_m: Point = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)
    seam: Vector = (-1.0, 0.0, 0.0)
    along: Literal["x", "y"] = "y"

    @model_validator(mode="after")
    def _seam_is_across(self) -> Self:
        axis, seam = _unit("axis", self.axis), _unit("seam", self.seam)
        if abs(cosine := float(axis @ seam)) > UNIT_TOLERANCE:
            across = seam - cosine * axis
            length = float(np.linalg.norm(across))
            hint = f"use {_told(across / length)}" if length > UNIT_TOLERANCE else "turn it"
            raise ValueError(
                f"seam = {list(self.seam)}: must be at a right angle to the axis; {hint}"
            )
        return self

    @cached_property
    def _axes(self) -> FloatArray:
        """Outwards at the sheet's middle, around the axis there, and along it: rows of (3, 3)."""
        axis = _unit("axis", self.axis)
        out = -_unit("seam", self.seam)
        out -= (out @ axis) * axis
        out /= np.linalg.norm(out)
        around = np.cross(axis, out) if self.along == "y" else np.cross(out, axis)
        return np.array([out, around, axis])

    def check(self, size_m: tuple[float, float], nodes_m: FloatArray) -> None:
        """Raise ValueError where the sheet goes round more than once."""
        around_m, key = (size_m[0], "width_m") if self.along == "y" else (size_m[1], "height_m")
        girth_m = 2 * np.pi * self.radius_m
        if around_m > girth_m * (1 + 1e-9):
            raise ValueError(
                f"mount.cylinder.radius_m = {self.radius_m}: the sheet's {key} of {around_m:g} m "
                f"goes round its {girth_m:.4g} m {around_m / girth_m:.3g} times; the radius must "
                f"be {around_m / (2 * np.pi):.4g} m at least, or turn the sheet by along = "
                f'"{"x" if self.along == "y" else "y"}"'
            )

    def place(self, xy_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points and normals, each (N, 3), of places (N, 2) on the sheet."""
        around_m, along_m = xy_m.T if self.along == "y" else xy_m.T[::-1]
        angle = (around_m / self.radius_m)[:, None]
        out, around, axis = self._axes
        normals = np.cos(angle) * out + np.sin(angle) * around
        along = along_m[:, None] * axis
        return np.array(self.position_m) + along + self.radius_m * normals, normals

    def unplace(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places on the sheet (N, 2) below points (N, 3), and how far above it those are (N,)."""
        out, around, along_m = ((points_m - np.array(self.position_m)) @ self._axes.T).T
        around_m = self.radius_m * np.arctan2(around, out)
        ordered = (around_m, along_m) if self.along == "y" else (along_m, around_m)
        return np.stack(ordered, axis=-1), np.hypot(out, around) - self.radius_m


class SurfaceMount(Section):
    """A sheet on a surface of triangles, whose texture coordinates are places on the sheet.

    `file` is Wavefront OBJ, beside the description; `obj` is its text, which recordings carry.
    """

    file: str = ""
    obj: str = ""

    @model_validator(mode="after")
    def _can_be_read(self) -> Self:
        if not self.obj:
            raise ValueError("file is missing: name an OBJ file that has texture coordinates")
        _ = self.triangles
        return self

    @cached_property
    def triangles(self) -> Triangles:
        """The surface's triangles; raises ValueError where the text has none of use."""
        return read_obj(self.obj, self.file or "obj")

    def check(self, size_m: tuple[float, float], nodes_m: FloatArray) -> None:
        """Raise ValueError where the surface is no place for the sheet, or stretches it too far."""
        name = f"mount.surface {self.file or 'obj'}"
        self._check_units(name, size_m)
        nodes_m = nodes_m[:: max(1, len(nodes_m) // CHECKED_PLACES)]
        covering, count = self.triangles.covering(nodes_m)
        if (count == 0).any():
            x, y = nodes_m[count == 0][0] * 1e3
            low, high = (each * 1e3 for each in self.triangles.sheet_extent_m)
            raise ValueError(
                f"{name}: no triangle covers the sheet at ({x:.1f}, {y:.1f}) mm; its texture "
                f"coordinates run from ({low[0]:.1f}, {low[1]:.1f}) to ({high[0]:.1f}, "
                f"{high[1]:.1f}) mm and must cover the sheet, whose middle is (0, 0)"
            )
        if (count > 1).any():
            x, y = nodes_m[count > 1][0] * 1e3
            raise ValueError(
                f"{name}: {int(count.max())} triangles have the same texture coordinates at "
                f"({x:.1f}, {y:.1f}) mm of the sheet; unwrap the surface without overlap"
            )
        least, most = self.triangles.stretches[covering].T
        worst = int(np.argmax(np.maximum(most, 1 / least)))
        if max(most[worst], 1 / least[worst]) > MAX_STRETCH:
            x, y = nodes_m[worst] * 1e3
            raise ValueError(
                f"{name}: at ({x:.1f}, {y:.1f}) mm of the sheet the surface is "
                f"{least[worst]:.3f} to {most[worst]:.3f} times as long as the sheet; "
                f"{1 / MAX_STRETCH:g} to {MAX_STRETCH:g} can be modelled. Give texture coordinates "
                "of the sheet's true lengths, or make the sheet of pieces that need less stretching"
            )

    @cached_property
    def is_stretched(self) -> bool:
        """Whether lengths on the surface are others than on the sheet."""
        return bool(np.abs(self.triangles.stretches - 1).max() > NEARLY_FLAT)

    def _check_units(self, name: str, size_m: tuple[float, float]) -> None:
        low, high = self.triangles.sheet_extent_m
        span, size = high - low, np.array(size_m)
        if (span > MILLIMETRES * size).any():
            raise ValueError(
                f"{name}: its texture coordinates span {span[0]:.4g} x {span[1]:.4g}, the sheet "
                f"{size[0]:g} x {size[1]:g} m: in millimetres? divide them (vt) by 1000"
            )
        if (span < size / MILLIMETRES).any():
            raise ValueError(
                f"{name}: its texture coordinates span {1e3 * span[0]:.4g} x {1e3 * span[1]:.4g} "
                f"mm, the sheet {1e3 * size[0]:g} x {1e3 * size[1]:g} mm; multiply them (vt) by "
                "1000, or give the sheet's true lengths"
            )
        if np.allclose((low, high), ((0, 0), (1, 1)), atol=0.02) and (size < 0.9).any():
            raise ValueError(
                f"{name}: its texture coordinates run from 0 to 1 as those of a picture do; give "
                f"sheet metres: x = (u - 0.5) * {size[0]:g}, y = (v - 0.5) * {size[1]:g}"
            )
        if (stretch := float(np.median(self.triangles.stretches))) > MILLIMETRES:
            raise ValueError(
                f"{name}: the surface is {stretch:.4g} times as long as its texture coordinates, "
                "which are metres: vertices in millimetres? divide them (v) by 1000"
            )

    def place(self, xy_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points and normals, each (N, 3), of places (N, 2) on the sheet."""
        return self.triangles.place(xy_m)

    def unplace(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places on the sheet (N, 2) below points (N, 3), and how far above it those are (N,)."""
        return self.triangles.unplace(points_m)


class Mount(Section):
    """The link that carries the sheet, and where: on a plane, a cylinder or a surface."""

    frame: Annotated[
        str,
        spelt(
            "[A-Za-z0-9_][A-Za-z0-9_./-]{0,62}",
            "give a name of letters, digits and _ . / -, none of the last three first, 63 "
            "characters at most",
        ),
    ]
    plane: PlaneMount | None = None
    cylinder: CylinderMount | None = None
    surface: SurfaceMount | None = None

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        given = [key for key in ("plane", "cylinder", "surface") if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(
                f"{' and '.join(given) or 'frame'}: give one of [mount.plane], [mount.cylinder] "
                "and [mount.surface]"
            )
        return self

    @property
    def kind(self) -> str:
        """``plane``, ``cylinder`` or ``surface``."""
        return "plane" if self.plane else "cylinder" if self.cylinder else "surface"

    @property
    def _form(self) -> PlaneMount | CylinderMount | SurfaceMount:
        form = self.plane or self.cylinder or self.surface
        assert form is not None
        return form

    def check(self, size_m: tuple[float, float], nodes_m: FloatArray) -> None:
        """Raise ValueError where a sheet of a size, with map nodes (N, 2), cannot lie there."""
        self._form.check(size_m, nodes_m)

    def place(self, xy_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points and outward normals in the link's frame, each (N, 3), of places (N, 2)."""
        return self._form.place(xy_m)

    def unplace(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places on the sheet (N, 2) below points (N, 3), and how far above it those are (N,)."""
        return self._form.unplace(points_m)

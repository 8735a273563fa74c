"""The sheet and its electrodes: their sizes, whether they fit, and where each lies."""

from __future__ import annotations

from functools import cached_property
from itertools import combinations
from typing import Annotated, Literal, Self, TypeVar

import numpy as np
from pydantic import Discriminator, Field, Tag, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError

from tactomo_models.arrays import FloatArray
from tactomo_models.sensor.outline import (
    Circle,
    Outline,
    Pad,
    RimElectrode,
    polygon_outline,
    rectangle_outline,
)
from tactomo_models.sensor.section import Section

# An electrode's impedance times the sheet's conductance. Against larger ones, simulated changes of
# paper_square are wrong by 2e-5 of their largest here, by 1e-2 at 1e-12: rounding.
MIN_CONTACT = 1e-9
MIN_GAP_M = 1e-5  # between electrodes: as `Metres`
# Below ten micrometres the mesh would be refined for ever.
Metres = Annotated[float, Field(ge=1e-5, le=10, allow_inf_nan=False)]

Place = Annotated[
    tuple[Annotated[float, Field(ge=-10, le=10)], Annotated[float, Field(ge=-10, le=10)]],
    Field(strict=False),
]
Ring = Annotated[tuple[Place, ...], Field(min_length=3, strict=False)]


MIN_SHEET_M, MAX_SHEET_M = 1e-3, 3.0  # of another size, a sheet was drawn in another unit


class Sheet(Section):
    """The conductive sheet.

    A disc has `width_m` as its diameter and no height. A polygon has its corners, `outline_m`,
    either way round, and those of its holes; the origin is the middle of its bounding box.
    """

    shape: Literal["rectangle", "disc", "polygon"]
    width_m: Annotated[Metres | None, Field(validate_default=True)] = None
    height_m: Metres | None = None
    outline_m: Ring | None = None
    holes_m: Annotated[tuple[Ring, ...], Field(max_length=64, strict=False)] = ()
    frame_width_m: Annotated[float, Field(ge=0, le=1)] = 0.0
    conductivity_s_m: Annotated[float, Field(gt=0, le=1e8)]
    thickness_m: Annotated[float, Field(gt=0, le=1)]

    @field_validator("width_m")
    @classmethod
    def _width_is_there(cls, width_m: float | None, given: ValidationInfo) -> float | None:
        if width_m is None and given.data.get("shape") in ("rectangle", "disc"):
            raise PydanticCustomError("missing", "Field required")
        return width_m

    @model_validator(mode="after")
    def _shape_has_its_size(self) -> Self:
        is_polygon = self.shape == "polygon"
        if is_polygon != (self.outline_m is not None) or (self.holes_m and not is_polygon):
            raise ValueError(
                "outline_m: a polygon takes outline_m and holes_m, and no other shape does"
            )
        if is_polygon and (self.width_m or self.height_m):
            raise ValueError("width_m, height_m: must be left out, outline_m is the size")
        if self.shape == "rectangle" and self.height_m is None:
            raise ValueError("height_m is required for a rectangle")
        if self.shape == "disc" and self.height_m not in (None, self.width_m):
            raise ValueError(
                f"height_m = {self.height_m}: must be left out for a disc, width_m is its diameter"
            )
        self._check_unit()
        limit = min(self.size_m) / 4
        if self.frame_width_m >= limit:
            raise ValueError(
                f"frame_width_m = {self.frame_width_m}: must be below a quarter of the sheet's "
                f"smaller side, {limit:.4g}"
            )
        return self

    def _check_unit(self) -> None:
        wide, high = self.size_m
        keys = "outline_m, holes_m and positions_m" if self.outline_m else "width_m and height_m"
        if min(wide, high) < MIN_SHEET_M:
            raise ValueError(
                f"{keys}: the sheet is {1e3 * wide:.4g} x {1e3 * high:.4g} mm; if this should be "
                f"{1e6 * wide:.4g} x {1e6 * high:.4g} mm, multiply them by 1000"
            )
        if max(wide, high) > MAX_SHEET_M:
            raise ValueError(
                f"{keys}: the sheet is {wide:.4g} x {high:.4g} m, and may be {MAX_SHEET_M:g} m: in "
                f"centimetres or millimetres? divide them by 100 or 1000"
            )

    @cached_property
    def outline(self) -> Outline:
        """Where the sheet ends."""
        if self.outline_m is not None:
            return polygon_outline(self.outline_m, self.holes_m)
        width_m, height_m = self.size_m
        return Circle(width_m / 2) if self.shape == "disc" else rectangle_outline(width_m, height_m)

    @cached_property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the bounding box."""
        if self.outline_m is not None:
            low_x, low_y, high_x, high_y = self.outline.polygon.bounds
            return high_x - low_x, high_y - low_y
        assert self.width_m is not None
        return self.width_m, self.height_m or self.width_m


def _one_or_two(given: object) -> str:
    return "two" if isinstance(given, list | tuple) else "one"


# One value for all four sides, or two: of bottom and top, of right and left.
Count = Annotated[int, Field(ge=1, le=16)]
OfSides = Discriminator(_one_or_two)
PerSide = Annotated[
    Annotated[Count, Tag("one")] | Annotated[tuple[Count, Count], Field(strict=False), Tag("two")],
    OfSides,
]
Pitch = Annotated[
    Annotated[Metres, Tag("one")]
    | Annotated[tuple[Metres, Metres], Field(strict=False), Tag("two")],
    OfSides,
]


class Electrodes(Section):
    """Electrodes: `per_side` and `pitch_m` on a rectangle, `count` on a disc, or `positions_m`.

    Those listed by `positions_m` lie on the rim of a sheet of any shape, as long as `length_m`, or
    inside, where they are round pads of `pad_radius_m`.
    """

    length_m: Metres
    contact_impedance_ohm_m: Annotated[float, Field(gt=0, le=1e9)]
    per_side: PerSide | None = None
    pitch_m: Pitch | None = None
    count: Annotated[int, Field(ge=6, le=64)] | None = None
    first_angle_deg: Annotated[float, Field(ge=-360, le=360)] = -90.0
    positions_m: (
        Annotated[tuple[Place, ...], Field(min_length=6, max_length=64, strict=False)] | None
    ) = None
    pad_radius_m: Metres | None = None
    clockwise: bool = False

    @model_validator(mode="after")
    def _listed_once(self) -> Self:
        if self.positions_m is None:
            if self.pad_radius_m is not None:
                raise ValueError("pad_radius_m: pads lie at positions_m, which is missing")
            return self
        if self.count or self.per_side or self.pitch_m:
            raise ValueError("positions_m: must not be given beside count, per_side or pitch_m")
        if self.clockwise:
            raise ValueError(
                "clockwise: electrodes are numbered as positions_m lists them; leave it out"
            )
        return self

    @property
    def total(self) -> int:
        """How many there are, on a sheet of any shape."""
        return len(self.positions_m or ()) or self.count or 2 * sum(self.each_side)

    @property
    def each_side(self) -> tuple[int, int]:
        """How many are on the bottom and on the top of a rectangle, and on its right and left."""
        return _both(self.per_side or 0)

    @property
    def pitches_m(self) -> tuple[float, float]:
        """Their distance, centre to centre, on those sides."""
        return _both(self.pitch_m or 0.0)


_Number = TypeVar("_Number", int, float)


def _both(given: _Number | tuple[_Number, _Number]) -> tuple[_Number, _Number]:
    return given if isinstance(given, tuple) else (given, given)


def check_electrodes(sheet: Sheet, electrodes: Electrodes) -> None:
    """Raise ValueError, with what to change, where electrodes do not fit their sheet."""
    if electrodes.positions_m is not None:
        _check_apart(sheet.outline, placed_electrodes(sheet, electrodes))
    elif sheet.shape == "polygon":
        raise ValueError("electrodes: a polygon takes positions_m, and no per_side or count")
    else:
        _check_even(sheet, electrodes)
    impedance = electrodes.contact_impedance_ohm_m / electrodes.length_m  # ohm
    if impedance * sheet.conductivity_s_m * sheet.thickness_m < MIN_CONTACT:
        raise ValueError(
            f"electrodes.contact_impedance_ohm_m = {electrodes.contact_impedance_ohm_m}: too "
            f"little beside the sheet's {sheet.conductivity_s_m} S/m x {sheet.thickness_m} m to "
            "compute with; check the units of all three, 1e-6 ohm m is a perfect contact"
        )


def _check_even(sheet: Sheet, electrodes: Electrodes) -> None:
    width_m, height_m = sheet.size_m
    if sheet.shape == "disc":
        if electrodes.count is None or electrodes.per_side or electrodes.pitch_m:
            raise ValueError(
                "electrodes: a disc takes count, and no per_side or pitch_m; or positions_m"
            )
        room = np.pi * width_m / electrodes.count
    else:
        if electrodes.per_side is None or electrodes.pitch_m is None or electrodes.count:
            raise ValueError(
                "electrodes: a rectangle takes per_side and pitch_m, and no count; or positions_m"
            )
        for side, (name, length_m) in enumerate((("width_m", width_m), ("height_m", height_m))):
            _check_side(electrodes, side, name, length_m)
        room = min(electrodes.pitches_m)
    if electrodes.length_m >= room:
        raise ValueError(
            f"electrodes.length_m = {electrodes.length_m}: must be below their distance, {room:.4g}"
        )


def _check_apart(outline: Outline, electrodes: list[RimElectrode | Pad]) -> None:
    """Raise ValueError where electrodes lie over each other."""
    for (one, first), (other, second) in combinations(enumerate(electrodes), 2):
        if isinstance(first, Pad) and isinstance(second, Pad):
            size = "pad_radius_m"
            room = np.hypot(*np.subtract(first.centre_m, second.centre_m)) - 2 * first.radius_m
        elif isinstance(first, RimElectrode) and isinstance(second, RimElectrode):
            size, ring_m = "length_m", outline.lengths_m[first.ring]
            if first.length_m >= ring_m:
                raise ValueError(
                    f"electrodes.length_m = {first.length_m}: more than the ring of {ring_m:.4g} m "
                    f"that electrode {one} lies on; give a shorter one, in metres"
                )
            apart = abs(first.middle_m - second.middle_m) % ring_m
            room = min(apart, ring_m - apart) - (first.length_m + second.length_m) / 2
            if first.ring != second.ring:
                continue
        else:
            continue
        if room < MIN_GAP_M:
            raise ValueError(
                f"electrodes.positions_m[{one}] and [{other}] lie over each other: move one, or "
                f"give a smaller electrodes.{size}"
            )


def _check_side(electrodes: Electrodes, side: int, name: str, length_m: float) -> None:
    count, pitch_m = electrodes.each_side[side], electrodes.pitches_m[side]
    needed = pitch_m * (count - 1) + electrodes.length_m
    if needed > length_m:
        raise ValueError(
            f"electrodes: {count} of them at pitch_m = {pitch_m} need {needed:.4g} m, but the "
            f"sheet's {name} is {length_m:.4g} m; give a smaller pitch_m, or two in brackets: of "
            "bottom and top, of right and left (so for per_side, too)"
        )


def placed_electrodes(sheet: Sheet, electrodes: Electrodes) -> list[RimElectrode | Pad]:
    """Every electrode where it lies on its sheet, in the order of their numbers.

    Raises ValueError where one of `positions_m` lies neither on the rim nor inside.
    """
    if electrodes.positions_m is not None:
        return _listed(sheet.outline, electrodes, np.array(electrodes.positions_m))
    middles = _on_disc if sheet.shape == "disc" else _on_rectangle
    placed: list[RimElectrode | Pad] = [
        RimElectrode(0, middle_m, electrodes.length_m)
        for middle_m in middles(sheet, electrodes).tolist()
    ]
    return [placed[0], *placed[:0:-1]] if electrodes.clockwise else placed


def _listed(
    outline: Outline, electrodes: Electrodes, positions_m: FloatArray
) -> list[RimElectrode | Pad]:
    depth = outline.depth(*positions_m.T)
    rings, along = outline.locate(positions_m)
    radius_m, placed = electrodes.pad_radius_m, list[RimElectrode | Pad]()
    for number, deep in enumerate(depth.tolist()):
        if abs(deep) <= electrodes.length_m / 2:  # a place that was measured, not the rim's own
            placed.append(
                RimElectrode(int(rings[number]), float(along[number]), electrodes.length_m)
            )
        elif radius_m is not None and deep > radius_m:
            placed.append(
                Pad((float(positions_m[number, 0]), float(positions_m[number, 1])), radius_m)
            )
        else:
            where = f"{1e3 * abs(deep):.3g} mm {'inside' if deep > 0 else 'off'} the rim"
            step = (
                "move it onto the sheet"
                if deep < 0
                else "give pad_radius_m if it is a pad inside, or move it onto the rim"
                if radius_m is None
                else f"a pad of {1e3 * radius_m:.3g} mm has no room there; move it"
            )
            raise ValueError(
                f"electrodes.positions_m[{number}] = {positions_m[number].tolist()} lies {where}: "
                f"{step}"
            )
    return placed


def _on_rectangle(sheet: Sheet, electrodes: Electrodes) -> FloatArray:
    """Middles of the electrodes along the rim, from the lower left corner."""
    across, upright = (
        (np.arange(n) - (n - 1) / 2) * pitch_m
        for n, pitch_m in zip(electrodes.each_side, electrodes.pitches_m, strict=True)
    )
    w, h = sheet.size_m
    return np.concatenate(
        [across + w / 2, upright + w + h / 2, across + 1.5 * w + h, upright + 2 * w + 1.5 * h]
    )


def _on_disc(sheet: Sheet, electrodes: Electrodes) -> FloatArray:
    """Middles of the electrodes along the rim, from angle 0."""
    angle = np.radians(electrodes.first_angle_deg) + 2 * np.pi * np.arange(electrodes.total) / (
        electrodes.total
    )
    return np.asarray(sheet.size_m[0] / 2 * angle)

"""The sheet and the electrodes on its rim: their sizes, whether they fit, and where each ends."""

from __future__ import annotations

from typing import Annotated, Literal, Self, TypeVar

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from tactomo_models.arrays import FloatArray
from tactomo_models.sensor.section import Section

# An electrode's impedance times the sheet's conductance. Against larger ones, simulated changes of
# paper_square are wrong by 2e-5 of their largest here, by 1e-2 at 1e-12: rounding.
MIN_CONTACT = 1e-9
# Below ten micrometres the mesh would be refined for ever.
Metres = Annotated[float, Field(ge=1e-5, le=10, allow_inf_nan=False)]


class Sheet(Section):
    """The conductive sheet. A disc has `width_m` as its diameter and no height."""

    shape: Literal["rectangle", "disc"]
    width_m: Metres
    height_m: Metres | None = None
    frame_width_m: Annotated[float, Field(ge=0, le=1)] = 0.0
    conductivity_s_m: Annotated[float, Field(gt=0, le=1e8)]
    thickness_m: Annotated[float, Field(gt=0, le=1)]

    @model_validator(mode="after")
    def _shape_has_its_size(self) -> Self:
        if self.shape == "rectangle" and self.height_m is None:
            raise ValueError("height_m is required for a rectangle")
        if self.shape == "disc" and self.height_m not in (None, self.width_m):
            raise ValueError(
                f"height_m = {self.height_m}: must be left out for a disc, width_m is its diameter"
            )
        limit = min(self.size_m) / 4
        if self.frame_width_m >= limit:
            raise ValueError(
                f"frame_width_m = {self.frame_width_m}: must be below a quarter of the sheet's "
                f"smaller side, {limit:.4g}"
            )
        return self

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the bounding box."""
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
    """Electrodes on the rim: `per_side` and `pitch_m` on a rectangle, `count` on a disc."""

    length_m: Metres
    contact_impedance_ohm_m: Annotated[float, Field(gt=0, le=1e9)]
    per_side: PerSide | None = None
    pitch_m: Pitch | None = None
    count: Annotated[int, Field(ge=6, le=64)] | None = None
    first_angle_deg: Annotated[float, Field(ge=-360, le=360)] = -90.0

    @property
    def total(self) -> int:
        """How many there are, on a sheet of either shape."""
        return self.count or 2 * sum(self.each_side)

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
    if sheet.shape == "disc":
        if electrodes.count is None or electrodes.per_side or electrodes.pitch_m:
            raise ValueError("electrodes: a disc takes count, and no per_side or pitch_m")
        room = np.pi * sheet.width_m / electrodes.count
    else:
        if electrodes.per_side is None or electrodes.pitch_m is None or electrodes.count:
            raise ValueError("electrodes: a rectangle takes per_side and pitch_m, and no count")
        for side, name in ((0, "width_m"), (1, "height_m")):
            _check_side(electrodes, side, name, getattr(sheet, name))
        room = min(electrodes.pitches_m)
    if electrodes.length_m >= room:
        raise ValueError(
            f"electrodes.length_m = {electrodes.length_m}: must be below their distance, {room:.4g}"
        )
    impedance = electrodes.contact_impedance_ohm_m / electrodes.length_m  # ohm
    if impedance * sheet.conductivity_s_m * sheet.thickness_m < MIN_CONTACT:
        raise ValueError(
            f"electrodes.contact_impedance_ohm_m = {electrodes.contact_impedance_ohm_m}: too "
            f"little beside the sheet's {sheet.conductivity_s_m} S/m x {sheet.thickness_m} m to "
            "compute with; check the units of all three, 1e-6 ohm m is a perfect contact"
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


def electrode_ends(sheet: Sheet, electrodes: Electrodes) -> FloatArray:
    """Both ends of every electrode on the rim, counter-clockwise: (L, 2, 2), metres."""
    on_rim = _on_disc if sheet.shape == "disc" else _on_rectangle
    return on_rim(sheet, electrodes)


def _on_rectangle(sheet: Sheet, electrodes: Electrodes) -> FloatArray:
    half = electrodes.length_m / 2
    across, upright = (
        ((np.arange(n) - (n - 1) / 2) * pitch_m)[:, None] + [-half, half]  # (n, 2), as one travels
        for n, pitch_m in zip(electrodes.each_side, electrodes.pitches_m, strict=True)
    )
    width_m, height_m = sheet.size_m
    w, h = width_m / 2, height_m / 2
    sides = [
        (across, np.full_like(across, -h)),
        (np.full_like(upright, w), upright),
        (-across, np.full_like(across, h)),
        (np.full_like(upright, -w), -upright),
    ]
    return np.concatenate([np.stack(side, axis=-1) for side in sides])


def _on_disc(sheet: Sheet, electrodes: Electrodes) -> FloatArray:
    n, radius = electrodes.total, sheet.width_m / 2
    centre = np.radians(electrodes.first_angle_deg) + 2 * np.pi * np.arange(n) / n
    half = electrodes.length_m / 2 / radius
    angle = np.stack([centre - half, centre + half], axis=1)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)

"""The sensor description: what a skin is made of, read from a TOML file.

Nothing about a sensor is hard-coded elsewhere. The shipped descriptions lie in
`tactomo_models/sensors`; a user with another sheet copies one and changes it.
"""

from __future__ import annotations

import hashlib
from functools import cached_property
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    model_validator,
)

from tactomo_models.errors import DescriptionError, explain
from tactomo_models.pattern import Pairs, combined, ring_pairs
from tactomo_models.toml_file import parse_toml, read_toml

Modality = Literal["magnitude", "structure"]
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
# Below ten micrometres the mesh would be refined for ever.
Metres = Annotated[float, Field(ge=1e-5, le=10, allow_inf_nan=False)]
# TOML has lists where a frozen model has tuples; what is in them is as strict as the rest.
Table = Annotated[tuple[float, ...], Field(min_length=2, max_length=64, strict=False)]
Electrode = Annotated[int, Field(ge=0, le=63)]
PairList = Annotated[
    tuple[Annotated[tuple[Electrode, Electrode], Field(strict=False)], ...],
    Field(min_length=1, max_length=256, strict=False),
]


MAX_TABLE_BYTES = 2_000_000_000
"""Of a sensor's influence tables, which grow as the square of the map's nodes."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Sheet(_Section):
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
        limit = min(self.width_m, self.height_m or self.width_m) / 4
        if self.frame_width_m >= limit:
            raise ValueError(
                f"frame_width_m = {self.frame_width_m}: must be below a quarter of the sheet's "
                f"smaller side, {limit:.4g}"
            )
        return self


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


class Electrodes(_Section):
    """Electrodes on the rim: `per_side` and `pitch_m` on a rectangle, `count` on a disc."""

    length_m: Metres
    contact_impedance_ohm_m: Annotated[float, Field(gt=0, le=1e9)]
    per_side: PerSide | None = None
    pitch_m: Pitch | None = None
    count: Annotated[int, Field(ge=6, le=64)] | None = None
    first_angle_deg: Annotated[float, Field(ge=-360, le=360)] = -90.0

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


class Pattern(_Section):
    """Drive pair k is (k, k + drive_offset), measuring pair m is (m, m + measure_offset).

    Or as listed by `drive`, `measure`: each pair once, source and sink, plus and minus.
    """

    drive_offset: Annotated[int, Field(ge=1, le=32)] = 1
    measure_offset: Annotated[int, Field(ge=1, le=32)] = 1
    drive: PairList | None = None
    measure: PairList | None = None
    current_a: Annotated[float, Field(gt=0, le=1)]

    @model_validator(mode="after")
    def _pairs_are_pairs(self) -> Self:
        for key in ("drive", "measure"):
            listed = getattr(self, key)
            if listed is None:
                continue
            if getattr(self, f"{key}_offset") != 1:
                raise ValueError(f"{key} and {key}_offset: give one of the two")
            for number, pair in enumerate(listed):
                if pair[0] == pair[1] or pair in listed[:number]:
                    raise ValueError(
                        f"{key}[{number}] = {list(pair)}: must be two electrodes, and no pair twice"
                    )
        return self

    def __str__(self) -> str:
        """The pattern in words."""
        drive, measure = (
            f"{len(listed)} listed pairs" if listed else f"({k}, {k}+{offset})"
            for k, offset, listed in (
                ("k", self.drive_offset, self.drive),
                ("m", self.measure_offset, self.measure),
            )
        )
        return f"drive {drive}, measure {measure}"


class Instrument(_Section):
    """What the device that reads the electrodes makes of their voltages.

    `unsigned` ones are sizes, as of a peak or RMS detector: see `signs`. A converter that reads
    nothing of voltages below zero has `positive` ones, or `negative` ones where it is connected the
    other way round. `single_ended` readings, of each electrode against the one that the current
    leaves by, are the `matrix` protocol's. `regularisation` is a factor on what the linear methods
    choose by the noise: above 1 where a device has larger errors than noise.
    """

    voltages: Literal["signed", "unsigned", "positive", "negative"] = "signed"
    referenced: Literal["pairs", "single_ended"] = "pairs"
    volts_per_unit: Annotated[float, Field(gt=0, le=1e6)] = 1.0
    regularisation: Annotated[float, Field(ge=1e-3, le=1e6)] = 1.0
    start: Annotated[str, Field(max_length=16, pattern=r"^[ -~\r\n]*$")] = ""
    scan_rate_hz: Annotated[float, Field(ge=0.1, le=1000)] = 20.0
    frequency_hz: Annotated[float, Field(ge=100, le=1e7)] = 10_000.0

    @model_validator(mode="after")
    def _single_ended_readings_have_their_sign(self) -> Self:
        if self.referenced == "single_ended" and self.voltages != "signed":
            raise ValueError(
                f"voltages = {self.voltages!r}: single_ended readings, against the electrode that "
                "the current leaves by, are positive by themselves; leave it out"
            )
        return self


class MagnitudeResponse(_Section):
    """Relative conductivity change (sigma - sigma_0) / sigma_0 against pressure in kPa."""

    pressure_kpa: Table
    relative_change: Table

    @model_validator(mode="after")
    def _is_a_monotone_table(self) -> Self:
        _check_table(self.pressure_kpa, self.relative_change, "relative_change", start=0.0)
        if min(self.relative_change) <= -1:
            raise ValueError(
                f"relative_change = {list(self.relative_change)}: must stay above -1, "
                "conductivity is positive"
            )
        return self

    @property
    def sign(self) -> float:
        """+1 where pressure raises conductivity, -1 where it lowers it."""
        return 1.0 if self.relative_change[-1] > 0 else -1.0

    def change(self, pressure_kpa: FloatArray) -> FloatArray:
        """Relative conductivity change at a pressure, any shape."""
        return np.asarray(np.interp(pressure_kpa, self.pressure_kpa, self.relative_change))


class StructureResponse(_Section):
    """Ratio of the pressed to the unpressed conductivity against pressure in kPa."""

    pressure_kpa: Table
    conductivity_ratio: Table

    @model_validator(mode="after")
    def _is_a_monotone_table(self) -> Self:
        _check_table(self.pressure_kpa, self.conductivity_ratio, "conductivity_ratio", start=1.0)
        if min(self.conductivity_ratio) <= 0:
            raise ValueError(
                f"conductivity_ratio = {list(self.conductivity_ratio)}: must stay above 0"
            )
        return self

    def ratio(self, pressure_kpa: FloatArray) -> FloatArray:
        """Conductivity ratio at a pressure, any shape; the logarithm is interpolated."""
        logs = np.log(self.conductivity_ratio)
        return np.asarray(np.exp(np.interp(pressure_kpa, self.pressure_kpa, logs)))


def _check_table(x: Table, y: Table, name: str, start: float) -> None:
    if len(x) != len(y):
        raise ValueError(f"{name} = {list(y)}: must have as many entries as pressure_kpa, {len(x)}")
    if x[0] != 0 or any(b <= a for a, b in pairwise(x)):
        raise ValueError(f"pressure_kpa = {list(x)}: must start at 0 and rise")
    steps = np.diff(y)
    if y[0] != start or not (np.all(steps >= 0) or np.all(steps <= 0)) or y[-1] == y[0]:
        raise ValueError(f"{name} = {list(y)}: must start at {start:g} and only rise or only fall")


class MagnitudeChannel(_Section):
    """The channel that answers with the pressure's size."""

    response: MagnitudeResponse


class StructureChannel(_Section):
    """The saturating channel: pressed or not. Give a response, or the saturated ratio alone.

    With `either_way`, as in a tank that holds metal and plastic, objects of both kinds may be in
    one scene: of this ratio, or of one over it.
    """

    response: StructureResponse | None = None
    conductivity_ratio: Annotated[float, Field(gt=0, le=1e6)] | None = None
    either_way: bool = False

    @model_validator(mode="after")
    def _one_of_the_two(self) -> Self:
        if (self.response is None) == (self.conductivity_ratio is None):
            raise ValueError("response or conductivity_ratio: give one of the two")
        if self.saturated_ratio == 1:
            raise ValueError("conductivity_ratio = 1: must differ from 1")
        if self.either_way and self.saturated_ratio < 1:
            raise ValueError(
                f"conductivity_ratio = {self.saturated_ratio:g}: must be above 1 with either_way, "
                "objects of one over it are the other kind"
            )
        return self

    @property
    def saturated_ratio(self) -> float:
        """Conductivity of a fully pressed area over that of the bare sheet."""
        return (
            self.response.conductivity_ratio[-1]
            if self.response
            else self.conductivity_ratio or 1.0
        )


class MapGrid(_Section):
    """Nodes of the published map along x and y; the outermost lie on the bounding box."""

    nodes_x: Annotated[int, Field(ge=11, le=401)] = 51
    nodes_y: Annotated[int, Field(ge=11, le=401)] = 51


class SensorDescription(_Section):
    """A whole sensor: sheet, electrodes, pattern, map and the channels' contact response."""

    schema_version: Literal[1] = Field(alias="schema")
    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,62}$")]
    title: str = ""
    sheet: Sheet
    electrodes: Electrodes
    pattern: Pattern
    instrument: Instrument = Instrument()
    map: MapGrid = MapGrid()
    magnitude: MagnitudeChannel | None = None
    structure: StructureChannel | None = None

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        if self.magnitude is None and self.structure is None:
            raise ValueError("give at least one of [magnitude.response] and [structure]")
        _check_electrodes(self.sheet, self.electrodes)
        if not 6 <= self.electrode_count <= 64:
            raise ValueError(f"electrodes: {self.electrode_count} in all; 6 to 64 are supported")
        for key in ("drive_offset", "measure_offset"):
            offset = getattr(self.pattern, key)
            if offset >= self.electrode_count:
                raise ValueError(
                    f"pattern.{key} = {offset}: must be below the number of electrodes, "
                    f"{self.electrode_count}"
                )
        self._check_listed_pairs()
        self._check_size()
        return self

    def _check_listed_pairs(self) -> None:
        count = self.electrode_count
        for key in ("drive", "measure"):
            for pair in getattr(self.pattern, key) or ():
                if max(pair) >= count:
                    raise ValueError(
                        f"pattern.{key} holds {list(pair)}: the electrodes are 0 to {count - 1}"
                    )
        if not 0 < self.measurements <= count**2:
            raise ValueError(
                f"pattern: {self.measurements} voltages by pairs that share no electrode; must be "
                f"1 to {count**2}, the number of electrodes squared"
            )

    def _check_size(self) -> None:
        """Refuse what no computer has the memory for, before anything is built."""
        nodes, measurements = self.map.nodes_x * self.map.nodes_y, self.electrode_count**2
        needed = 8 * nodes * (nodes + 2 * measurements)
        if needed > MAX_TABLE_BYTES:
            raise ValueError(
                f"map: {self.map.nodes_x} x {self.map.nodes_y} nodes with {self.electrode_count} "
                f"electrodes need tables of {needed / 1e9:.1f} GB, more than "
                f"{MAX_TABLE_BYTES / 1e9:g}: give fewer nodes"
            )

    @property
    def width_m(self) -> float:
        """Width of the bounding box."""
        return self.sheet.width_m

    @property
    def height_m(self) -> float:
        """Height of the bounding box."""
        return self.sheet.height_m or self.sheet.width_m

    @property
    def modalities(self) -> tuple[Modality, ...]:
        """The channels this sensor has, magnitude first."""
        both: tuple[Modality, ...] = ("magnitude", "structure")
        return tuple(name for name in both if getattr(self, name) is not None)

    def strongest_ratio(self, channel: Modality) -> float:
        """Factor on a channel's conductivity where it is pressed hardest; never 1."""
        if channel == "magnitude":
            assert self.magnitude is not None
            return 1 + self.magnitude.response.relative_change[-1]
        assert self.structure is not None
        return self.structure.saturated_ratio

    def contrast(self, channel: Modality) -> float:
        """The same as a factor above 1, up or down."""
        ratio = self.strongest_ratio(channel)
        return max(ratio, 1 / ratio)

    def sign(self, channel: Modality) -> float:
        """1.0 where pressing makes a channel conduct better, -1.0 where worse."""
        return 1.0 if self.strongest_ratio(channel) > 1 else -1.0

    def either_way(self, channel: Modality) -> bool:
        """Whether objects may conduct better or worse than the sheet."""
        return channel == "structure" and self.structure is not None and self.structure.either_way

    @property
    def electrode_count(self) -> int:
        """Number of electrodes of one sheet."""
        return self.electrodes.count or 2 * sum(self.electrodes.each_side)

    def __eq__(self, other: object) -> bool:
        """Descriptions are equal by what they say, whatever has been worked out from them."""
        if not isinstance(other, SensorDescription):
            return NotImplemented
        return self is other or self.model_dump() == other.model_dump()

    @cached_property
    def pairs(self) -> Pairs:
        """Drive and measuring pairs of every voltage, in the order of a scan."""
        return combined(self.drive_pairs, self.measure_pairs)

    @property
    def drive_pairs(self) -> IntArray:
        """Source and sink of every drive, in order, (D, 2)."""
        return self._pairs_of(self.pattern.drive, self.pattern.drive_offset)

    @property
    def measure_pairs(self) -> IntArray:
        """Plus and minus of every measuring pair, in order, (K, 2)."""
        return self._pairs_of(self.pattern.measure, self.pattern.measure_offset)

    def _pairs_of(self, listed: PairList | None, offset: int) -> IntArray:
        if listed is None:
            return ring_pairs(self.electrode_count, offset)
        return np.array(listed, dtype=np.intp)

    @property
    def offsets(self) -> tuple[int, int]:
        """Of the first drive pair and the first measuring pair: what a hello says of a pattern."""
        steps = (int(pairs[0, 1] - pairs[0, 0]) for pairs in (self.drive_pairs, self.measure_pairs))
        drive, measure = (step % self.electrode_count for step in steps)
        return drive, measure

    @property
    def measurements(self) -> int:
        """Voltages in one scan."""
        return len(self.pairs.drive)

    @property
    def sheet_conductance_s(self) -> float:
        """Conductivity times thickness."""
        return self.sheet.conductivity_s_m * self.sheet.thickness_m

    @cached_property
    def electrode_ends_m(self) -> FloatArray:
        """Both ends of every electrode on the rim, counter-clockwise: (electrodes, 2, 2)."""
        rim = _disc_electrodes if self.sheet.shape == "disc" else _rectangle_electrodes
        return rim(self)

    @property
    def electrode_centres_m(self) -> FloatArray:
        """Centre of every electrode, (electrodes, 2)."""
        return np.asarray(self.electrode_ends_m.mean(axis=1))

    @cached_property
    def map_x_m(self) -> FloatArray:
        """X of the map's columns, (nodes_x,)."""
        return np.linspace(-self.width_m / 2, self.width_m / 2, self.map.nodes_x)

    @cached_property
    def map_y_m(self) -> FloatArray:
        """Y of the map's rows, (nodes_y,); row 0 is the lowest."""
        return np.linspace(-self.height_m / 2, self.height_m / 2, self.map.nodes_y)

    def on_sheet(
        self, x_m: FloatArray, y_m: FloatArray, margin_m: float = 0.0
    ) -> NDArray[np.bool_]:
        """Tell which points lie on the sheet, at least `margin_m` inside its rim."""
        slack = 1e-9
        if self.sheet.shape == "disc":
            inside = np.hypot(x_m, y_m) <= self.width_m / 2 - margin_m + slack
        else:
            inside = (np.abs(x_m) <= self.width_m / 2 - margin_m + slack) & (
                np.abs(y_m) <= self.height_m / 2 - margin_m + slack
            )
        return np.asarray(inside)

    @cached_property
    def sha256(self) -> str:
        """Hash of what the physics depends on; calibration tables may change without a rebuild."""
        unlisted = {key for key in ("drive", "measure") if getattr(self.pattern, key) is None}
        physics = self.model_dump_json(
            include={"schema_version", "sheet", "electrodes", "pattern", "map"},
            exclude={"pattern": unlisted},  # hashes are older than these keys
        )
        return hashlib.sha256(physics.encode()).hexdigest()


def _check_electrodes(sheet: Sheet, electrodes: Electrodes) -> None:
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


def _check_side(electrodes: Electrodes, side: int, name: str, length_m: float) -> None:
    count, pitch_m = electrodes.each_side[side], electrodes.pitches_m[side]
    needed = pitch_m * (count - 1) + electrodes.length_m
    if needed > length_m:
        raise ValueError(
            f"electrodes: {count} of them at pitch_m = {pitch_m} need {needed:.4g} m, but the "
            f"sheet's {name} is {length_m:.4g} m; give a smaller pitch_m, or two in brackets: of "
            "bottom and top, of right and left (so for per_side, too)"
        )


def _rectangle_electrodes(description: SensorDescription) -> FloatArray:
    half = description.electrodes.length_m / 2
    across, upright = (
        ((np.arange(n) - (n - 1) / 2) * pitch_m)[:, None] + [-half, half]  # (n, 2), as one travels
        for n, pitch_m in zip(
            description.electrodes.each_side, description.electrodes.pitches_m, strict=True
        )
    )
    w, h = description.width_m / 2, description.height_m / 2
    sides = [
        (across, np.full_like(across, -h)),
        (np.full_like(upright, w), upright),
        (-across, np.full_like(across, h)),
        (np.full_like(upright, -w), -upright),
    ]
    return np.concatenate([np.stack(side, axis=-1) for side in sides])


def _disc_electrodes(description: SensorDescription) -> FloatArray:
    n, radius = description.electrode_count, description.width_m / 2
    centre = np.radians(description.electrodes.first_angle_deg) + 2 * np.pi * np.arange(n) / n
    half = description.electrodes.length_m / 2 / radius
    angle = np.stack([centre - half, centre + half], axis=1)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def shipped_descriptions() -> list[str]:
    """Names of the descriptions that come with tactomo."""
    folder = resources.files("tactomo_models.sensors")
    return sorted(
        f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml")
    )


def shipped_text(name: str) -> str:
    """The TOML text of a shipped description, comments and all.

    Raises:
        DescriptionError: there is none of that name.
    """
    if name not in shipped_descriptions():
        raise DescriptionError(
            f"no description is shipped as {name!r}; choose one of: "
            f"{', '.join(shipped_descriptions())}"
        )
    return resources.files("tactomo_models.sensors").joinpath(f"{name}.toml").read_text("utf-8")


def load_description(source: str | Path) -> SensorDescription:
    """Read a sensor description by its shipped name or from a TOML file.

    Raises:
        DescriptionError: the file cannot be read, is not TOML, or a key is unknown, missing
            or out of range; the message names the key, its value and what is allowed.
    """
    name = str(source)
    try:
        return SensorDescription.model_validate(_read(name))
    except ValidationError as error:
        raise DescriptionError(
            "\n".join(f"{name}: {explain(item)}" for item in error.errors())
        ) from error


def _read(name: str) -> dict[str, Any]:
    try:
        if name in shipped_descriptions():
            return parse_toml(shipped_text(name))
        return read_toml(Path(name))
    except OSError as error:
        raise _cannot_read(name, error.strerror) from error
    except UnicodeDecodeError as error:
        raise _cannot_read(name, "not UTF-8 text") from error
    except ValueError as error:
        raise DescriptionError(f"{name} is not valid TOML: {error}") from error


def _cannot_read(name: str, reason: str | None) -> DescriptionError:
    return DescriptionError(
        f"cannot read the sensor description {name}: {reason}; give the path of a TOML file "
        f"or one of: {', '.join(shipped_descriptions())}"
    )

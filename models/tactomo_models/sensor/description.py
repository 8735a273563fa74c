"""The sensor description: what a skin is made of.

Nothing about a sensor is hard-coded elsewhere.
"""

from __future__ import annotations

import hashlib
from functools import cached_property
from typing import Annotated, Literal, Self, overload

import numpy as np
import shapely
from pydantic import Field, model_validator
from tactomo_protocol import Channel

from tactomo_models.arrays import BoolArray, FloatArray, Image, IntArray
from tactomo_models.sensor.companion import Companion
from tactomo_models.sensor.mount import Mount
from tactomo_models.sensor.outline import Pad, RimElectrode
from tactomo_models.sensor.pattern import Pairs, combined, ring_pairs
from tactomo_models.sensor.response import MagnitudeChannel, StructureChannel
from tactomo_models.sensor.section import Name, Section, spelt
from tactomo_models.sensor.sheet import Electrodes, Sheet, check_electrodes, placed_electrodes
from tactomo_models.sensor.wavefront import Triangles

Electrode = Annotated[int, Field(ge=0, le=63)]
PairList = Annotated[
    tuple[Annotated[tuple[Electrode, Electrode], Field(strict=False)], ...],
    Field(min_length=1, max_length=256, strict=False),
]

MAX_TABLE_BYTES = 2_000_000_000
"""Of a sensor's influence tables, which grow as the square of the map's nodes."""

MAX_CELL_RATIO = 4
MIN_NODES = 100
"""Of a map on a polygon: a grid of ten by ten, the least of another sheet, has as many."""


class Pattern(Section):
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


class Instrument(Section):
    """What the device that reads the electrodes makes of their voltages.

    `unsigned` ones are sizes, as of a peak or RMS detector: see `signs`. A converter that reads
    nothing of voltages below zero has `positive` ones, or `negative` ones where it is connected the
    other way round. `single_ended` readings, of each electrode against the one that the current
    leaves by, are the `matrix` protocol's. `regularisation` is a factor on what the linear methods
    choose by the noise: above 1 where a device has larger errors than noise. By `stability`, a
    share, voltages at rest change since the tare beyond noise: no more than that is no press.
    """

    voltages: Literal["signed", "unsigned", "positive", "negative"] = "signed"
    referenced: Literal["pairs", "single_ended"] = "pairs"
    volts_per_unit: Annotated[float, Field(gt=0, le=1e6)] = 1.0
    regularisation: Annotated[float, Field(ge=1e-3, le=1e6)] = 1.0
    stability: Annotated[float, Field(ge=0, le=0.1)] = 0.003
    start: Annotated[str, Field(max_length=16), spelt(r"[ -~\r\n]*", "give ASCII characters")] = ""
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


class MapGrid(Section):
    """Nodes of the published map along x and y; the outermost lie on the bounding box."""

    nodes_x: Annotated[int, Field(ge=11, le=401)] = 51
    nodes_y: Annotated[int, Field(ge=11, le=401)] = 51


class SensorDescription(Section):
    """A whole sensor: sheet, electrodes, pattern, map and the channels' contact response."""

    schema_version: Literal[1] = Field(alias="schema")
    name: Name
    title: str = ""
    sheet: Sheet
    electrodes: Electrodes
    pattern: Pattern
    instrument: Instrument = Instrument()
    map: MapGrid = MapGrid()
    magnitude: MagnitudeChannel | None = None
    structure: StructureChannel | None = None
    mount: Mount | None = None
    companion: Annotated[dict[Name, Companion], Field(max_length=16, default_factory=dict)]

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        if self.magnitude is None and self.structure is None:
            raise ValueError("give at least one of [magnitude.response] and [structure]")
        check_electrodes(self.sheet, self.electrodes)
        if not 6 <= self.electrode_count <= 64:
            raise ValueError(f"electrodes: {self.electrode_count} in all; 6 to 64 are supported")
        for key in ("drive_offset", "measure_offset"):
            offset = getattr(self.pattern, key)
            if offset >= self.electrode_count:
                raise ValueError(
                    f"pattern.{key} = {offset}: must be below the number of electrodes, "
                    f"{self.electrode_count}"
                )
        if len(self.companion_indices) < len(self.companion):
            numbered = {k: v.index for k, v in self.companion.items() if v.index is not None}
            raise ValueError(
                f"companion: two share an index, {numbered or 'none'}: give each its own index, "
                "by which the device's packets name it"
            )
        self._check_listed_pairs()
        self._check_size()
        if self.mount is not None:
            x_m, y_m = (each.ravel() for each in np.meshgrid(self.map_x_m, self.map_y_m))
            nodes_m = np.stack([x_m, y_m], axis=-1)[self.on_sheet(x_m, y_m)]
            self.mount.check(self.sheet.size_m, nodes_m)
        for name, companion in self.companion.items():
            if companion.region_m is not None:
                region = shapely.Polygon(companion.region_m)
                if region.intersection(self.sheet.outline.polygon).area == 0:
                    raise ValueError(
                        f"companion.{name}.region_m lies off the sheet and feels nothing: move it, "
                        "or leave it out for the whole sheet"
                    )
        if self.off_sheet is not None and (~self.off_sheet).sum() < MIN_NODES:
            raise ValueError(
                f"map: {(~self.off_sheet).sum()} of its nodes lie on the sheet, and {MIN_NODES} "
                "are needed: give more nodes_x and nodes_y"
            )
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
        # Around electrodes, long triangles are halved until they are small in both directions.
        x_m, y_m = self.width_m / (self.map.nodes_x - 1), self.height_m / (self.map.nodes_y - 1)
        if max(x_m, y_m) > MAX_CELL_RATIO * min(x_m, y_m):
            raise ValueError(
                f"map: its nodes are {x_m * 1e3:g} mm apart along x and {y_m * 1e3:g} mm along y, "
                f"more than {MAX_CELL_RATIO} times as far; give nodes in proportion to the sheet"
            )

    @property
    def width_m(self) -> float:
        """Width of the bounding box."""
        return self.sheet.size_m[0]

    @property
    def height_m(self) -> float:
        """Height of the bounding box."""
        return self.sheet.size_m[1]

    @property
    def spacing_m(self) -> float:
        """Distance of the map's nodes along x, and about that of the mesh's."""
        return self.width_m / (self.map.nodes_x - 1)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The channels this sensor has, magnitude first."""
        both: tuple[Channel, ...] = (Channel.MAGNITUDE, Channel.STRUCTURE)
        return tuple(name for name in both if getattr(self, name) is not None)

    def strongest_ratio(self, channel: Channel) -> float:
        """Factor on a channel's conductivity where it is pressed hardest; never 1."""
        if channel == Channel.MAGNITUDE:
            assert self.magnitude is not None
            return 1 + self.magnitude.response.relative_change[-1]
        assert self.structure is not None
        return self.structure.saturated_ratio

    def contrast(self, channel: Channel) -> float:
        """The same as a factor above 1, up or down."""
        ratio = self.strongest_ratio(channel)
        return max(ratio, 1 / ratio)

    def sign(self, channel: Channel) -> float:
        """1.0 where pressing makes a channel conduct better, -1.0 where worse."""
        return 1.0 if self.strongest_ratio(channel) > 1 else -1.0

    def either_way(self, channel: Channel) -> bool:
        """Whether objects may conduct better or worse than the sheet."""
        return (
            channel == Channel.STRUCTURE
            and self.structure is not None
            and self.structure.either_way
        )

    @property
    def electrode_count(self) -> int:
        """Number of electrodes of one sheet."""
        return self.electrodes.total

    def __eq__(self, other: object) -> bool:
        """Descriptions are equal by what they say, whatever has been worked out from them."""
        if not isinstance(other, SensorDescription):
            return NotImplemented
        return self is other or self.model_dump() == other.model_dump()

    def __hash__(self) -> int:
        return hash(self.sha256)

    @cached_property
    def companion_indices(self) -> dict[int, str]:
        """The names of the companions by the index in the device's packets."""
        return {
            place if companion.index is None else companion.index: name
            for place, (name, companion) in enumerate(self.companion.items())
        }

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
    def placed_electrodes(self) -> list[RimElectrode | Pad]:
        """Where each electrode lies."""
        return placed_electrodes(self.sheet, self.electrodes)

    @cached_property
    def electrode_ends_m(self) -> FloatArray:
        """Both ends of every electrode, counter-clockwise on the outer rim: (electrodes, 2, 2).

        A pad ends at its left and its right.
        """
        outline = self.sheet.outline
        return np.stack(
            [
                outline.at(each.ring, each.ends_m())
                if isinstance(each, RimElectrode)
                else np.add(each.centre_m, [[-each.radius_m, 0.0], [each.radius_m, 0.0]])
                for each in self.placed_electrodes
            ]
        )

    @property
    def electrode_centres_m(self) -> FloatArray:
        """Centre of every electrode, (electrodes, 2)."""
        return np.asarray(self.electrode_ends_m.mean(axis=1))

    @cached_property
    def pad_radii_m(self) -> FloatArray:
        """Radius of every pad, (electrodes,); NaN of an electrode on a rim."""
        placed = self.placed_electrodes
        return np.array([each.radius_m if isinstance(each, Pad) else np.nan for each in placed])

    @cached_property
    def rim_order(self) -> IntArray:
        """Place of each electrode round the outer rim, from 0, (electrodes,); -1 elsewhere."""
        length_m = self.sheet.outline.lengths_m[0]
        along = {
            number: each.middle_m % length_m
            for number, each in enumerate(self.placed_electrodes)
            if isinstance(each, RimElectrode) and each.ring == 0
        }
        order = np.full(self.electrode_count, -1)
        order[sorted(along, key=along.__getitem__)] = np.arange(len(along))
        return order

    @cached_property
    def off_sheet(self) -> BoolArray | None:
        """Nodes of the map (nodes_y, nodes_x) off a polygon, which maps leave NaN; else None."""
        if self.sheet.shape != "polygon":
            return None
        return ~self.on_sheet(*np.meshgrid(self.map_x_m, self.map_y_m))

    @overload
    def shown(self, image: FloatArray | Image) -> Image: ...

    @overload
    def shown(self, image: None) -> None: ...

    def shown(self, image: FloatArray | Image | None) -> Image | None:
        """An image (nodes_y, nodes_x) as frames show it: NaN where `off_sheet`."""
        if image is None or self.off_sheet is None:
            return None if image is None else np.asarray(image, np.float32)
        return np.where(self.off_sheet, np.float32(np.nan), image).astype(np.float32)

    @cached_property
    def map_x_m(self) -> FloatArray:
        """X of the map's columns, (nodes_x,)."""
        return np.linspace(-self.width_m / 2, self.width_m / 2, self.map.nodes_x)

    @cached_property
    def map_y_m(self) -> FloatArray:
        """Y of the map's rows, (nodes_y,); row 0 is the lowest."""
        return np.linspace(-self.height_m / 2, self.height_m / 2, self.map.nodes_y)

    def on_sheet(self, x_m: FloatArray, y_m: FloatArray, margin_m: float = 0.0) -> BoolArray:
        """Tell which points lie on the sheet, at least `margin_m` inside its rim."""
        slack = 1e-9
        return np.asarray(self.sheet.outline.depth(x_m, y_m) >= margin_m - slack)

    @property
    def stretching(self) -> Triangles | None:
        """The surface that stretches the sheet; None where it is flat, or bent alone."""
        surface = self.mount.surface if self.mount else None
        return surface.triangles if surface and surface.is_stretched else None

    def area_factor(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """Areas on the surface over those on the sheet, at places; of their shape."""
        if self.stretching is None:
            return np.ones(np.shape(x_m))
        places = np.column_stack([np.ravel(x_m), np.ravel(y_m)])
        covering, _ = self.stretching.covering(places)
        return np.asarray(self.stretching.stretches[covering].prod(axis=1).reshape(np.shape(x_m)))

    @cached_property
    def sha256(self) -> str:
        """Hash of what the physics depends on; calibration tables may change without a rebuild."""
        unlisted = {key for key in ("drive", "measure") if getattr(self.pattern, key) is None}
        parts = dict.fromkeys(("schema_version", "sheet", "electrodes", "pattern", "map"), True)
        by_surface = {"mount": {"surface": {"obj": True}}} if self.stretching else {}
        physics = self.model_dump_json(
            include={**parts, **by_surface},
            exclude={  # hashes are older than these keys
                "pattern": unlisted,
                "sheet": {key for key in ("outline_m", "holes_m") if not getattr(self.sheet, key)},
                "electrodes": {
                    key
                    for key in ("positions_m", "pad_radius_m", "clockwise")
                    if not getattr(self.electrodes, key)
                },
            },
        )
        return hashlib.sha256(physics.encode()).hexdigest()

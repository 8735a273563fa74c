"""A load cell's log (CSV) and what a sensor showed at those times, joined to calibration readings.

docs/files.md has the columns. A log of many lines a second is cut into pieces in which the load was
still. So is one line for each press, by hand.
"""

from __future__ import annotations

import csv
import io
import sys
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, get_args

import numpy as np
from numpy.typing import NDArray

from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.calibration.curve import APART, Direction, Reading, direction_at, refuse_mpa
from tactomo_models.errors import CalibrationError, os_errors_as
from tactomo_models.foreign_file import read_regular

MAX_BYTES: Final = 16 << 20  # an hour of lines at 1 kHz
WINDOW_S: Final = 0.5  # of a log: the load is to be still for so long
MAX_NUMBER: Final = 1e12  # of any kind: seconds since 1970 are 2e9, and squares stay finite
UNLOADED_KPA: Final = 1.0  # a load cell at rest
DISAGREES: Final = 0.1  # of a pressure: more is no rounding of it, nor of an indenter's diameter
CLOCKS: Final = ("time_s", "realtime_s")


@dataclass(frozen=True)
class LoadCell:
    """What a load cell said, line by line."""

    lines: NDArray[np.int64]  # (n,) numbers of the lines in the file
    pressure_kpa: FloatArray  # (n,)
    clock: str  # "time_s", "realtime_s", or "" without times
    times_s: FloatArray  # (n,) by that clock; NaN without
    # magnitude, magnitude_sigma: (n,) what the sensor showed; NaN without
    magnitude: FloatArray
    magnitude_sigma: FloatArray
    contact_mm2: FloatArray  # (n,) area that it showed; NaN without
    indenter_mm2: FloatArray  # (n,) area of the indenter; NaN without
    directions: tuple[Direction, ...]  # n of them, or none

    def direction(self, index: int) -> Direction:
        """Of the load at a line: by its column, or by the lines before."""
        return self.directions[index] if self.directions else direction_at(self.pressure_kpa, index)


@dataclass(frozen=True)
class Seen:
    """What a sensor showed, frame by frame."""

    times_s: FloatArray  # (n,) rising, by the load cell's clock
    # magnitude, magnitude_sigma: (n,) of the only contact; NaN where there is none or several
    magnitude: FloatArray
    magnitude_sigma: FloatArray
    contact_mm2: FloatArray  # (n,) its area, likewise
    contacts: NDArray[np.int64]  # (n,) how many there were


@dataclass(frozen=True)
class Joined:
    """Readings, the number of the first line of each, and in words what was left out of them."""

    readings: tuple[Reading, ...]
    lines: tuple[int, ...]
    notes: tuple[str, ...]


def read_load_cell(
    path: Path,  # the CSV file
    area_mm2: float | None = None,  # of the indenter, where the file does not say
) -> LoadCell:
    """Read a load cell's log.

    Raises:
        CalibrationError: it cannot be read, a column is missing, or a value is no such number.
    """
    table = _Table(path)
    clock = next((name for name in CLOCKS if name in table.columns), "")
    pressure = table.pressures_kpa(area_mm2)
    if pressure.any():  # in MPa, all of them would count as unloaded
        refuse_mpa(float(pressure.max()))
    indenter_mm2 = table.areas_mm2(area_mm2)
    times_s = table.numbers(clock) if clock else table.unknown
    if clock and np.any(np.diff(times_s) < 0):
        worst = int(np.argmin(np.diff(times_s))) + 1
        raise CalibrationError(
            f"{path}, line {table.lines[worst]}: {clock} goes back; sort the lines by their times"
        )
    return LoadCell(
        lines=np.array(table.lines),
        pressure_kpa=pressure,
        clock=clock,
        times_s=times_s,
        magnitude=table.optional("magnitude"),
        magnitude_sigma=np.nan_to_num(table.optional("magnitude_sigma", least=0.0)),
        contact_mm2=table.optional("contact_mm2", least=0.0),
        indenter_mm2=table.unknown if indenter_mm2 is None else indenter_mm2,
        directions=table.directions(),
    )


def direct_readings(cell: LoadCell) -> Joined:
    """Readings of a log that has the magnitudes itself."""
    loaded = np.flatnonzero(cell.pressure_kpa > UNLOADED_KPA)
    for i in loaded:
        if cell.magnitude[i] < 0:
            raise CalibrationError(
                f"line {cell.lines[i]}: magnitude is below 0; give the size of the relative "
                "change, without sign"
            )
    readings = [
        Reading(
            pressure_kpa=float(cell.pressure_kpa[i]),
            magnitude=float(cell.magnitude[i]),
            magnitude_sigma=float(cell.magnitude_sigma[i]),
            direction=cell.direction(int(i)),
        )
        for i in loaded
    ]
    readings = _of_one_area(readings, cell.contact_mm2[loaded], cell.indenter_mm2[loaded])
    left = len(cell.lines) - len(loaded)
    notes = (f"{left} lines without a load left out",) if left else ()
    return Joined(tuple(readings), tuple(cell.lines[loaded].tolist()), notes)


def joined_readings(cell: LoadCell, seen: Seen) -> Joined:
    """Readings of a log that has times, and what a sensor showed at those.

    Raises CalibrationError where at most of the times there was no contact, or more than one.
    """
    pieces = _still_pieces(cell)
    if not pieces:
        raise CalibrationError(
            "nothing was held still under a load for half a second; hold each press longer"
        )
    found = [(piece[0], _reading(cell, piece, seen)) for piece in pieces]
    read = [(first, *one) for first, one in found if not isinstance(one, str)]
    missed = [f"line {cell.lines[first]}, {why}" for first, why in found if isinstance(why, str)]
    if len(missed) > len(read):
        raise CalibrationError(
            f"{len(missed)} of {len(pieces)} presses are not in the recording as one still "
            f"contact, such as {missed[0]}; it runs from {seen.times_s.min():.1f} to "
            f"{seen.times_s.max():.1f} s by that clock: are both of one time? --time-offset "
            "shifts the load cell's"
        )
    notes = (f"{len(missed)} presses left out, such as {missed[0]}",) if missed else ()
    firsts, readings, contact_mm2 = (list(each) for each in zip(*read, strict=True))
    readings = _of_one_area(readings, np.array(contact_mm2), cell.indenter_mm2[firsts])
    return Joined(tuple(readings), tuple(cell.lines[firsts].tolist()), notes)


def _of_one_area(
    readings: list[Reading], contact_mm2: FloatArray, indenter_mm2: FloatArray
) -> list[Reading]:
    """Magnitudes over the area that one indenter typically shows.

    An indenter always presses the same area: where a reading shows it too small, its magnitude is
    too large, and the other way round. Of their product, scatter is a third of the magnitude's.
    """
    least = 3  # readings that tell what is typical
    # 68 % of simulated readings err by less than half of what a magnitude by itself is unsure of:
    # by 0.023 for 0.050 at 40 dB, 0.038 for 0.080 at 20 dB, 0.028 for 0.064 on hand-made skins.
    still_unsure = 0.5
    for size in np.unique(indenter_mm2):
        own = np.flatnonzero((indenter_mm2 == size) | (np.isnan(indenter_mm2) & np.isnan(size)))
        own = own[contact_mm2[own] > 0]
        if len(own) < least:
            continue
        typical_mm2 = np.median(contact_mm2[own])
        for i in own:
            share = float(contact_mm2[i] / typical_mm2)
            magnitude, sigma = readings[i].magnitude, readings[i].magnitude_sigma
            readings[i] = readings[i].model_copy(
                update={
                    "magnitude": share * magnitude,
                    "magnitude_sigma": still_unsure * share * sigma,
                }
            )
    return readings


class _Table:
    """The file's cells by line and column."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.lines = array("q")  # the number of each row's line
        self.columns: list[str] = []  # their names
        cells_of: list[list[str]] = []  # each column
        delimiter = ""
        for number, line in _lines(path):
            delimiter = delimiter or max(",;\t", key=line.count)
            try:
                (cells,) = csv.reader([line], delimiter=delimiter, strict=True)
            except (csv.Error, ValueError) as error:
                raise CalibrationError(f"{path}, line {number}: {error}; correct it") from error
            if len(cells) < len(self.columns):
                raise CalibrationError(
                    f"{path}, line {number} has {len(cells)} of {len(self.columns)} columns; "
                    "complete it, or leave it out"
                )
            if self.columns:
                self.lines.append(number)
                for column, cell in zip(cells_of, cells, strict=False):
                    column.append(sys.intern(cell.strip()))  # logs say the same again and again
            else:
                self.columns = [cell.strip().lower() for cell in cells]
                if not {"magnitude", *CLOCKS} & set(self.columns):
                    raise CalibrationError(
                        f"{path} has no column magnitude, and no {' or '.join(CLOCKS)} by which to "
                        f"find it in a recording; it has: {', '.join(self.columns)}"
                    )
                cells_of = [[] for _ in cells]
        if not self.lines:
            raise CalibrationError(
                f"{path} holds no readings; give a line of column names, and a line for each"
            )
        self._cells = dict(zip(self.columns, cells_of, strict=True))
        self.unknown = np.full(len(self.lines), np.nan)  # NaN for each row

    def numbers(self, column: str, least: float = -MAX_NUMBER) -> FloatArray:
        values = np.empty(len(self.lines))
        for i, cell in enumerate(self._cells[column]):
            try:
                values[i] = float(cell)
            except (TypeError, ValueError):
                raise self._bad(i, column, "is no number") from None
            if not least <= values[i] <= MAX_NUMBER:
                raise self._bad(i, column, "is out of range")
        return values

    def optional(self, column: str, least: float = -MAX_NUMBER) -> FloatArray:
        return self.numbers(column, least) if column in self.columns else self.unknown

    def pressures_kpa(self, area_mm2: float | None) -> FloatArray:
        areas_mm2 = self.areas_mm2(area_mm2)
        if "pressure_kpa" in self.columns:
            told = np.maximum(self.numbers("pressure_kpa"), 0.0)
            if "force_n" in self.columns and areas_mm2 is not None:
                self._check_forces(told, areas_mm2)
            return told
        if "force_n" not in self.columns:
            raise CalibrationError(
                f"{self._path} has no column pressure_kpa, and no force_n; it has: "
                f"{', '.join(self.columns)}"
            )
        if areas_mm2 is None:
            raise CalibrationError(
                f"{self._path} has forces and no area_mm2 or diameter_mm of the indenter; add a "
                "column, or give --diameter-mm or --area-mm2"
            )
        # A load cell at rest says a little less than nothing now and then.
        return np.maximum(1e3 * self.numbers("force_n") / areas_mm2, 0.0)

    def _check_forces(self, told_kpa: FloatArray, areas_mm2: FloatArray) -> None:
        """Refuse pressures that are not the forces over the indenter's area."""
        loaded = told_kpa > UNLOADED_KPA
        by_force_kpa = (1e3 * self.numbers("force_n") / areas_mm2)[loaded]
        if not len(by_force_kpa):
            return
        ratio = float(np.median(by_force_kpa / told_kpa[loaded]))
        if abs(ratio - 1) > DISAGREES:
            raise CalibrationError(
                f"{self._path}: force_n over the indenter's area is {ratio:.3g} times "
                "pressure_kpa; correct the column that is wrong, or leave it out"
            )

    def areas_mm2(self, area_mm2: float | None) -> FloatArray | None:
        """Area of the indenter at each line; None where nobody says."""
        if "area_mm2" in self.columns:
            return self.numbers("area_mm2", least=1.0)
        if "diameter_mm" in self.columns:
            return np.pi / 4 * self.numbers("diameter_mm", least=1.0) ** 2
        return None if area_mm2 is None else np.full(len(self.lines), area_mm2)

    def directions(self) -> tuple[Direction, ...]:
        if "direction" not in self.columns:
            return ()
        for i, cell in enumerate(self._cells["direction"]):
            if cell not in get_args(Direction):
                raise self._bad(i, "direction", "is not up, down or unknown")
        return tuple(self._cells["direction"])  # type: ignore[arg-type]

    def _bad(self, i: int, column: str, why: str) -> CalibrationError:
        value = self._cells[column][i]
        return CalibrationError(
            f"{self._path}, line {self.lines[i]}: {column} = {value!r} {why}; correct it, or "
            "leave the line out"
        )


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """The numbers and texts of the file's lines that are neither empty nor comments."""
    try:
        with os_errors_as(CalibrationError, f"cannot read {path}", "give a CSV file"):
            text = read_regular(path, MAX_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CalibrationError(f"{path} is not text; give a CSV file in UTF-8") from error
    for number, line in enumerate(io.StringIO(text, newline=None), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line.rstrip("\n")


def _still_pieces(cell: LoadCell) -> list[IntArray]:
    """Lines that belong to one still load each."""
    top = float(cell.pressure_kpa.max())
    loaded = np.flatnonzero(cell.pressure_kpa > max(UNLOADED_KPA, APART * top))
    window = np.floor(cell.times_s / WINDOW_S)
    pieces: list[IntArray] = []
    for number in np.unique(window[loaded]):
        lines = loaded[window[loaded] == number]
        if np.ptp(cell.pressure_kpa[lines]) > APART * top:
            continue
        before = pieces[-1] if pieces else None
        if before is not None and _goes_on(cell, before, lines, top):
            pieces[-1] = np.concatenate([before, lines])
        else:
            pieces.append(lines)
    return pieces


def _goes_on(cell: LoadCell, before: IntArray, lines: IntArray, top: float) -> bool:
    """Whether a load is held on from one window into the next."""
    near = cell.times_s[lines[0]] - cell.times_s[before[-1]] < WINDOW_S
    change = cell.pressure_kpa[lines].mean() - cell.pressure_kpa[before].mean()
    return bool(near and abs(change) < APART / 2 * top)


def _reading(cell: LoadCell, piece: IntArray, seen: Seen) -> tuple[Reading, float] | str:
    """What the sensor showed of one still load, and its area in mm^2; or why nobody knows."""
    first, last = cell.times_s[piece[0]], cell.times_s[piece[-1]]
    at = (seen.times_s >= first - WINDOW_S / 2) & (seen.times_s <= last + WINDOW_S / 2)
    when = f"{first:.1f} s"
    if not at.any():
        return f"{when}: no frame"
    single = at & (seen.contacts == 1)
    if 2 * single.sum() <= at.sum():
        several = int(seen.contacts[at].max())
        return f"{when}: {several} contacts" if several > 1 else f"{when}: no contact"
    magnitude, sigma = seen.magnitude[single], seen.magnitude_sigma[single]
    if not np.all(np.isfinite(magnitude)):
        return f"{when}: the magnitude channel is missing"
    reading = Reading(
        pressure_kpa=float(cell.pressure_kpa[piece].mean()),
        magnitude=float(magnitude.mean()),
        magnitude_sigma=float(np.nan_to_num(sigma).mean()),
        direction=cell.direction(int(piece[0])),
    )
    return reading, float(seen.contact_mm2[single].mean())

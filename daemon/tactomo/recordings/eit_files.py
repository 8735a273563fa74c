"""Frames that Sciospec's own program saved: one ``.eit`` file of text each.

The first line says how many lines the header has (9, 11 or 18), and, but for the oldest, the
second one the version. Then come a name, the date, the least and the greatest frequency, its scale,
how many frequencies, the amplitude in A and the frames a second. After the header there are two
lines for each injection: source and sink, numbered from 1, and the potential of every channel
against ground in volts, real and imaginary part by turns, with tabs between them. A header of 18
lines names the channels that were measured; other columns are left out.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tactomo_models.foreign_file import read_regular

from tactomo.errors import TactomoError, os_errors_as

SUFFIX: Final = ".eit"
HEADERS: Final = (9, 11, 18)
MEASURED: Final = "MeasurementChannels"
MAX_BYTES: Final = 1 << 24
MAX_CHANNELS: Final = 256  # of Sciospec's largest instrument
MAX_LINES: Final = 2 * MAX_CHANNELS**2
_DATES: Final = ("%Y.%m.%d. %H:%M:%S.%f", "%Y.%m.%d. %H:%M:%S")
_ANOTHER: Final = "is it a Sciospec file? Other programs have a format of that name, too"


class _Frame(NamedTuple):
    injection: list[tuple[int, int]]
    volts: NDArray[np.complex128]  # (injections, channels)
    time_s: float


def eit_files(folder: Path) -> list[Path]:
    """Return the .eit files in a folder, by name; raise TactomoError where there is none."""
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() == SUFFIX)
    if not found:
        raise TactomoError(f"{folder} holds no {SUFFIX} file", "give the folder that has them")
    return found


def read_eit_files(paths: Sequence[Path]) -> dict[str, NDArray[Any]]:
    """Return the frames of .eit files in the order of their dates.

    `volts` (T, injections, channels) complex, `injection` (injections, 2) from 1, `t` (T,) seconds
    since 1970, as if the dates in the files were UTC. Raises TactomoError, which names the line,
    where one of them cannot be read, is none, or is of another measurement.
    """
    frames = [_read(path) for path in paths]
    for path, frame in zip(paths, frames, strict=True):
        if frame.injection != frames[0].injection or frame.volts.shape != frames[0].volts.shape:
            raise TactomoError(
                f"{path} and {paths[0]} have different injections or channels",
                "import each measurement by itself",
            )
    frames.sort(key=lambda frame: frame.time_s)
    return {
        "volts": np.array([frame.volts for frame in frames]),
        "injection": np.array(frames[0].injection),
        "t": np.array([frame.time_s for frame in frames]),
    }


def _read(path: Path) -> _Frame:
    step = f"give the path of a {SUFFIX} file"
    try:
        with os_errors_as(TactomoError, f"cannot read {path}", step):
            text = read_regular(path, MAX_BYTES).decode("ascii").rstrip()
    except UnicodeDecodeError as error:
        raise TactomoError(f"{path} is not text", _ANOTHER) from error
    if text.count("\n") > MAX_LINES:
        raise TactomoError(f"{path} has more than {MAX_LINES} lines", _ANOTHER)
    return _Lines(path, text.split("\n")).frame()


class _Lines:
    """The lines of one file, each with its number for whoever has to correct it."""

    def __init__(self, path: Path, lines: list[str]) -> None:
        self._path = path
        self._lines = lines

    def frame(self) -> _Frame:
        header = self._number(1, "the number of header lines")
        if header not in HEADERS:
            said = f"{header:g}, not {' or '.join(map(str, HEADERS))} header lines"
            raise self._wrong(1, said, _ANOTHER)
        first = 2 if header == HEADERS[0] else 3  # the line of the name
        frequencies = self._number(first + 5, "the number of frequencies")
        if frequencies != 1:
            raise self._wrong(
                first + 5, f"{frequencies:g} frequencies", "save one frequency in a file"
            )
        time_s = self._date(first + 1)
        injection: list[tuple[int, int]] = []
        volts: list[NDArray[np.complex128]] = []
        for number in range(int(header) + 1, len(self._lines) + 1, 2):
            injection.append(self._pair(number))
            volts.append(self._potentials(number + 1, len(volts[0]) if volts else None))
        if not injection:
            raise self._wrong(int(header) + 1, "no injection", "it was cut off: save it anew")
        return self._measured(int(header), _Frame(injection, np.array(volts), time_s))

    def _measured(self, header: int, frame: _Frame) -> _Frame:
        """Leave out the channels that the header does not name, and number the others from 1."""
        for number in range(1, header + 1):
            word, _, listed = self._text(number).partition(":")
            channels = [int(digits) for digits in re.findall(r"\d+", listed)]
            if word != MEASURED or not channels:
                continue
            columns = frame.volts.shape[1]
            if columns == len(channels):
                places = list(range(columns))
            elif 0 < min(channels) <= max(channels) <= columns:
                places = [channel - 1 for channel in channels]
            else:
                raise self._wrong(number, f"{len(channels)} channels, and {columns} were saved")
            electrode = {channel: n for n, channel in enumerate(channels, start=1)}
            try:
                injection = [(electrode[a], electrode[b]) for a, b in frame.injection]
            except KeyError as error:
                raise self._wrong(
                    number,
                    f"channel {error} is injected at, not measured",
                    "measure all electrodes",
                ) from None
            return frame._replace(injection=injection, volts=frame.volts[:, places])
        return frame

    def _text(self, number: int) -> str:
        if number > len(self._lines):
            raise self._wrong(number, "the file ends before it", "it was cut off: save it anew")
        return self._lines[number - 1].strip()

    def _number(self, number: int, what: str) -> float:
        try:
            return float(self._text(number))
        except ValueError:
            raise self._wrong(number, f"{what} is no number", _ANOTHER) from None

    def _date(self, number: int) -> float:
        for form in _DATES:
            with suppress(ValueError):
                moment = datetime.strptime(self._text(number), form)
                return moment.replace(tzinfo=UTC).timestamp()
        raise self._wrong(number, "it is no date such as 2024.01.31. 12:30:05.250")

    def _pair(self, number: int) -> tuple[int, int]:
        try:
            source, sink = map(int, self._text(number).split())
        except ValueError:
            raise self._wrong(number, "this is not an injection, such as 1 2") from None
        if not min(source, sink) >= 1 or source == sink:
            raise self._wrong(number, f"{source} {sink} is no injection")
        return source, sink

    def _potentials(self, number: int, count: int | None) -> NDArray[np.complex128]:
        words = self._text(number).split(maxsplit=2 * MAX_CHANNELS)
        if len(words) > 2 * MAX_CHANNELS:
            raise self._wrong(number, f"more than {MAX_CHANNELS} channels", _ANOTHER)
        try:
            values = np.array([float(each) for each in words])
        except ValueError:
            raise self._wrong(number, "a value is not a number") from None
        if len(values) % 2 or not len(values) or (count is not None and len(values) != 2 * count):
            wanted = "pairs of numbers" if count is None else f"{2 * count} numbers"
            raise self._wrong(number, f"{len(values)} numbers, not {wanted}")
        if not np.isfinite(values).all():
            raise self._wrong(number, "a value is not a finite number")
        return values.view(np.complex128)

    def _wrong(self, number: int, cause: str, next_step: str = "save it anew") -> TactomoError:
        return TactomoError(f"{self._path}, line {number}: {cause}", next_step)

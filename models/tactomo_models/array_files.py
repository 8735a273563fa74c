"""Arrays of numbers in files of other programs: MATLAB's .mat, text, and .get of EIT instruments.

The layout of .get is that of Goettingen's, Viasys' and Draeger's early instruments, 16 electrodes,
adjacent pairs, as EIDORS reads it (eidors_readdata.m, mceit and draeger-get): 256 floats a frame,
of which 208 are voltages, each drive's from the pair behind it on; 0 where a reciprocal one was not
measured.
"""

from __future__ import annotations

import pickle
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactomo_models.errors import DataError

Arrays = dict[str, NDArray[Any]]

NUMBERS: Final = "numbers"  # the one array of a file that names none
VIA_MATLAB: Final = "read it with EIDORS' eidors_readdata, then save('frames.mat', 'vv', '-v7')"
_GET_FLOATS: Final = 256
_UCT_MAGIC: Final = bytes([0x88] * 4)
_LARGEST: Final = 1e9  # in any unit of voltage; of other bytes, read as floats, some are larger


def read_matlab(path: Path) -> Arrays:
    """Read the numbers of a .mat file, those in structs as `struct.field`.

    A cell of one array is that array. Version 7.3 needs h5py.

    Raises:
        OSError: the file cannot be read.
        DataError: it is damaged, or h5py is missing.
    """
    from scipy.io import loadmat

    with path.open("rb") as file:
        hdf5 = b"MATLAB 7.3" in file.read(128)
        if hdf5 and not find_spec("h5py"):
            raise DataError(
                f"{path} is a .mat of version 7.3, which needs h5py; pip install "
                f"'tactomo[matlab]', or in MATLAB: x = load('{path.name}'); "
                f"save('{path.name}', '-struct', 'x', '-v7')"
            )
        file.seek(0)
        try:
            return dict(_numbers("", _hdf5(path) if hdf5 else loadmat(file)))
        except Exception as error:  # a flipped bit makes the parsers raise almost anything
            raise DataError(
                f"cannot read {path}: damaged, or no .mat file; save it anew"
            ) from error


def _hdf5(path: Path) -> Arrays:
    program = Path(__file__).with_name("matlab_hdf5.py")
    ended = subprocess.run([sys.executable, program, path], capture_output=True, check=True)
    return dict(pickle.loads(ended.stdout))


def _numbers(prefix: str, held: Mapping[str, Any]) -> Iterator[tuple[str, NDArray[Any]]]:
    for name, value in held.items():
        array = value.toarray() if hasattr(value, "toarray") else np.asarray(value)
        if name.startswith("__"):
            continue
        if array.dtype.names and array.size == 1:  # a struct
            fields = {field: array[field].flat[0] for field in array.dtype.names}
            yield from _numbers(f"{prefix}{name}.", fields)
        elif array.dtype == object and array.size == 1:  # a cell
            yield from _numbers(prefix, {name: array.flat[0]})
        elif array.dtype.kind in "biufc" and array.size:
            yield prefix + name, array


def read_text(path: Path) -> Arrays:
    """Read rows of numbers as `numbers` (rows, columns), after any lines of header.

    Commas, semicolons, tabs or spaces part them; a comma is a decimal one beside semicolons.

    Raises:
        OSError: the file cannot be read.
        DataError: it holds no rows of numbers of one length.
    """
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise DataError(f"{path} is not text; export numbers, one frame a line") from error
    rows: list[list[complex]] = []
    for number, line in enumerate(lines, start=1):
        line = re.split("[#%]", line, maxsplit=1)[0]
        if ";" in line:
            line = line.replace(",", ".")
        tokens = re.split(r"\s*[,;]\s*|\s+", line.strip(" \t,;"))
        if tokens == [""]:
            continue
        try:
            row = [_number(token) for token in tokens]
        except ValueError:
            if not rows:
                continue  # header
            raise DataError(
                f"{path}, line {number}: what is no number; take the line out, or save it anew"
            ) from None
        if rows and len(row) != len(rows[0]):
            raise DataError(
                f"{path}, line {number}: {len(row)} numbers, and {len(rows[0])} in the lines "
                "before; save as many in each line"
            )
        rows.append(row)
    if not rows:
        raise DataError(f"{path} holds no line of numbers; save one frame a line or a column")
    numbers = np.array(rows)
    return {NUMBERS: numbers if numbers.imag.any() else numbers.real}


def _number(token: str) -> complex:
    try:
        return float(token)
    except ValueError:
        return complex(token.replace("i", "j"))


def read_get(path: Path) -> Arrays:
    """Read a .get as `numbers` (T, 208), measuring pairs ascending.

    Raises:
        OSError: the file cannot be read.
        DataError: it is none, or of another instrument.
    """
    data = path.read_bytes()
    if data.startswith(_UCT_MAGIC):
        raise DataError(
            f"{path} is of the University of Cape Town's instrument, whose pattern is in another "
            f"file; {VIA_MATLAB}"
        )
    if data.startswith(b"---Draeger EIT-Software---"):
        data = re.split(rb"(?:\r?\n){3}", data, maxsplit=1)[-1]
    frames = np.frombuffer(data[: len(data) // 4 * 4], "<f4").astype(np.float64)
    frames = frames[: len(frames) // _GET_FLOATS * _GET_FLOATS].reshape(-1, _GET_FLOATS)[:, :208]
    if not frames.any() or not (np.abs(frames) < _LARGEST).all():
        raise DataError(
            f"{path} is no .get of 256 floats a frame (Goettingen, Viasys, Draeger); {VIA_MATLAB}"
        )
    drive, place = np.divmod(np.arange(208), 13)
    square, measured = np.zeros((len(frames), 16, 16)), np.zeros((16, 16), bool)
    measure = (drive + 2 + place) % 16
    square[:, drive, measure], measured[drive, measure] = frames, True
    if not frames[:, 38].any():  # drive 2, pair 0: what drive 0, pair 2 has measured
        square = np.where(np.tri(16, k=-1, dtype=bool), square.transpose(0, 2, 1), square)
    return {NUMBERS: square[:, measured]}


READERS: Final[dict[str, Callable[[Path], Arrays]]] = {
    ".mat": read_matlab,
    ".csv": read_text,
    ".txt": read_text,
    ".tsv": read_text,
    ".dat": read_text,
    ".get": read_get,
}

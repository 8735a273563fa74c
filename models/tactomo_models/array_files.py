"""Arrays of numbers in files of other programs: MATLAB's .mat and text."""

from __future__ import annotations

import io
import pickle
import re
import subprocess
import sys
from array import array
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactomo_models.errors import DataError
from tactomo_models.foreign_file import open_regular

Arrays = dict[str, NDArray[Any]]

NUMBERS: Final = "numbers"  # the one array of a file that names none
MAX_SIZE: Final = 1e30  # of any number, in any unit: what is larger overflows in the work
_DOUBLE: Final = 8  # bytes; smaller numbers cannot be as large, or not once they are doubles
_SMALL_BYTES: Final = 64 << 20
_PACKED: Final = 16
_MAX_ARRAYS: Final = 4096
_MAX_LINE: Final = 1 << 20  # characters of a frame; the largest pattern has 4096 numbers


def read_matlab(path: Path) -> Arrays:
    """Read the numbers of a .mat file, those in structs as `struct.field`.

    A cell of one array is that array. Version 7.3 needs h5py.

    Raises:
        OSError: the file cannot be read.
        DataError: it is damaged, or h5py is missing.
    """
    with open_regular(path) as file:
        if b"MATLAB 7.3" in file.read(128) and not find_spec("h5py"):
            raise DataError(
                f"{path} is a .mat of version 7.3, which needs h5py; pip install "
                f"'tactomo[matlab]', or in MATLAB: x = load('{path.name}'); "
                f"save('{path.name}', '-struct', 'x', '-v7')"
            )
    program = Path(__file__).with_name("matlab_file.py")
    most = str(most_unpacked(path))
    ended = subprocess.run([sys.executable, program, path, most], capture_output=True, check=False)
    if ended.returncode:
        raise DataError(
            f"cannot read {path}: damaged, or no .mat file of numbers, or of more than its size "
            "bears; save it anew"
        )
    return dict(pickle.loads(ended.stdout))


def most_unpacked(path: Path) -> int:
    """Return how many bytes of numbers a packed file is believed to hold: readings pack badly."""
    return max(_SMALL_BYTES, _PACKED * path.stat().st_size)


def check_unpacked(path: Path, size: int, arrays: int) -> None:
    """Raise DataError where a file unpacks to what no file of measured numbers does."""
    most = most_unpacked(path)
    if size > most or arrays > _MAX_ARRAYS:
        raise DataError(
            f"{path} claims {arrays} arrays of {size / 1e6:.0f} MB in all; of a file of its size, "
            f"{_MAX_ARRAYS} of {most / 1e6:.0f} MB are read: save it anew, uncompressed"
        )


def bounded(array: NDArray[Any]) -> NDArray[Any]:
    """Return numbers of which those beyond `MAX_SIZE` are infinite; complex ones are NaN.

    No instrument reads such, and their squares overflow.
    """
    if array.dtype.kind not in "fc" or array.dtype.itemsize < _DOUBLE:
        return array
    parts = (array.real, array.imag) if array.dtype.kind == "c" else (array,)
    ends = [f.reduce(part, axis=None, initial=0.0) for part in parts for f in (np.fmin, np.fmax)]
    if max(np.abs(ends)) <= MAX_SIZE:  # without a copy
        return array
    beyond = np.logical_or.reduce([np.abs(part) > MAX_SIZE for part in parts])
    return np.where(beyond, np.nan if len(parts) > 1 else np.copysign(np.inf, array), array)


def read_text(path: Path) -> Arrays:
    """Read rows of numbers as `numbers` (rows, columns), after any lines of header.

    Commas, semicolons, tabs or spaces part them; a comma is a decimal one beside semicolons.

    Raises:
        OSError: the file cannot be read.
        DataError: it holds no rows of numbers of one length.
    """
    numbers, columns = array("d"), 0  # of each, the real and the imaginary part
    try:
        with open_regular(path) as binary, io.TextIOWrapper(binary, "utf-8-sig") as file:
            for number, line in enumerate(iter(lambda: file.readline(_MAX_LINE), ""), start=1):
                row = _row(path, number, line, bool(columns))
                if not row:
                    continue
                if columns and len(row) != columns:
                    raise DataError(
                        f"{path}, line {number}: {len(row)} numbers, and {columns} in the lines "
                        "before; save as many in each line"
                    )
                columns = len(row)
                numbers.extend(part for each in row for part in (each.real, each.imag))
    except UnicodeDecodeError as error:
        raise DataError(f"{path} is not text; export numbers, one frame a line") from error
    if not columns:
        raise DataError(f"{path} holds no line of numbers; save one frame a line or a column")
    both = np.frombuffer(numbers, np.complex128).reshape(-1, columns)
    return {NUMBERS: both if both.imag.any() else both.real.copy()}


def _row(path: Path, number: int, line: str, has_begun: bool) -> list[complex]:
    """Return a line's numbers; none of a comment, an empty line or a header."""
    if len(line) >= _MAX_LINE:
        raise DataError(f"{path}, line {number}: longer than any frame; export one frame a line")
    line = re.split("[#%]", line, maxsplit=1)[0]
    if ";" in line:
        line = line.replace(",", ".")
    tokens = re.split(r"\s*[,;]\s*|\s+", line.strip(" \t\r\n,;"))
    if tokens == [""]:
        return []
    try:
        return [_number(token) for token in tokens]
    except ValueError:
        if not has_begun:
            return []  # header
        raise DataError(
            f"{path}, line {number}: what is no number; take the line out, or save it anew"
        ) from None


def _number(token: str) -> complex:
    try:
        return float(token)
    except ValueError:
        return complex(token.replace("i", "j"))


READERS: Final[dict[str, Callable[[Path], Arrays]]] = {
    ".mat": read_matlab,
    ".csv": read_text,
    ".txt": read_text,
    ".tsv": read_text,
    ".dat": read_text,
}

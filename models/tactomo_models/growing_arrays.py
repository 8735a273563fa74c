"""Arrays that grow by the row: in files until they are all there, and from there into an .npz.

A file of frames may be larger than the memory, and how many there are may show at its end only.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Final, Self

import numpy as np
from numpy.lib import format as npy

FAST: Final = 1  # of zlib: maps are zeros for the most part, and pack as well as by its 6


class GrowingArrays:
    """The arrays of one .npz file, by name. A context manager: their files go with it.

    Args:
        types: the dtype of each.
        scratch: a folder with room for all of it, uncompressed.
    """

    def __init__(self, types: Mapping[str, Any], scratch: Path) -> None:
        self._undo = contextlib.ExitStack()
        with contextlib.ExitStack() as undo:
            self._arrays = {
                name: _Growing(undo.enter_context(tempfile.TemporaryFile(dir=scratch)), dtype)
                for name, dtype in types.items()
            }
            self._undo = undo.pop_all()

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Remove the files."""
        self._undo.close()

    def append(self, rows: Mapping[str, Any]) -> None:
        """Add a row to each array that is named: a number, or an array of one shape in all rows.

        None is a row of NaN.
        """
        for name, row in rows.items():
            self._arrays[name].append(row)

    def write(
        self,
        output: IO[bytes],  # the .npz file
        shapes: Mapping[str, tuple[int, ...]],  # of rows, where all of an array's may be NaN
        **others: Any,  # further arrays
    ) -> None:
        """Write the archive."""
        with zipfile.ZipFile(output, "w", zipfile.ZIP_DEFLATED, compresslevel=FAST) as archive:
            for name, growing in self._arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                    growing.write(entry, shapes.get(name))
            for name, array in others.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                    npy.write_array(entry, array)


class _Growing:
    """One array in a file. Rows of NaN before the first other one wait until their shape is known.

    It passes by when it is written: a memory map would count all of it as this program's memory.
    """

    def __init__(self, file: IO[bytes], dtype: Any) -> None:
        self._file = file
        self._dtype = np.dtype(dtype)
        self._shape: tuple[int, ...] | None = None  # of a row
        self._rows = 0
        self._written = 0

    def append(self, row: Any) -> None:
        if row is not None:
            values = np.asarray(row, self._dtype)
            self._fill(values.shape)
            self._file.write(values.tobytes())
            self._written += 1
        self._rows += 1

    def write(self, entry: IO[bytes], shape: tuple[int, ...] | None) -> None:
        shape = shape if self._shape is None else self._shape
        if shape is not None:
            self._fill(shape)
        header = {
            "descr": npy.dtype_to_descr(self._dtype),
            "fortran_order": False,
            "shape": (self._written, *(shape or ())),
        }
        npy.write_array_header_1_0(entry, header)
        self._file.seek(0)
        shutil.copyfileobj(self._file, entry)

    def _fill(self, shape: tuple[int, ...]) -> None:
        self._shape = shape
        if self._written < self._rows:
            absent = np.full(shape, np.nan, self._dtype).tobytes()
            for _ in range(self._written, self._rows):
                self._file.write(absent)
            self._written = self._rows

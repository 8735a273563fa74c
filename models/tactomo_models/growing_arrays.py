"""Arrays that grow by the row: in files until they are all there, and from there into an .npz.

A file of frames may be larger than the memory, and how many contacts there are shows at its end.
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
        shapes: of the rows of those whose rows are no single values.
        scratch: a folder with room for all of it, uncompressed.
    """

    def __init__(
        self, types: Mapping[str, Any], shapes: Mapping[str, tuple[int, ...]], scratch: Path
    ) -> None:
        self._types = {
            name: np.dtype((dtype, shapes.get(name, ()))) for name, dtype in types.items()
        }
        self._rows = dict.fromkeys(types, 0)
        with contextlib.ExitStack() as undo:
            self._files: dict[str, IO[bytes]] = {
                name: undo.enter_context(tempfile.TemporaryFile(dir=scratch)) for name in types
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
        """Add a row to each array that is named; None is a row of NaN."""
        for name, row in rows.items():
            dtype = self._types[name]
            values = np.full(dtype.shape, np.nan if row is None else row, dtype.base)
            self._files[name].write(values.tobytes())
            self._rows[name] += 1

    def write(self, output: IO[bytes]) -> None:
        """Write the .npz file. A memory map would count all of it as this program's memory."""
        with zipfile.ZipFile(output, "w", zipfile.ZIP_DEFLATED, compresslevel=FAST) as archive:
            for name, file in self._files.items():
                dtype = self._types[name]
                header = {
                    "descr": npy.dtype_to_descr(dtype.base),
                    "fortran_order": False,
                    "shape": (self._rows[name], *dtype.shape),
                }
                with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                    npy.write_array_header_1_0(entry, header)
                    file.seek(0)
                    shutil.copyfileobj(file, entry)

"""Arrays that grow by the row: in files until they are all there, and from there into an .npz.

A file of frames may be larger than the memory, and how many contacts there are shows at its end.
"""

from __future__ import annotations

import shutil
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.lib import format as npy

FAST: Final = 1  # of zlib: maps are zeros for the most part, and pack as well as by its 6


class GrowingArrays:
    """The arrays of one .npz file, by name.

    Args:
        types: the dtype of each, with the shape of its rows where these are no single values.
        files: where each grows.
    """

    def __init__(self, types: Mapping[str, np.dtype[Any]], files: Mapping[str, IO[bytes]]) -> None:
        self._types, self._files = types, files
        self._rows = dict.fromkeys(types, 0)

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


@contextmanager
def growing_arrays(
    types: Mapping[str, Any],  # the dtype of each
    shapes: Mapping[str, tuple[int, ...]],  # of the rows of those whose rows are no single values
    scratch: Path,  # a folder with room for all of it, uncompressed
) -> Iterator[GrowingArrays]:
    """Arrays that grow in files of their own, which go with the context."""
    with ExitStack() as stack:
        files = {name: stack.enter_context(tempfile.TemporaryFile(dir=scratch)) for name in types}
        whole = {name: np.dtype((dtype, shapes.get(name, ()))) for name, dtype in types.items()}
        yield GrowingArrays(whole, files)

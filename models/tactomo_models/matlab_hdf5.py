"""Numbers of a .mat file of version 7.3, which is HDF5, pickled to standard output.

A program of its own, which `array_files` runs: libhdf5 may end the process that reads damaged
files (2.0.0: a double free). MATLAB's layout: axes in reverse order, complex numbers of two
fields, cells as references, a struct as a group, text as numbers whose class says so.
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py

DEFLATE_RATIO = 1032  # no stream is deflated further: zlib's technical details


def numbers(name: str, item: Any, largest: int) -> Iterator[tuple[str, Any]]:
    """Yield arrays of numbers by name, those in structs as `struct.field`.

    Raises ValueError where one would have more than `largest` bytes.
    """
    if isinstance(item, h5py.Group):
        for field, each in item.items():
            if field[0] != "#" and "MATLAB_sparse" not in item.attrs:
                yield from numbers(f"{name}.{field}" if name else field, each, largest)
    elif h5py.check_ref_dtype(item.dtype):
        if item.size == 1:
            yield from numbers(name, item.file[item[()].flat[0]], largest)
    elif item.attrs.get("MATLAB_class") != b"char" and "MATLAB_empty" not in item.attrs:
        if item.nbytes > largest:
            raise ValueError(f"{name} is larger than its file can hold")
        array = item[()].T
        if array.dtype.names == ("real", "imag"):
            array = array["real"] + 1j * array["imag"]
        if array.dtype.kind in "biufc":
            yield name, array


if __name__ == "__main__":
    given = Path(sys.argv[1])
    with h5py.File(given) as file:
        read = dict(numbers("", file, DEFLATE_RATIO * given.stat().st_size))
    pickle.dump(read, sys.stdout.buffer)

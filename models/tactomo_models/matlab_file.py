"""Numbers of a .mat file, pickled to standard output: `struct.field`, `structs(2).field`.

A program of its own, which `array_files` runs, with the memory and the time that it may take: a few
kilobytes may claim gigabytes, anywhere in a struct, and libhdf5 may end the process that reads
damaged files (2.0.0: a double free). Version 7.3 is HDF5, in MATLAB's layout: axes in reverse
order, complex numbers of two fields, cells as references, a struct as a group, text as numbers
whose class says so.
"""

from __future__ import annotations

import pickle
import resource
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

MAX_CPU_S = 15


def of_group(name: str, item: Any, largest: int) -> Iterator[tuple[str, Any]]:
    """Yield arrays of numbers of an HDF5 item.

    Raises ValueError where one would have more than `largest` bytes.
    """
    import h5py

    if isinstance(item, h5py.Group):
        if "MATLAB_sparse" in item.attrs:
            yield name, _dense(item, largest)
            return
        for field, each in item.items():
            if field[0] != "#":
                yield from of_group(f"{name}.{field}" if name else field, each, largest)
    elif h5py.check_ref_dtype(item.dtype):
        links, (structs, dot, field) = item[()].ravel(), name.rpartition(".")
        is_structs = dot and item.attrs.get("MATLAB_class") is None  # a field of each
        for number, link in enumerate(links if is_structs or len(links) == 1 else (), 1):
            place = f"{structs}({number}).{field}" if len(links) > 1 else name
            yield from of_group(place, item.file[link], largest)
    elif item.attrs.get("MATLAB_class") != b"char" and "MATLAB_empty" not in item.attrs:
        if item.nbytes > largest:
            raise ValueError(f"{name} is larger than its file can hold")
        array = item[()].T
        if array.dtype.names == ("real", "imag"):
            array = array["real"] + 1j * array["imag"]
        if array.dtype.kind in "biufc":
            yield name, array


def _dense(item: Any, largest: int) -> np.ndarray[Any, Any]:
    """Return a sparse matrix of an HDF5 file."""
    from scipy.sparse import csc_array

    rows, columns = int(item.attrs["MATLAB_sparse"]), len(item["jc"]) - 1
    if 8 * rows * columns > largest:
        raise ValueError("a sparse matrix is larger than its file can hold")
    if "data" not in item:
        return np.zeros((rows, columns))
    parts = (item["data"][()], item["ir"][()], item["jc"][()])
    return np.asarray(csc_array(parts, shape=(rows, columns)).toarray())


def of_matlab(prefix: str, held: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield arrays of numbers of what scipy reads, from a struct or a cell of one array, too."""
    for name, value in held.items():
        array = value.toarray() if hasattr(value, "toarray") else np.asarray(value)
        if name.startswith("__"):
            continue
        if array.dtype.names:  # a struct, or an array of them
            for number, struct in enumerate(array.ravel(), 1):
                fields = {field: struct[field] for field in array.dtype.names}
                place = f"{name}({number})" if array.size > 1 else name
                yield from of_matlab(f"{prefix}{place}.", fields)
        elif array.dtype == object and array.size == 1:  # a cell
            yield from of_matlab(prefix, {name: array.flat[0]})
        elif array.dtype.kind in "biufc" and array.size:
            yield prefix + name, array


def main(path: Path, most: int) -> None:
    """Print the pickled arrays of a file that may have `most` bytes of them."""
    resource.setrlimit(resource.RLIMIT_CPU, (MAX_CPU_S, MAX_CPU_S))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with path.open("rb") as begun:
        is_hdf5 = b"MATLAB 7.3" in begun.read(128)
    if is_hdf5:
        import h5py

        _limit_memory(most)
        with h5py.File(path) as file:
            read = dict(of_group("", file, most))
    else:
        from scipy.io import loadmat

        _limit_memory(most)
        read = dict(of_matlab("", loadmat(path)))
    pickle.dump(read, sys.stdout.buffer)


def _limit_memory(most: int) -> None:
    used = int(Path("/proc/self/statm").read_text("ascii").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 2 * most, used + 2 * most))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))

"""The inner loop compiled: `inner_loop.c`, as the installation has built it.

Where it could not (no compiler was there), the same is done in NumPy, several times slower: see
`hatch_build.py`. BLAS and LAPACK are SciPy's own, by the addresses that it gives to Cython.
"""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import scipy.linalg.cython_blas
import scipy.linalg.cython_lapack
from numpy.typing import NDArray

_ROUTINES = {
    scipy.linalg.cython_blas: ("dgemm", "dtrsm"),
    scipy.linalg.cython_lapack: ("dpotrf", "dgesv"),
}


def _loaded() -> ctypes.CDLL | None:
    path = Path(__file__).with_name("libinner_loop.so")
    try:
        library = ctypes.CDLL(str(path))
    except OSError:  # not there, or of another machine
        return None
    name_of, pointer_of = ctypes.pythonapi.PyCapsule_GetName, ctypes.pythonapi.PyCapsule_GetPointer
    name_of.restype, name_of.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer_of.restype = ctypes.c_void_p
    pointer_of.argtypes = [ctypes.py_object, ctypes.c_char_p]
    capsules = [module.__pyx_capi__[name] for module, names in _ROUTINES.items() for name in names]
    if not all(b"int *" in name_of(each) for each in capsules):  # of 64 bits, in some builds
        return None
    library.use_blas(*(ctypes.c_void_p(pointer_of(each, name_of(each))) for each in capsules))
    count, array = ctypes.c_int64, ctypes.c_void_p
    library.find_areas.argtypes = [array, count, array, array]
    library.apply_rim_law.argtypes = [array, array, count, array, array]
    library.solve.argtypes = [array, array, ctypes.c_int, *[array] * 6]
    library.differentiate.argtypes = [*[array] * 5, count, array, array]
    library.draw.argtypes = [array, count, array, count, *[array] * 7]
    library.draw.restype = count
    library.draw_slopes.argtypes = [array, count, array, count, *[array] * 3, count, *[array] * 4]
    return library


LIBRARY = _loaded()


def at(array: NDArray[Any] | None) -> ctypes.c_void_p | None:
    """Where a contiguous array's values are, for C; NULL for None.

    It holds the array: one that nobody else has, such as a property's, would be freed before C
    reads it.
    """
    assert array is None or array.flags.c_contiguous
    return None if array is None else array.ctypes.data_as(ctypes.c_void_p)

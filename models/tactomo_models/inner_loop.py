"""The inner loop compiled: `inner_loop.c`, as the installation has built it (`hatch_build.py`).

BLAS and LAPACK are SciPy's own, by the addresses that it gives to Cython.
"""

from __future__ import annotations

import ctypes
from hashlib import sha256
from pathlib import Path
from typing import Any

import scipy.linalg.cython_blas
import scipy.linalg.cython_lapack
from numpy.typing import NDArray

from tactomo_models.errors import ModelError

_PATH = Path(__file__).with_name("libinner_loop.so")
_SOURCE = Path(__file__).with_name("inner_loop.c")
_ROUTINES = {
    scipy.linalg.cython_blas: ("dgemm", "dtrsm"),
    scipy.linalg.cython_lapack: ("dpotrf", "dgetrf", "dgetrs"),
}
_COUNT, _ARRAY = ctypes.c_int64, ctypes.c_void_p
_ARGUMENTS = {
    "find_areas": [_ARRAY, _COUNT, _ARRAY, _ARRAY],
    "evaluate": [_ARRAY] * 6,
    "evaluate_slopes": [*[_ARRAY] * 5, _COUNT, *[_ARRAY] * 3],
    "differentiate": [
        *[_ARRAY] * 2,
        _COUNT,
        *[_ARRAY] * 2,
        ctypes.c_double,
        _ARRAY,
        _COUNT,
        *[_ARRAY] * 3,
    ],
    "block_of": [_ARRAY, _ARRAY, _COUNT, _ARRAY, _COUNT, _ARRAY, _ARRAY],
    "conduct": [_ARRAY, _COUNT, _ARRAY, _ARRAY, ctypes.c_double, _ARRAY, _ARRAY],
    "draw": [_ARRAY, _COUNT, _ARRAY, _COUNT, *[_ARRAY] * 7],
    "draw_slopes": [_ARRAY, _COUNT, _ARRAY, _COUNT, *[_ARRAY] * 3, _COUNT, *[_ARRAY] * 4],
}


class _Library:
    """Functions of the library, which is loaded when the first of them is asked for."""

    def load(self) -> None:
        """Load the library.

        Raises ModelError where there is none, or it is not of this machine and version.
        """
        if "evaluate" not in self.__dict__:
            self.__dict__ |= _functions(_PATH)

    def __getattr__(self, name: str) -> Any:
        if name not in _ARGUMENTS:
            raise AttributeError(name)
        self.load()
        return self.__dict__[name]


def _functions(path: Path) -> dict[str, Any]:
    try:
        library = ctypes.CDLL(str(path))
        functions = {name: getattr(library, name) for name in _ARGUMENTS}
        built_from = (ctypes.c_char * 65).in_dll(library, "source").value.decode()
        if built_from not in ("", sha256(_SOURCE.read_bytes()).hexdigest()):
            raise OSError(f"{_SOURCE.name} has changed since it was compiled")
    except (OSError, AttributeError, ValueError) as error:
        state = "is not of this machine and version" if path.exists() else "is missing"
        raise ModelError(
            f"the compiled inner loop {state} ({error}); install tactomo again, with a C compiler "
            "at hand: pip install --force-reinstall tactomo, or make clean setup in a checkout"
        ) from error
    library.use_blas(*_routines())
    for name, function in functions.items():
        function.argtypes = _ARGUMENTS[name]
    functions["draw"].restype = _COUNT
    functions["conduct"].restype = functions["block_of"].restype = None
    return functions


def _routines() -> list[ctypes.c_void_p]:
    """Addresses of BLAS and LAPACK."""
    name_of, pointer_of = ctypes.pythonapi.PyCapsule_GetName, ctypes.pythonapi.PyCapsule_GetPointer
    name_of.restype, name_of.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer_of.restype = ctypes.c_void_p
    pointer_of.argtypes = [ctypes.py_object, ctypes.c_char_p]
    capsules = [module.__pyx_capi__[name] for module, names in _ROUTINES.items() for name in names]
    if not all(b"int *" in name_of(each) for each in capsules):
        raise ModelError(
            "SciPy's BLAS counts in 64 bits, the compiled inner loop in 32; install SciPy's own "
            "wheel: pip install --force-reinstall scipy"
        )
    return [ctypes.c_void_p(pointer_of(each, name_of(each))) for each in capsules]


LIBRARY = _Library()
_START = ctypes.c_char * 0


def at(array: NDArray[Any] | None) -> Any:
    """Where a contiguous array's values are, for C; NULL for None.

    It holds the array: one that nobody else has, such as a property's, would be freed before C
    reads it.
    """
    if array is None:
        return None
    assert array.flags.c_contiguous
    if array.flags.writeable:  # then it takes a seventh of the time
        return _START.from_buffer(array)  # type: ignore[arg-type]
    return array.ctypes.data_as(ctypes.c_void_p)


def address(array: NDArray[Any]) -> int:
    """The same as a number, for a structure whose owner keeps the array as long as itself."""
    assert array.flags.c_contiguous
    if array.flags.writeable:
        return ctypes.addressof(_START.from_buffer(array))  # type: ignore[arg-type]
    return int(array.ctypes.data)

"""Reading sets of measured data, as the arrays of one file."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from tactomo_models.archive import read_arrays
from tactomo_models.array_files import MAX_SIZE
from tactomo_models.arrays import FloatArray
from tactomo_models.errors import DataError

MAX_NUMBERS: Final = 4_000_000  # of one array; the largest public set has 1.4 million
MAX_PIXELS: Final = 512  # of a picture's side; the largest public set's have 256


def read_set(path: Path, what: str, *numbers: str) -> dict[str, Any]:
    """Read all arrays of a file, some of which must be there and are real numbers.

    Raises DataError where the file cannot be read, or lacks one of them.
    """
    try:
        arrays = read_arrays(path)
        for key in numbers:
            if arrays[key].ndim == 0 or arrays[key].dtype.kind not in "biuf":
                raise ValueError(f"{key} is a single number, or none that is real")
            if arrays[key].size > MAX_NUMBERS:
                raise ValueError(f"{key} has {arrays[key].size} numbers, more than {MAX_NUMBERS}")
            arrays[key] = arrays[key].astype(float)
            if (np.abs(arrays[key]) > MAX_SIZE).any():
                raise ValueError(f"{key} has numbers beyond {MAX_SIZE:g}")
        return arrays
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror}; give the set's .npz") from error
    except (KeyError, ValueError) as error:
        raise DataError(
            f"{path} is no set of {what} ({error}): {', '.join(numbers)} are needed, all real"
        ) from error


def check_pictures(path: Path, truth: FloatArray) -> None:
    """Raise DataError where what stood in tanks (n, rows, columns) is no pictures of their size."""
    if truth.ndim != 3 or not all(1 <= side <= MAX_PIXELS for side in truth.shape[1:]):
        raise DataError(
            f"{path}: truth is {truth.shape}; (n, rows, columns) of at most {MAX_PIXELS} x "
            f"{MAX_PIXELS} pixels is needed: give smaller pictures"
        )

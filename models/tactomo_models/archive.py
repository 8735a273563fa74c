"""Archives of arrays (.npz), which users bring and disks damage."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactomo_models.errors import DataError

# What numpy and zipfile raise on text, .npy files, pickled objects and flipped bits.
_DAMAGE = (ValueError, TypeError, EOFError, RuntimeError, zlib.error, zipfile.BadZipFile)


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Arrays of an .npz file by name.

    Raises:
        OSError: the file cannot be read.
        DataError: it is damaged, or no .npz file of plain arrays.
    """
    try:
        # numpy leaves a file open that turns out to be no archive.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except _DAMAGE as error:
        raise DataError(f"cannot read {path}: damaged, or no .npz file of numbers") from error
    if not all(isinstance(array, np.ndarray) for array in arrays.values()):
        raise DataError(f"cannot read {path}: it holds other things than arrays of numbers")
    return arrays

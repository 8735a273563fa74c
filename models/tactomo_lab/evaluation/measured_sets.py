"""Reading sets of measured data, as the arrays of one file."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from tactomo_models.archive import read_arrays
from tactomo_models.errors import DataError

MAX_SIZE: Final = 1e30  # of any number, in any unit: what is larger overflows in the work


def read_set(path: Path, what: str, *numbers: str) -> dict[str, Any]:
    """Read all arrays of a file, some of which must be there and are real numbers.

    Raises DataError where the file cannot be read, or lacks one of them.
    """
    try:
        arrays = read_arrays(path)
        for key in numbers:
            if arrays[key].ndim == 0 or arrays[key].dtype.kind not in "biuf":
                raise ValueError(f"{key} is a single number, or none that is real")
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

"""Reading sets of measured data, as the arrays of one file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tactomo_models.archive import read_arrays
from tactomo_models.errors import DataError


def read_set(path: Path, what: str, *numbers: str) -> dict[str, Any]:
    """Read all arrays of a file, some of which must be there and are made real numbers.

    Raises DataError where the file cannot be read, or lacks one of them.
    """
    try:
        arrays = read_arrays(path)
        return {**arrays, **{key: arrays[key].astype(float) for key in numbers}}
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror}; give the set's .npz") from error
    except (KeyError, ValueError) as error:
        raise DataError(
            f"{path} is no set of {what} ({error}): {', '.join(numbers)} are needed, all numbers"
        ) from error

"""Simulated voltages kept on disk: simulating takes longer than reconstructing."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from tactomo_models.archive import read_arrays, write_whole
from tactomo_models.errors import DataError
from tactomo_models.physics.artifact import cache_folder

Arrays = dict[str, Any]


def cached(what: str, make: Callable[[], Arrays]) -> Arrays:
    """Arrays from an earlier call, or made anew and kept in the user's cache.

    `what` has all that they depend on. A file that cannot be read or written costs time and nothing
    else.
    """
    path = cache_folder() / "scenes" / f"{hashlib.sha256(what.encode()).hexdigest()[:32]}.npz"
    with suppress(OSError, DataError):
        return read_arrays(path)
    arrays = make()
    with suppress(OSError):
        write_whole(path, lambda file: np.savez(file, **arrays))
    return arrays

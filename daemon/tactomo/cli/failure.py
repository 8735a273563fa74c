"""Which errors are the user's to mend, printed as cause and next step, no traceback."""

from __future__ import annotations

import os
import sys


def explain(error: BaseException) -> str | None:
    """Return what to print for the user about an error, or None if it is a mistake of ours.

    Every package of ours has one class from which its deliberate errors derive. Only packages that
    are loaded already can have raised one, so none is imported to find out.
    """
    for module, name in (
        ("tactomo.errors", "TactomoError"),
        ("tactomo_client.errors", "ClientError"),
        ("tactomo_models.errors", "ModelError"),
    ):
        kind = getattr(sys.modules.get(module), name, None)
        if kind is not None and isinstance(error, kind):
            return str(error)
    # What the system refuses is no mistake of ours: a path, a disk that is full or that fails.
    if isinstance(error, OSError) and error.strerror:
        name = error.filename
        what = "read or write" if name is None else f"use {os.fsdecode(name)}"
        return f"cannot {what}: {error.strerror}; check the path, and the disk that it is on"
    return None

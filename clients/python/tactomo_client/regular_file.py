"""The door for files that anybody may have made: regular ones alone."""

from __future__ import annotations

import errno
import stat
from pathlib import Path
from typing import IO


def open_regular(path: Path) -> IO[bytes]:
    """Open a regular file for reading: a pipe may never end, and a device may do anything.

    Raises OSError where it cannot be opened, or is no regular file.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "it is no regular file", str(path))
    return path.open("rb")

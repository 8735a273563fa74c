"""The door for files that anybody may have made: regular ones alone, read up to a bound.

`tactomo_client.errors.open_regular` is the client's, which imports nothing of ours.
"""

from __future__ import annotations

import errno
import stat
from pathlib import Path
from typing import IO, Final

MAX_TEXT_BYTES: Final = 1 << 20  # of descriptions and calibrations, which have some thousand


def open_regular(path: Path) -> IO[bytes]:
    """Open a regular file for reading: a pipe may never end, and a device may do anything.

    Raises OSError where it cannot be opened, or is no regular file.
    """
    is_regular = stat.S_ISREG(path.stat().st_mode)
    if not is_regular or path.resolve().parts[1] in ("proc", "sys"):  # the kernel's may never end
        raise OSError(errno.EINVAL, "it is no regular file", str(path))
    return path.open("rb")


def read_regular(path: Path, most_bytes: int) -> bytes:
    """Return what is in a regular file.

    Raises OSError where it cannot be read, is no regular file, or holds more than `most_bytes`.
    """
    with open_regular(path) as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise OSError(errno.EFBIG, f"it has more than {most_bytes} bytes", str(path))
    return data

"""What memory a process holds, and that it gives back what it has freed."""

from __future__ import annotations

import ctypes
import gc
import os
from contextlib import suppress
from pathlib import Path


def resident_bytes() -> int | None:
    """Return the memory that this process holds; None where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
    except (OSError, IndexError, ValueError):
        return None
    return pages * os.sysconf("SC_PAGE_SIZE")


def return_freed_memory() -> None:
    """Let what is freed go back to the system, where the C library keeps it for each thread.

    30 MB of a daemon's; a frame takes no longer.
    """
    mmap_threshold, arena_max, large_bytes = -3, -8, 1 << 20  # of glibc's malloc.h
    with suppress(AttributeError, OSError):  # another C library has no mallopt
        set_option = ctypes.CDLL(None).mallopt
        set_option(arena_max, 1)
        set_option(mmap_threshold, large_bytes)


def trim_memory() -> None:
    """Give back what is freed already, but lies between what is held: 32 MB after a tare."""
    gc.collect()  # 4 MB of it are in cycles
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)

"""What is compiled for tests, once a run: later tests, also of other workers, find it built."""

from __future__ import annotations

import fcntl
import functools
import hashlib
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

BUILD_S: Final = 300.0
SANITIZED: Final = "-g -fsanitize=address,undefined -fno-sanitize-recover=all"


@contextmanager
def build_folder(*settings: str) -> Iterator[Path]:
    """Give the run's folder for what is built in this way; one process at a time is in it."""
    name = hashlib.sha256("\0".join(settings).encode()).hexdigest()[:16]
    folder = Path(os.environ["XDG_CACHE_HOME"]) / "builds" / name
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield folder


@functools.cache
def runs(compiler: str, flags: str, source: str = "int main(void) { return 0; }\n") -> bool:
    """Whether the compiler builds a program of C with these flags, and the program runs.

    A fuzzer would run without end: its program is told to try no input, which others ignore.
    """
    with build_folder(compiler, flags, source) as folder:
        (folder / "try.c").write_text(source)
        command = [compiler, *flags.split(), "-o", str(folder / "try"), str(folder / "try.c")]
        if subprocess.run(command, capture_output=True, timeout=BUILD_S).returncode:
            return False
        tried = [str(folder / "try"), "-runs=0"]
        return subprocess.run(tried, capture_output=True, timeout=BUILD_S).returncode == 0

"""The compiled inner loop touches no memory but its own, and does nothing undefined."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from needs import lacking

ROOT = Path(__file__).parents[2]
SUPPORT = ROOT / "tests/support"
SOURCE = ROOT / "models/tactomo_models/inner_loop.c"
RUNTIMES = {
    "gcc": ("libasan.so", ()),
    "clang": (f"libclang_rt.asan-{platform.machine()}.so", ("-shared-libasan",)),
}


def sanitized(folder: Path) -> tuple[Path, Path]:
    """The library built with sanitizers, and their runtime."""
    library = folder / "libinner_loop.so"
    for compiler, (name, flags) in RUNTIMES.items():
        if shutil.which(compiler) is None:
            continue
        found = subprocess.run(
            [compiler, f"-print-file-name={name}"], capture_output=True, text=True, check=True
        )
        runtime = Path(found.stdout.strip())
        checks = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", *flags)
        how = ("-O1", "-g", "-std=c11", "-fPIC", "-shared", *checks)
        build = [compiler, *how, str(SOURCE), "-o", str(library), "-lm"]
        if runtime.is_absolute() and subprocess.run(build, check=False).returncode == 0:
            return library, runtime
    lacking("needs gcc or clang with sanitizers")


@pytest.mark.slow
def test_a_sequence_of_solves_is_clean(tmp_path: Path) -> None:
    library, runtime = sanitized(tmp_path)
    environment = {
        **os.environ,
        "LD_PRELOAD": str(runtime),
        "PYTHONPATH": str(SUPPORT),
        # What Python itself never frees is reported at the end: its stacks do not lead here.
        "ASAN_OPTIONS": "detect_leaks=1",
        "PYTHONMALLOC": "malloc",
        "OPENBLAS_NUM_THREADS": "1",
    }
    done = subprocess.run(
        [sys.executable, str(SUPPORT / "inner_loop_sequence.py"), str(library)],
        capture_output=True,
        text=True,
        env=environment,
        timeout=280,
        check=False,
    )
    assert "all of it ran" in done.stdout, done.stderr[-4000:]
    assert "inner_loop.c" not in done.stderr, done.stderr[-4000:]

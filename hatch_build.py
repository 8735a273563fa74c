"""Compile the inner loop of the fit (`inner_loop.c`) into the wheel, or in place for a checkout.

By $CC or the system's compiler; where there is none, by the one that the package `ziglang` brings.
Without any the wheel is whole all the same: NumPy then does the same, several times slower.
"""

from __future__ import annotations

import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SOURCE = "models/tactomo_models/inner_loop.c"
LIBRARY = "models/tactomo_models/libinner_loop.so"


class CompileInnerLoop(BuildHookInterface):  # type: ignore[type-arg]
    """Makes a wheel for machines of this kind, and for any Python: C knows nothing of that."""

    def dependencies(self) -> list[str]:
        """What an isolated build needs besides."""
        return [] if _compiler() else ["ziglang"]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile; say so where nothing can."""
        compiler, root = _compiler(), Path(self.root)
        if not compiler:
            self.app.display_warning(
                "no C compiler: tactomo will run in NumPy, several times slower"
            )
            return
        flags = ("-O3", "-std=c11", "-Wall", "-Wextra", "-fPIC", "-shared")
        subprocess.run([*compiler, *flags, SOURCE, "-o", LIBRARY, "-lm"], cwd=root, check=True)
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["artifacts"].append(f"/{LIBRARY}")
        build_data["pure_python"], build_data["tag"] = False, f"py3-none-{platform}"


def _compiler() -> list[str]:
    if command := shlex.split(os.environ.get("CC", "")):
        return command
    if shutil.which("cc"):
        return ["cc"]
    has_zig = importlib.util.find_spec("ziglang") is not None
    return [sys.executable, "-m", "ziglang", "cc"] if has_zig else []

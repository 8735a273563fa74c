"""Compile the inner loop of the fit (`inner_loop.c`) into the wheel, or in place for a checkout.

By $CC or the system's compiler; where there is none, by the one that the package `ziglang` brings.
Without any the build fails, and says what to do.
"""

from __future__ import annotations

import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
from hashlib import sha256
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SOURCE = "models/tactomo_models/inner_loop.c"
LIBRARY = "models/tactomo_models/libinner_loop.so"
NEXT_STEP = "install gcc or clang, name one in $CC, or pip install ziglang; then install again"


class CompileInnerLoop(BuildHookInterface):  # type: ignore[type-arg]
    """Makes a wheel for machines of this kind, and for any Python: C knows nothing of that."""

    def dependencies(self) -> list[str]:
        """What an isolated build needs besides."""
        return [] if _compiler() else ["ziglang"]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile; end the build where nothing can."""
        compiler, root = _compiler(), Path(self.root)
        if not compiler:
            self.app.abort(f"tactomo needs a C compiler to be built: {NEXT_STEP}")
        flags = ("-O3", "-std=c11", "-Wall", "-Wextra", "-fPIC", "-shared")
        source = sha256((root / SOURCE).read_bytes()).hexdigest()
        command = [*compiler, *flags, f'-DSOURCE="{source}"', SOURCE, "-o", LIBRARY, "-lm"]
        try:
            subprocess.run(command, cwd=root, check=True)
        except (OSError, subprocess.CalledProcessError) as error:
            self.app.abort(f"{shlex.join(command)} failed ({error}): {NEXT_STEP}")
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

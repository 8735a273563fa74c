"""Each version that a robot installs has a wheel for 64-bit Arm: `make lock` has found it."""

from __future__ import annotations

import re
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
ARM = {"sys_platform": "linux", "platform_machine": "aarch64", "platform_system": "Linux"}
PYTHON = {"python_version": "3.11", "python_full_version": "3.11.0", "os_name": "posix"}


def pins(lock: str) -> dict[str, str]:
    """Versions by name of a lock, of what is installed on 64-bit Arm."""
    lines = re.findall(r"^[a-z0-9][^\\\n]+", (ROOT / lock).read_text("utf-8"), re.M | re.I)
    found = [Requirement(line.strip()) for line in lines]
    return {
        each.name: str(each.specifier)
        for each in found
        if each.marker is None or each.marker.evaluate({**ARM, **PYTHON})
    }


def test_a_robot_of_64_bit_arm_installs_the_pinned_versions_from_wheels() -> None:
    arm = pins("requirements-aarch64.lock")
    assert "numpy" in arm
    assert pins("requirements-run.lock").items() <= arm.items(), "run `make lock`"
    assert arm.items() <= pins("requirements.lock").items(), "run `make lock`"

"""What is told to install is there: distributions of this workspace, and extras that they have."""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
HINT = re.compile(r"pip install ['\"]?(tactomo[a-z0-9-]*)(?:\[([a-z0-9,]+)\])?")


def extras() -> dict[str, set[str]]:
    """The extras of each distribution of this workspace."""
    files = [ROOT / "pyproject.toml", *ROOT.glob("*/*/pyproject.toml")]
    projects: list[dict[str, Any]] = [tomllib.loads(file.read_text())["project"] for file in files]
    return {each["name"]: set(each.get("optional-dependencies", {})) for each in projects}


def test_each_hint_to_install_names_what_there_is() -> None:
    listed = subprocess.run(
        ["git", "ls-files", "*.py", "*.md", "*.toml"], cwd=ROOT, capture_output=True, check=True
    )
    known, hints = extras(), 0
    for name in listed.stdout.decode().split():
        for distribution, asked in HINT.findall((ROOT / name).read_text("utf-8")):
            hints += 1
            assert distribution in known, name
            assert set(filter(None, asked.split(","))) <= known[distribution], (name, asked)
    assert hints > 20

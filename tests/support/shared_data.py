"""Measured sets, which are no part of the project: `shared/data` beside a folder that holds it."""

from __future__ import annotations

from pathlib import Path

import pytest


def measured(name: str) -> Path:
    """Path of a measured set; the test that asks for one that is not there is skipped."""
    for folder in Path(__file__).resolve().parents:
        if (path := folder / "shared" / "data" / name).exists():
            return path
    pytest.skip(f"{name} is not beside the project")

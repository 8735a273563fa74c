"""Tests of the laboratory are a job of their own: `make test-lab`."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """FrameRecord those of this folder, before any is left out by its marks."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker("lab")

"""`tactomo models train` where the extra that it needs is not installed."""

from __future__ import annotations

import sys

import pytest
from fixture_types import Run


def test_a_missing_extra_is_told(tactomo: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)  # and torch
    for name in [name for name in sys.modules if name.startswith("tactomo_lab.training")]:
        monkeypatch.delitem(sys.modules, name)  # what was imported when it was there
    result = tactomo("models", "train", "scenes", status=1)
    assert "training needs onnx, which is not installed" in result.stderr
    assert "pip install 'tactomo-lab[train]'" in result.stderr
    assert "https://pytorch.org/get-started" in result.stderr

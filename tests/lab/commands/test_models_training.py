"""`tactomo models simulate` and `train` where the extra that they need is not installed."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest

Run = Callable[..., Any]


@pytest.mark.parametrize(
    ("arguments", "package"),
    [
        (("simulate", "scenes", "--description", "paper_square"), "joblib"),
        (("train", "scenes"), "onnx"),  # and torch
    ],
)
def test_a_missing_extra_is_told(
    tactomo: Run,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
    package: str,
) -> None:
    joblib = ModuleType("joblib")  # which may be missing here, too
    monkeypatch.setattr(joblib, "delayed", None, raising=False)
    monkeypatch.setitem(sys.modules, "joblib", joblib)
    monkeypatch.setitem(sys.modules, package, None)
    for name in [name for name in sys.modules if name.startswith("tactomo_lab.training")]:
        monkeypatch.delitem(sys.modules, name)  # what was imported when it was there
    result = tactomo("models", *arguments)
    assert result.returncode == 1
    assert f"training needs {package}, which is not installed" in result.stderr
    assert "pip install 'tactomo-lab[train]'" in result.stderr
    assert "https://pytorch.org/get-started" in result.stderr

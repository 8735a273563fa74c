"""`tactomo evaluate solves`: every series is measured, and the sheet's size costs nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from small_sensor import SMALL

Run = Callable[..., Any]


@pytest.mark.slow
def test_every_series_is_measured(tactomo: Run, tmp_path: Path) -> None:
    square = SMALL.replace("height_m = 0.05", "height_m = 0.06")
    (tmp_path / "small.toml").write_text(square)
    result = tactomo("evaluate", "solves", "-d", "small.toml", "--json")
    assert result.returncode == 0
    rows = json.loads(result.stdout)["rows"]
    assert {row["series"] for row in rows} == {"area", "mesh", "sheet"}
    for row in rows:
        assert all(ms > 0 for name, ms in row.items() if name.endswith("_ms"))
    sheets = [row for row in rows if row["series"] == "sheet"]
    assert sheets[-1]["sheet_nodes"] > 3 * sheets[0]["sheet_nodes"]
    assert len({row["rim_nodes"] for row in sheets}) == 1

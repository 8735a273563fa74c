"""`tactomo bench-solves`: every series is measured, and the sheet's size costs nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Run = Callable[..., Any]

SMALL = """
schema = 1
name = "small"
[sheet]
shape = "rectangle"
width_m = 0.06
height_m = 0.06
conductivity_s_m = 1.0
thickness_m = 1e-4
[electrodes]
per_side = 2
length_m = 0.006
pitch_m = 0.02
contact_impedance_ohm_m = 10.0
[pattern]
current_a = 1e-4
[map]
nodes_x = 21
nodes_y = 21
[structure]
conductivity_ratio = 100.0
"""


@pytest.mark.slow
def test_curves_in_numbers_and_as_a_picture(tactomo: Run, tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL)
    picture = tmp_path / "solves.png"
    result = tactomo("bench-solves", "-d", "small.toml", "--json", "--picture", picture)
    assert result.returncode == 0
    rows = json.loads(result.stdout)["rows"]
    assert {row["series"] for row in rows} == {"area", "mesh", "sheet"}
    for row in rows:
        assert all(ms > 0 for name, ms in row.items() if name.endswith("_ms"))
    sheets = [row for row in rows if row["series"] == "sheet"]
    assert sheets[-1]["sheet_nodes"] > 3 * sheets[0]["sheet_nodes"]
    assert len({row["rim_nodes"] for row in sheets}) == 1
    assert picture.read_bytes().startswith(b"\x89PNG")

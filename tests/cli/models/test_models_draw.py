"""`tactomo models draw`: true to scale, and told what cannot be drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from fixture_types import Run
from matplotlib.image import imread
from small_sensor import SMALL

DOTS_PER_MM = 150 / 25.4


def rims_apart(picture: Path, width_mm: float) -> int:
    """How many rows of a picture have just two black dots so far apart: rows between electrodes."""
    dark = imread(picture)[..., :3].max(axis=2) < 0.2
    left = dark[:, : round((width_mm + 40) * DOTS_PER_MM)]
    ends = [np.flatnonzero(row)[[0, -1]] for row in left if row.any()]
    return sum(bool(abs(last - first - width_mm * DOTS_PER_MM) < 4) for first, last in ends)


def test_a_sheet_is_drawn_true_to_scale(tactomo: Run, tmp_path: Path) -> None:
    (tmp_path / "my_sheet.toml").write_text(SMALL)
    result = tactomo("models", "draw", "my_sheet.toml", "-o", "my_sheet.png", status=0)
    assert result.stdout == "wrote my_sheet.png: small, scale 1 : 1\n"
    assert rims_apart(tmp_path / "my_sheet.png", 60) > 20
    assert rims_apart(tmp_path / "my_sheet.png", 50) == 0


def test_what_cannot_be_drawn_is_told(tactomo: Run, tmp_path: Path) -> None:
    (tmp_path / "wrong.toml").write_text(SMALL.replace("pitch_m = 0.02", "pitch_m = 0.2"))
    for arguments, said in (
        (("wrong.toml",), "the sheet's width_m is 0.06 m"),
        (("no_such.toml",), "cannot read the sensor description no_such.toml"),
        (("paper_square", "-o", "picture.txt"), "not a kind of picture"),
    ):
        result = tactomo("models", "draw", *arguments, status=1)
        assert said in result.stderr

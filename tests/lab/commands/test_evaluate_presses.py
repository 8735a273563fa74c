"""`tactomo evaluate presses`: which presses are learnt from, which are judged, and bad files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_skin import presses_on
from shared_data import measured

Run = Callable[..., Any]


def test_the_last_are_judged_by_the_first(tactomo: Run, tmp_path: Path) -> None:
    changes, xy_mm = presses_on(1, 400)
    changes[100:300] = np.random.default_rng(0).standard_normal((200, 40))  # neither of both
    path = tmp_path / "skins.npz"
    np.savez(path, a_voltages=changes, a_xy_mm=xy_mm, b_voltages=changes, b_xy_mm=-xy_mm)
    result = tactomo("evaluate", "presses", path, "--train", 100, "--json")
    assert result.returncode == 0, result.stderr
    a, b = json.loads(result.stdout)["skins"]
    assert (a["name"], b["name"], a["train"], a["judged"]) == ("a", "b", 100, 150)
    assert len(a["median_mm_since"]) == 4
    assert a["median_mm_since"][0] > 10 > 4 > a["median_mm_since"][-1]
    words = tactomo("evaluate", "presses", path, "--train", 300).stdout
    assert "learnt from the first 300" in words


@pytest.mark.parametrize(
    ("arrays", "told"),
    [
        ({"other": np.zeros(3)}, "is no set of presses"),
        ({"a_voltages": np.zeros((9, 4))}, "no a_xy_mm"),
        ({"a_voltages": np.zeros((9, 4)), "a_xy_mm": np.zeros((8, 2))}, "(9, 4)"),
        ({"a_voltages": np.zeros((9, 4)), "a_xy_mm": np.zeros((9, 2))}, "--train 4 or less"),
        ({"a_voltages": np.zeros((40, 4)), "a_xy_mm": np.eye(40, 2)}, "a: press 0"),
    ],
)
def test_files_that_are_none(
    tactomo: Run, tmp_path: Path, arrays: dict[str, Any], told: str
) -> None:
    np.savez(tmp_path / "skins.npz", **arrays)
    result = tactomo("evaluate", "presses", tmp_path / "skins.npz", "--train", 20)
    assert result.returncode == 1
    assert told in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize(("train", "asked_mm"), [(100, 4.5), (200, 3.6), (800, 2.3)])
def test_measured_skins(tactomo: Run, train: int, asked_mm: float) -> None:
    """Plain kernel ridge regression comes to 7.1, 5.2 and 3.0 mm."""
    result = tactomo(
        "evaluate", "presses", measured("skins_anisotropy.npz"), "--train", train, "--json"
    )
    skins = json.loads(result.stdout)["skins"]
    assert np.mean([one["median_mm"] for one in skins]) < asked_mm
    assert 0.6 < np.median([one["within_sigma"] for one in skins]) < 0.8

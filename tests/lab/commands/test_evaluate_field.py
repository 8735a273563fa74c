"""`tactomo evaluate field`: what is asked for is what is evaluated, and it is told in full."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from small_sensor import SMALL

Run = Callable[..., Any]


@pytest.mark.slow
def test_in_numbers_and_words(tactomo: Run, tmp_path: Path) -> None:
    sensor = tmp_path / "small.toml"
    sensor.write_text(SMALL)
    ask = ("evaluate", "field", "--description", sensor, "--rows", "soft,graded", "--count", 1)
    numbers = tactomo(*ask, "--method", "tikhonov", "--json")
    assert numbers.returncode == 0, numbers.stderr
    told = json.loads(numbers.stdout)
    assert (told["simulated"], told["seeds"], told["method"]) == (True, "tuning", "tikhonov")
    assert list(told["lines"]) == ["soft", "graded"]
    for line in told["lines"].values():
        assert line["frames"] == len(line["scores"]) == 1
        assert line["icc"] == pytest.approx(line["scores"][0]["icc"])
    picture = tmp_path / "soft.png"
    words = tactomo(*ask, "--method", "tikhonov", "--picture", picture)
    assert words.returncode == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "Simulated, not measured: small, tuning seeds" in words.stdout
    assert "area in σ" in words.stdout


@pytest.mark.parametrize(
    ("picture", "told"),
    [("field.txt", "not a kind of picture"), ("nowhere/field.png", "there is no folder nowhere")],
)
def test_a_picture_that_cannot_be_is_told_before_the_work(
    tactomo: Run, picture: str, told: str
) -> None:
    result = tactomo("evaluate", "field", "--count", 1, "--picture", picture)
    assert result.returncode == 1
    assert told in result.stderr

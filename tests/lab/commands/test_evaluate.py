"""`tactomo evaluate`: what is asked for is what is evaluated, and it is told in full."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Run = Callable[..., Any]
FEW = ("evaluate", "scenes", "--count", 1, "--contacts", "1-2", "--method", "tikhonov")


@pytest.mark.slow
def test_scenes_in_numbers(tactomo: Run, tmp_path: Path) -> None:
    picture = tmp_path / "scenes.png"
    result = tactomo(*FEW, "--snr", "40,20", "--json", "--picture", picture)
    assert result.returncode == 0
    told = json.loads(result.stdout)
    assert told["simulated"] is True
    assert (told["seeds"], told["method"], told["snr_of"]) == ("tuning", "tikhonov", "change")
    assert told["all"]["frames"] == len(told["scenes"]) == 4
    assert set(told["by"]["SNR (dB)"]) == {"20", "40"}
    assert [one["scene"] for one in told["scenes"]] == ["tuning 1/0", "tuning 2/0"] * 2
    assert {one["tier"] for one in told["scenes"]} == {"tikhonov"}
    for one in told["scenes"]:
        assert 0.3 < one["icc"] < 1
        assert len(one["contacts"]) == int(one["scene"][7])
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("command", ["scenes", "field", "drift"])
@pytest.mark.parametrize(
    ("picture", "told"),
    [("scenes.txt", "not a kind of picture"), ("nowhere/scenes.png", "there is no folder nowhere")],
)
def test_a_picture_that_cannot_be_is_told_before_the_work(
    tactomo: Run, command: str, picture: str, told: str
) -> None:
    result = tactomo("evaluate", command, "--count", 1, "--picture", picture)
    assert result.returncode == 1
    assert told in result.stderr


@pytest.mark.slow
def test_scenes_in_words(tactomo: Run) -> None:
    result = tactomo(*FEW, "--seeds", "tuning", "--snr-of", "voltage")
    assert result.returncode == 0
    assert "Simulated, not measured: paper_square, tuning seeds" in result.stdout
    assert "SNR of the voltage" in result.stdout
    for heading in ("RIE", "contacts 2", "spread", "within one reported standard uncertainty"):
        assert heading in result.stdout


@pytest.mark.parametrize(
    ("option", "value"), [("--contacts", "4-2"), ("--contacts", "0"), ("--snr", "loud")]
)
def test_what_it_cannot_read_is_a_usage_error(tactomo: Run, option: str, value: str) -> None:
    result = tactomo("evaluate", "scenes", option, value)
    assert result.returncode == 2
    assert f"{value!r}: give" in result.stderr


@pytest.mark.long
def test_an_hour_of_drift(tactomo: Run, tmp_path: Path) -> None:
    picture = tmp_path / "drift.png"
    ask = ("evaluate", "drift", "--hours", 0.75)
    result = tactomo(*ask, "--json", "--picture", picture)
    assert result.returncode == 0
    told = json.loads(result.stdout)
    assert (told["simulated"], told["seeds"], told["hours"]) == (True, "tuning", 0.75)
    (day,) = told["days"]
    assert day["tracked"]["ghosts_per_hour"] == day["tracked"]["erased"] == 0
    assert day["tracked"]["presses"] == day["untracked"]["presses"] == 3
    assert picture.read_bytes().startswith(b"\x89PNG")
    words = tactomo(*ask).stdout
    assert "Simulated, not measured: paper_square, tuning seeds, 0.75 hours after" in words
    assert "tuning 0" in words
    assert "frames under a press that do not show it" in " ".join(words.split())
    assert "…" not in words

"""`tactomo evaluate paper`: the figures asked for, in numbers and words."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fixture_types import Run


@pytest.fixture
def few(small_file: Path) -> tuple[object, ...]:
    return ("evaluate", "paper", "--description", small_file, "--count", 1, "--sheets", 1)


@pytest.mark.slow
def test_in_numbers(tactomo: Run, few: tuple[object, ...]) -> None:
    ways = ("--method", "noser", "--method", "tikhonov", "--json")
    result = tactomo(*few, "--figure", "5,9", *ways, status=0)
    told = json.loads(result.stdout)
    assert told["simulated"] is True
    assert set(told["figures"]) == {"5", "9"}
    cells = told["figures"]["5"]
    assert len(cells) == 4 * 4 * 2
    assert {cell["snr_db"] for cell in cells} == {None, 40, 20, 10}
    (error, _) = told["figures"]["9"]["errors"]
    assert [len(of_case) for of_case in error["estimates"]] == [4, 4, 4, 4]
    assert told["figures"]["9"]["paper_hardware"]["cnn-multimodal"]["error"] == 0.21


@pytest.mark.slow
def test_a_method_that_cannot_be_had_is_said_and_left_out(
    tactomo: Run, few: tuple[object, ...]
) -> None:
    asked = (*few, "--figure", "9", "--method")
    result = tactomo(*asked, "network", "--method", "tikhonov", status=0)
    assert "left out: network" in result.stderr
    assert "Figs. 8 and 9" in result.stdout
    result = tactomo(*asked, "network", status=1)
    assert "choose others with --method" in result.stderr


@pytest.mark.parametrize(
    ("option", "value"), [("--figure", "6"), ("--figure", "all"), ("--method", "magic")]
)
def test_what_it_does_not_know_is_a_usage_error(tactomo: Run, option: str, value: str) -> None:
    result = tactomo("evaluate", "paper", option, value, status=2)
    assert repr(value) in result.stderr

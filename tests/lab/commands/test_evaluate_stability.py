"""`tactomo evaluate stability`: what is asked for is what is evaluated, drawn and counted."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from small_sensor import SMALL

Run = Callable[..., Any]


@pytest.fixture
def stability(tactomo: Run, tmp_path: Path) -> Callable[..., Any]:
    sensor = tmp_path / "small.toml"
    sensor.write_text(SMALL)
    return lambda *more: tactomo("evaluate", "stability", "--description", sensor, *more)


@pytest.mark.slow
def test_in_numbers_words_and_pictures(stability: Run, tmp_path: Path) -> None:
    picture = tmp_path / "flags.png"
    some = (
        "--regime",
        "dead-lead,drift-at-rest",
        "--method",
        "tikhonov",
        "--method",
        "auto",
        "--count",
        1,
    )
    numbers = stability(*some, "--json", "--picture", picture)
    assert numbers.returncode == 0, numbers.stderr
    told = json.loads(numbers.stdout)
    assert (told["simulated"], told["seeds"], told["sensor"]) == (True, "tuning", "small")
    assert list(told["regimes"]) == ["dead-lead", "drift-at-rest", "all"]
    ran = [(one["regime"], one["method"]) for one in told["cases"]]
    assert ran == [(r, m) for r in ("dead-lead", "drift-at-rest") for m in ("tikhonov", "auto")]
    assert all("electrode_fault" in one["flags"] for one in told["cases"][:2])
    for regime, facts in told["regimes"].items():
        assert list(facts["methods"]) == ["tikhonov", "auto"]
        for method, counts in facts["methods"].items():
            own = [
                one
                for one in told["cases"]
                if one["method"] == method and regime in (one["regime"], "all")
            ]
            assert counts["maps"] == len(own)
            assert counts["bad"] == sum(one["likeness"] < 0.7 for one in own)
    assert picture.read_bytes().startswith(b"\x89PNG")
    words = stability(*some)
    assert words.returncode == 0
    assert "Simulated, not measured: small, tuning seeds" in words.stdout
    assert "dead-lead" in words.stdout
    assert "bad maps" in words.stdout


@pytest.mark.parametrize(
    ("option", "value", "why"),
    [
        ("--regime", "earthquake", "'earthquake': give one or more of"),
        ("--method", "magic", "unknown method 'magic'"),
    ],
)
def test_what_it_does_not_know_is_a_usage_error(
    stability: Run, option: str, value: str, why: str
) -> None:
    result = stability(option, value)
    assert result.returncode == 2
    assert why in result.stderr

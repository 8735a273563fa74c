"""`tactomo evaluate field`: what is asked for is evaluated, drawn and told in full."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fixture_types import Run


@pytest.fixture
def field(tactomo: Run, small_file: Path) -> Run:
    return lambda *more, **ending: tactomo(
        "evaluate", "field", "--description", small_file, *more, **ending
    )


@pytest.mark.slow
def test_in_numbers_words_and_a_picture(field: Run, tmp_path: Path) -> None:
    ask = ("--rows", "soft,graded", "--count", 1, "--method", "tikhonov")
    numbers = field(*ask, "--json", status=0)
    told = json.loads(numbers.stdout)
    assert (told["simulated"], told["seeds"], told["method"]) == (True, "tuning", "tikhonov")
    assert list(told["lines"]) == ["soft", "graded"]
    for line in told["lines"].values():
        assert line["frames"] == len(line["scores"]) == 1
        assert line["icc"] == pytest.approx(line["scores"][0]["icc"])
    picture = tmp_path / "soft.png"
    words = field(*ask, "--picture", picture, status=0)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "Simulated, not measured: small, tuning seeds" in words.stdout
    assert "area in σ" in words.stdout


@pytest.mark.slow
def test_regimes_in_numbers_words_and_a_picture(field: Run, tmp_path: Path) -> None:
    picture = tmp_path / "flags.png"
    some = ("--rows", "dead-lead,drift-at-rest", "--method", "tikhonov,network,auto")
    numbers = field(*some, "--count", 1, "--json", "--picture", picture, status=0)
    assert "left out: dead-lead" in numbers.stderr  # nobody has trained a network for it
    told = json.loads(numbers.stdout)
    assert (told["simulated"], told["seeds"], told["sensor"]) == (True, "tuning", "small")
    both = [f"{row}, {of}" for row in ("dead-lead", "drift-at-rest") for of in ("tikhonov", "auto")]
    assert list(told["lines"]) == both
    for line, facts in told["lines"].items():
        (score,) = facts["scores"]
        assert ("electrode_fault" in score["flags"]) is line.startswith("dead-lead")
        assert facts["bad_unflagged"] == (score["likeness"] < 0.7 and not score["warned"])
    assert picture.read_bytes().startswith(b"\x89PNG")
    words = field(*some, "--count", 1, status=0)
    assert "Simulated, not measured: small, tuning seeds" in words.stdout
    assert "dead-lead, auto" in words.stdout


@pytest.mark.parametrize(
    ("option", "value", "why"),
    [
        ("--rows", "earthquake", "'earthquake': give one or more of"),
        ("--method", "magic", "unknown method 'magic'"),
    ],
)
def test_what_it_does_not_know_is_a_usage_error(
    field: Run, option: str, value: str, why: str
) -> None:
    result = field(option, value, status=2)
    assert why in result.stderr


@pytest.mark.slow
def test_an_own_method_that_fails_ends_it(
    field: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is not left out, as a method that does not serve the sensor is."""
    (tmp_path / "divides_by_zero.py").write_text(
        "class Method:\n"
        "    def prepare(self, skin): pass\n"
        "    def solve(self, measurement, previous, budget_s): return 1 / 0\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    result = field(
        "--rows", "ordinary", "--count", 1, "--method", "divides_by_zero:Method", status=1
    )
    assert "division by zero" in result.stderr

"""`tactomo bench`: every method and all it is compared with is in the one table."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from small_sensor import SMALL
from tactomo.cli import app
from tactomo_lab.commands import method_times
from tactomo_models import available_methods
from tactomo_models.methods.registry import BUDGETED
from typer.testing import CliRunner

Run = Callable[..., Any]

OWN = """
from tactomo_models.methods.linear import Tikhonov

class Mine(Tikhonov):
    pass

class Failing(Tikhonov):
    def solve(self, *_):
        raise ZeroDivisionError("on purpose")
"""


@pytest.fixture
def sensor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The description of a small sheet, on which few frames are timed."""
    monkeypatch.setattr(method_times, "FRAMES", 3)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return path


def rows_of(sensor: Path, *options: str) -> dict[tuple[str, int, str], dict[str, Any]]:
    """Run the table alone: its rows by method, contacts and state."""
    result = CliRunner().invoke(app, ["bench", "--no-live", "--json", "-d", str(sensor), *options])
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)["methods"]
    return {(row["method"], row["contacts"], row["state"]): row for row in rows}


@pytest.mark.long
def test_every_method_is_timed_beside_what_it_is_compared_with(sensor: Path) -> None:
    pytest.importorskip("pyeit")
    rows = rows_of(sensor)
    noted = {method for (method, _, _), row in rows.items() if row["note"]}
    assert not noted & {"auto", "fit", "levelset", "tikhonov", "noser", "pls-paper"}
    expected = {("bare product", 0, "any"), ("auto", 0, "any")}
    expected |= {(f"pyEIT, {how}", 1, "any") for how in ("one step", "Gauss-Newton")}
    for method in available_methods():
        states = ("cold", "still", "moving") if method in BUDGETED else ("any",)
        contacts = (1,) if method in noted else (1, 2)
        expected |= {(method, each, state) for each in contacts for state in states}
        if method not in noted:
            expected.add((method, 4, states[0]))  # no more than cold
    assert rows.keys() == expected
    product = rows["bare product", 0, "any"]
    assert product["of_product"] == 1
    for row in rows.values():
        if not row["note"]:
            assert 0 < row["p50_ms"] <= row["p99_ms"]
            assert row["of_product"] == pytest.approx(row["p50_ms"] / product["p50_ms"])
            assert row["p99_of_product"] == pytest.approx(row["p99_ms"] / product["p50_ms"])


@pytest.mark.slow
def test_methods_of_ones_own_have_rows_and_what_cannot_be_timed_says_why(
    sensor: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyeit.eit.jac", None)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "own_timed.py").write_text(OWN)
    asked = ("--method", "own_timed:Mine", "--method", "own_timed:Failing")
    rows = rows_of(sensor, *asked)
    mine = {("own_timed:Mine", n, s) for n in (1, 2) for s in ("cold", "still", "moving")}
    mine.add(("own_timed:Mine", 4, "cold"))
    failing, peer = ("own_timed:Failing", 1, "any"), ("pyEIT", 1, "any")
    assert rows.keys() == {("bare product", 0, "any"), *mine, failing, peer}
    assert all(rows[each]["of_product"] > 0 for each in mine)
    assert all(rows[each]["memory_mb"] < 500 for each in mine)
    assert "ZeroDivisionError: on purpose" in rows[failing]["note"]
    assert rows[peer]["note"] == "pip install 'tactomo[compare]'"
    assert rows[peer]["p50_ms"] is rows[failing]["of_product"] is None


@pytest.mark.slow
def test_an_earlier_run_is_set_beside_this_one(sensor: Path, tmp_path: Path) -> None:
    asked = ("--no-live", "-d", str(sensor), "--method", "tikhonov")
    earlier = CliRunner().invoke(app, ["bench", *asked, "--json"])
    kept = json.loads(earlier.stdout)
    for row in kept["methods"]:
        if row["method"] == "tikhonov":
            row["of_product"] /= 1000
            row["p99_of_product"] *= 1000
    kept["methods"] = [row for row in kept["methods"] if row["contacts"] != 2]
    (tmp_path / "times.json").write_text(json.dumps(kept), "utf-8")
    again = ("--compare", str(tmp_path / "times.json"))
    now = json.loads(CliRunner().invoke(app, ["bench", *asked, *again, "--json"]).stdout)
    compared = {row["what"]: row for row in now["compared"]}
    assert "tikhonov, contacts 2, any" not in compared
    figures = compared["tikhonov, contacts 1, any"]
    assert figures["p50"][1] > 10 * figures["p50"][0]
    assert figures["p99"][1] < figures["p99"][0] / 10
    assert figures["memory_mb"] is not None
    shown = CliRunner().invoke(app, ["bench", *asked, *again])
    assert "tikhonov, contacts 1, any" in shown.stdout.split("and now")[1]


def test_what_is_no_earlier_run_is_refused_before_the_work(tactomo: Run, tmp_path: Path) -> None:
    for content in ("no JSON", "[]", '{"live": []}'):
        (tmp_path / "times.json").write_text(content, "utf-8")
        result = tactomo("bench", "--compare", "times.json")
        assert result.returncode == 1
        assert "tactomo bench --json" in result.stderr
    assert tactomo("bench", "--compare", "times.json", "--machine-speed").returncode == 2


def test_without_the_laboratory_the_table_says_how_to_get_it(
    tactomo: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.metadata.entry_points", lambda **_: ())
    result = tactomo("bench", "--no-live")
    assert result.returncode == 1
    assert "pip install tactomo-lab" in result.stderr

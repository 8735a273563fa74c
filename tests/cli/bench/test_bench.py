"""`tactomo bench`: an earlier run beside this one, and what is refused before the work."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from tactomo.cli.bench.comparison import compared, table_of

Run = Callable[..., Any]


def a_run(p50: float, p99: float, memory_mb: float | None, *scenes: str) -> dict[str, Any]:
    row = {"latency_p50_ms": p50, "latency_p99_ms": p99, "memory_mb": memory_mb}
    return {"live": [{"scene": scene, **row} for scene in scenes]}


def test_an_earlier_run_is_set_beside_this_one(capsys: pytest.CaptureFixture[str]) -> None:
    rows = compared(a_run(2.0, 3.0, None, "still", "gone"), a_run(4.0, 3.0, 200.0, "still", "new"))
    assert rows == [
        {"what": "live: still", "p50": [2.0, 4.0], "p99": [3.0, 3.0], "memory_mb": None}
    ]
    Console(width=100).print(table_of(rows, Path("times.json")))
    shown = capsys.readouterr().out
    assert "times.json, and now" in shown
    assert "2 > 4 x2.00" in shown
    assert "3 > 3 x1.00" in shown


def test_what_is_no_earlier_run_is_refused_before_the_work(tactomo: Run, tmp_path: Path) -> None:
    for content in ("no JSON", "[]", '{"machine": "this"}', '{"live": [{}]}'):
        (tmp_path / "times.json").write_text(content, "utf-8")
        result = tactomo("bench", "--compare", "times.json")
        assert result.returncode == 1
        assert "tactomo bench --json" in result.stderr


@pytest.mark.parametrize(
    "options",
    [
        ["--show"],
        ["--machine-speed", "--chart", "chart.png"],
        ["--machine-speed", "--compare", "times.json"],
        ["--method", "tikhonov"],
    ],
)
def test_options_that_do_not_go_together(tactomo: Run, options: list[str]) -> None:
    assert tactomo("bench", *options).returncode == 2


def test_without_the_laboratory_the_chart_says_how_to_get_it(
    tactomo: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.metadata.entry_points", lambda **_: ())
    result = tactomo("bench", "--chart", "chart.png")
    assert result.returncode == 1
    assert "pip install tactomo-lab" in result.stderr

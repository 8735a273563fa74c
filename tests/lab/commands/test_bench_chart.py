"""`tactomo bench --chart`: the picture and the rows say what was measured."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from fixture_types import Run
from tactomo_lab.commands import chart as bench_chart
from tactomo_lab.commands.chart import Point
from tactomo_lab.evaluation.play import Variant
from tactomo_lab.scenes.measures import summarise
from tactomo_models import available_methods
from tactomo_models.sensor.description_file import shipped_text


def point(method: str, p50_s: float, icc: float, budget_s: float | None = None) -> Point:
    summary = summarise([])
    summary = replace(summary, icc=icc, seconds=p50_s, seconds_99=2 * p50_s)
    return Point("still", 40.0, Variant(method, budget_s), summary)


def test_the_rows_tell_what_is_on_the_front() -> None:
    points = [
        point("auto", 0.05, 0.97, budget_s=0.05),
        point("auto", 0.06, 0.96, budget_s=2.0),
        point("noser", 0.001, 0.6),
    ]
    rows = bench_chart.rows_of(points)
    shown = [(r["method"], r["budget_ms"], r["p50_ms"], r["p99_ms"], r["icc"]) for r in rows]
    assert shown == [
        ("noser", None, 1, 2, 0.6),
        ("auto", 50, 50, 100, 0.97),
        ("auto", 2000, 60, 120, 0.96),
    ]
    assert [row["on_front"] for row in rows] == [True, True, False]


def test_a_busy_machine_is_told_in_the_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[str] = []
    measured = [point("noser", 0.001, 0.6)], ["the machine was busy"]
    monkeypatch.setattr(bench_chart, "measure_chart", lambda *_: measured)
    monkeypatch.setattr(bench_chart, "save_figure", lambda figure, _: drawn.append(figure))
    bench_chart.chart("paper_square", tmp_path / "chart.png", 1, "a machine")
    assert "a machine; the machine was busy" in drawn[0].get_suptitle()  # type: ignore[attr-defined]


def test_what_cannot_be_written_is_refused_before_the_work(
    tactomo: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(bench_chart, "measure_chart")
    for picture, why in (
        ("nowhere/chart.png", "there is no folder nowhere"),
        ("chart.txt", "not a kind of picture"),
    ):
        result = tactomo("bench", "--chart", picture, status=1)
        assert why in result.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.long
@pytest.mark.timeout(600)
def test_the_whole_chart(tactomo: Run, tmp_path: Path) -> None:
    """On a coarse map, so that scenes are simulated in seconds."""
    sensor = tmp_path / "coarse.toml"
    sensor.write_text(shipped_text("paper_square") + "[map]\nnodes_x = 21\nnodes_y = 21\n")
    result = tactomo(
        "bench", "--chart", "chart.png", "--count", 1, "--json", "-d", sensor, status=0
    )
    told = json.loads(result.stdout)
    assert told["live"] == []
    places = {(row["scene"], row["snr_db"]) for row in told["chart"]}
    assert places == {("still", 40), ("still", 20), ("still", 10), ("moving", 40)}
    for scene, snr_db in places:
        rows = [r for r in told["chart"] if (r["scene"], r["snr_db"]) == (scene, snr_db)]
        assert any(row["on_front"] for row in rows)
        measured = {row["method"] for row in rows}
        assert {
            m for m in available_methods() if f"left out: {m}:" not in result.stderr
        } == measured
    assert (tmp_path / "chart.png").read_bytes().startswith(b"\x89PNG")

"""What a budget of time buys, and that what was measured elsewhere is not used here."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from tactomo_models import ArtifactError, SensorDescription, load_description, machine_speed
from tactomo_models.machine_speed import (
    CLEARLY,
    MachineSpeed,
    Row,
    load_machine_speed,
    machine_speed_for,
    machine_speed_path,
    save_machine_speed,
)


def row(method: str, budget_ms: float | None, p99_ms: float, icc: float) -> Row:
    budget_s = None if budget_ms is None else budget_ms / 1e3
    return Row(method=method, budget_s=budget_s, p50_s=p99_ms / 2e3, p99_s=p99_ms / 1e3, icc=icc)


AUTO = [row("auto", ms, 4 + 2 * ms, icc) for ms, icc in ((5, 0.8), (10, 0.9), (50, 0.97))]
OTHERS = [row("noser", None, 2.0, 0.6), row("tikhonov", None, 1.0, 0.5)]


@pytest.fixture
def measured(small: SensorDescription) -> MachineSpeed:
    return MachineSpeed.of_rows(small, "2026-01-31", [*AUTO, *OTHERS])


def test_a_time_buys_the_work_that_frames_took_so_long_for(measured: MachineSpeed) -> None:
    assert measured.overhead_s == pytest.approx(4e-3)
    assert measured.speed == pytest.approx(2.0)
    for tier in ("auto", "levelset"):
        plan = measured.plan(tier, 0.03)
        assert plan.method is tier
        assert plan.budget_s == pytest.approx(0.013)


@pytest.mark.parametrize(
    ("time_ms", "tier"),
    [(100, "auto"), (14, "auto"), (13, "noser"), (1.5, "tikhonov"), (0.1, "tikhonov")],
)
def test_auto_takes_the_most_accurate_method_that_keeps_to_the_time(
    measured: MachineSpeed, time_ms: float, tier: str
) -> None:
    assert measured.plan("auto", time_ms / 1e3).method == tier


def test_auto_yields_only_to_what_is_clearly_better(small: SensorDescription) -> None:
    for icc, tier in ((0.91, "auto"), (0.93, "noser")):
        made = MachineSpeed.of_rows(small, "2026-01-31", [AUTO[1], row("noser", None, 2.0, icc)])
        assert made.plan("auto", 1.0).method == tier


def test_what_was_asked_for_by_name_is_given_and_no_time_leaves_all_as_it_is(
    measured: MachineSpeed,
) -> None:
    plan = measured.plan("fit", 1e-4)
    assert plan.method == "fit"
    assert plan.budget_s  # 0 would stand for "as ever"
    assert measured.plan("auto", None) == ("auto", None)


TIMES = st.floats(1e-4, 10)


@given(
    rows=st.lists(
        st.builds(
            row,
            st.sampled_from(["auto", "noser", "tikhonov"]),
            st.floats(1, 100),
            st.floats(0.1, 1e3),
            st.floats(0, 1),
        ),
        min_size=1,
    ),
    time_s=TIMES,
    more_s=TIMES,
)
def test_more_time_never_buys_less(
    small: SensorDescription, rows: list[Row], time_s: float, more_s: float
) -> None:
    assume(any(r.method == "auto" for r in rows))
    made = MachineSpeed.of_rows(small, "2026-01-31", rows)
    less, more = made.best_within(time_s), made.best_within(time_s + more_s)
    assert less is not None
    assert more is not None
    if less.p99_s <= time_s:
        assert more.icc >= less.icc - CLEARLY
    budgets = [made.plan("fit", t).budget_s for t in (time_s, time_s + more_s)]
    assert budgets == sorted(budgets)  # type: ignore[type-var]


def test_what_is_kept_is_found_again(
    small: SensorDescription,
    measured: MachineSpeed,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path / "cache"))
    told: list[str] = []
    before = machine_speed_for(small, told.append)
    assert (before.rows, told) == ((), [])  # no measurement of another sensor tells what is best
    assert "tactomo bench --machine-speed" in before.source
    assert before.plan("auto", 0.05).method == "auto"
    save_machine_speed(measured, machine_speed_path(small))
    after = machine_speed_for(small, told.append)
    assert (after, told) == (measured, [])
    assert after.source == "measured here on 2026-01-31"


def test_the_shipped_one_is_of_the_shipped_sensor(
    paper: SensorDescription, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path))
    shipped = machine_speed_for(paper, pytest.fail)
    assert {"auto", "tikhonov"} <= {row.method for row in shipped.rows}
    assert "shipped" in shipped.source
    assert shipped.plan("auto", 0.05).method == "auto"
    graded = load_description("graded_square")
    assert graded.sha256 == paper.sha256
    assert not machine_speed_for(graded, pytest.fail).rows  # of two sheets, and this is one


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"machine": "Z80"}, "was measured on Z80, not on"),
        ({"sha256": "ab" * 32}, "was measured for abab"),
        ({"tactomo": "0.0.1"}, "was measured by tactomo 0.0.1, not by tactomo"),
        ({"format": 2}, "is damaged (format = 2"),
        ({"speed": 0}, "is damaged (speed = 0"),
        ({"further": 1}, "is damaged (unknown key further)"),
        ({"rows": [{"method": "magic"}]}, "is damaged (rows.0.budget_s is missing"),
        (None, "is damaged (Invalid JSON"),
    ],
)
def test_one_that_does_not_hold_here_is_refused_in_one_line(
    small: SensorDescription,
    measured: MachineSpeed,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    change: dict[str, object] | None,
    why: str,
) -> None:
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path))
    path, text = machine_speed_path(small), measured.model_dump_json()
    path.write_text(text[:99] if change is None else json.dumps({**json.loads(text), **change}))
    with pytest.raises(ArtifactError) as refusal:
        load_machine_speed(path, small)
    assert why in str(refusal.value)
    assert "run: tactomo bench --machine-speed" in str(refusal.value)
    told: list[str] = []
    assert machine_speed_for(small, told.append).rows == ()
    assert len(told) == 1
    assert why in told[0]
    assert "\n" not in told[0]


def test_what_cannot_be_read_or_written_is_said(
    small: SensorDescription, measured: MachineSpeed, tmp_path: Path
) -> None:
    with pytest.raises(ArtifactError, match="cannot read"):
        load_machine_speed(tmp_path, small)
    (tmp_path / "file").write_text("")
    with pytest.raises(ArtifactError, match="cannot write"):
        save_machine_speed(measured, tmp_path / "file" / "speed.json")


def test_the_processor_has_a_name() -> None:
    assert machine_speed.processor()

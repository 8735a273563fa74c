"""What a budget of time buys, and that what was measured elsewhere is not used here."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tactomo_models import ArtifactError, SensorDescription
from tactomo_models.methods import machine_speed
from tactomo_models.methods.machine_speed import (
    MachineSpeed,
    load_machine_speed,
    machine_speed_for,
    machine_speed_path,
    save_machine_speed,
)


@pytest.fixture
def measured(small: SensorDescription) -> MachineSpeed:
    times = {budget_s: 0.004 + 2 * budget_s for budget_s in (0.005, 0.01, 0.05)}
    return MachineSpeed.of_times(small, "2026-01-31", times)


def test_a_time_buys_the_work_that_frames_took_so_long_for(measured: MachineSpeed) -> None:
    assert measured.overhead_s == pytest.approx(4e-3)
    assert measured.speed == pytest.approx(2.0)
    assert measured.budget_s(0.03) == pytest.approx(0.013)


TIMES = st.floats(1e-4, 10)


@given(
    times=st.dictionaries(st.floats(1e-3, 0.1), st.floats(1e-4, 1), min_size=1),
    time_s=TIMES,
    more_s=TIMES,
)
def test_more_time_never_buys_less_and_little_buys_something(
    small: SensorDescription, times: dict[float, float], time_s: float, more_s: float
) -> None:
    made = MachineSpeed.of_times(small, "2026-01-31", times)
    assert 0 < made.budget_s(time_s) <= made.budget_s(time_s + more_s)


def test_what_is_kept_is_found_again(
    small: SensorDescription,
    measured: MachineSpeed,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path / "cache"))
    told: list[str] = []
    before = machine_speed_for(small, told.append)
    assert (before.shipped, told) == (True, [])
    assert "tactomo bench --machine-speed" in before.source
    save_machine_speed(measured, machine_speed_path(small))
    after = machine_speed_for(small, told.append)
    assert (after, told) == (measured, [])
    assert after.source == "measured here on 2026-01-31"


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"machine": "Z80"}, "was measured on Z80, not on"),
        ({"sha256": "ab" * 32}, "was measured for abab"),
        ({"tactomo": "0.0.1"}, "was measured by tactomo 0.0.1, not by tactomo"),
        ({"format": 1, "rows": []}, "was measured by an earlier tactomo; run"),
        ({"speed": 0}, "is damaged (speed = 0"),
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
    assert machine_speed_for(small, told.append).shipped
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

"""`tactomo bench --machine-speed`: what it tells is what daemons then find."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
from tactomo.cli.bench.machine_speed import table_of
from tactomo_models import load_description
from tactomo_models.methods.machine_speed import (
    MachineSpeed,
    load_machine_speed,
    machine_speed_path,
)

Run = Callable[..., Any]


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_machine_is_measured(
    tactomo: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a coarse map, so that the scene is simulated in seconds."""
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path))
    shipped = resources.files("tactomo_models.sensor.shipped").joinpath("paper_square.toml")
    sensor = tmp_path / "coarse.toml"
    sensor.write_text(shipped.read_text("utf-8") + "[map]\nnodes_x = 21\nnodes_y = 21\n")
    result = tactomo("bench", "--machine-speed", "--json", "-d", sensor)
    assert result.returncode == 0, result.stderr
    told = json.loads(result.stdout)
    assert told["overhead_s"] >= 0
    assert told["speed"] > 0
    description = load_description(sensor)
    kept = load_machine_speed(machine_speed_path(description), description)
    assert kept == MachineSpeed.model_validate_json(result.stdout)


def test_what_each_time_buys_is_laid_out() -> None:
    times = {budget_s: 0.007 + 2 * budget_s for budget_s in (0.005, 0.02)}
    measured = MachineSpeed.of_times(load_description("paper_square"), "2026-01-31", times)
    within, budget = table_of(measured).columns
    bought = dict(zip(within.cells, budget.cells, strict=True))
    assert (bought["10"], bought["50"]) == ("1.5", "21.5")

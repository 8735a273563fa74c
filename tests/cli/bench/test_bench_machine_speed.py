"""`tactomo bench --machine-speed`: what it keeps is what it then shows."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
from tactomo_models import load_description
from tactomo_models.methods.machine_speed import (
    MachineSpeed,
    machine_speed_path,
    save_machine_speed,
)

Run = Callable[..., Any]


def test_what_is_in_force_is_shown(
    tactomo: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path))
    shipped = tactomo("bench", "--machine-speed", "--show")
    assert shipped.returncode == 0
    assert "shipped, of" in shipped.stdout
    sensor = load_description("paper_square")
    times = {budget_s: 0.007 + 2 * budget_s for budget_s in (0.005, 0.02)}
    measured = MachineSpeed.of_times(sensor, "2026-01-31", times)
    save_machine_speed(measured, machine_speed_path(sensor))
    words = tactomo("bench", "--machine-speed", "--show")
    assert "measured here on 2026-01-31" in words.stdout
    assert "A frame takes 7.0 ms and 2.00 times its modelled budget" in words.stdout
    bought = [line.split() for line in words.stdout.partition("within")[2].splitlines()]
    cells = [[word for word in line if word not in "│┃"] for line in bought]
    assert ["10", "1.5"] in cells
    assert ["50", "21.5"] in cells
    numbers = tactomo("bench", "--machine-speed", "--show", "--json")
    assert MachineSpeed.model_validate_json(numbers.stdout) == measured
    machine_speed_path(sensor).write_text("{}")
    damaged = tactomo("bench", "--machine-speed", "--show")
    assert damaged.returncode == 0
    assert "is damaged" in damaged.stderr
    assert "shipped, of" in damaged.stdout


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
    shown = tactomo("bench", "--machine-speed", "--show", "--json", "-d", sensor)
    assert json.loads(shown.stdout) == told

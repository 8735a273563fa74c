"""`tactomo evaluate measured`: sets known by their arrays, tables, JSON, files that are none."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulated_tanks import simulated_tanks
from tactomo_models import load_description

Run = Callable[..., Any]


@pytest.fixture
def tank(tmp_path: Path) -> Path:
    """A smaller map, so that the model is built in a second."""
    from importlib import resources

    text = (
        resources.files("tactomo_models.sensor.shipped").joinpath("tank_uef2017.toml").read_text()
    )
    path = tmp_path / "tank.toml"
    path.write_text(text + "\n[map]\nnodes_x = 25\nnodes_y = 25\n")
    return path


@pytest.mark.slow
def test_tanks_are_known_by_their_arrays(tactomo: Run, tank: Path, tmp_path: Path) -> None:
    some = simulated_tanks(load_description(tank), "tuning", 2)
    np.savez(tmp_path / "two.npz", dv=some.changes, truth=some.truth, name=np.array(some.names))
    asked = ("evaluate", "measured", tmp_path / "two.npz", "--description", tank)
    result = tactomo(*asked, "--json")
    assert result.returncode == 0, result.stderr
    told = json.loads(result.stdout)
    assert told["simulated"] is False
    (facts,) = told["sets"].values()
    noser = [one["correlation"] for one in facts["tanks"] if one["method"] == "noser"]
    assert len(noser) == 2
    assert facts["mean_correlation"]["noser"] == pytest.approx(np.mean(noser))
    assert 0.4 < np.mean(noser) < 1
    words = tactomo(*asked).stdout
    for heading in ("measured, two.npz", "tuning 0", "tuning 1", "tikhonov", "noser", "network"):
        assert heading in words


@pytest.mark.slow
def test_presses_in_numbers_and_words(tactomo: Run, tmp_path: Path) -> None:
    skin = load_description("skin_round")
    rng = np.random.default_rng(1)
    np.savez(
        tmp_path / "presses.npz",
        lookup=np.hstack([skin.pairs.drive, skin.pairs.measure]),
        dv=rng.normal(size=(40, 192)),
        pos_m=rng.uniform(-0.03, 0.03, size=(40, 3)),
    )
    result = tactomo("evaluate", "measured", tmp_path / "presses.npz", "--json")
    assert result.returncode == 0
    told = json.loads(result.stdout)["sets"]["presses.npz"]
    assert told["presses"] == 40
    noise = told["methods"]["NOSER image"]  # of which nothing can be located
    assert noise["median_mm"] > 15
    assert noise["most_mm"] > noise["median_mm"]
    result = tactomo("evaluate", "measured", tmp_path / "presses.npz")
    assert "taught by" in result.stdout


@pytest.mark.parametrize("command", ["measured", "ktc"])
def test_a_file_that_is_none(tactomo: Run, tmp_path: Path, command: str) -> None:
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    result = tactomo("evaluate", command, tmp_path / "other.npz")
    assert result.returncode == 1
    assert "is no set of" in result.stderr
    result = tactomo("evaluate", command, tmp_path / "absent.npz")
    assert result.returncode == 1
    assert "cannot read" in result.stderr


def test_a_sensor_that_is_no_tank_is_refused_before_the_work(tactomo: Run, tmp_path: Path) -> None:
    empty = np.zeros(0)
    np.savez(tmp_path / "tanks.npz", dv=empty, truth=empty, name=empty)
    result = tactomo("evaluate", "measured", "tanks.npz", "-d", "paper_square")
    assert result.returncode == 1
    assert "is no round tank" in result.stderr

"""`tactomo evaluate measured` and `presses`: sets, tables, JSON, files that are none."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_skin import presses_on
from fixture_types import Run
from shared_data import measured
from simulated_tanks import simulated_tanks
from tactomo_models import load_description
from tactomo_models.sensor.description_file import shipped_text


@pytest.fixture
def tank(tmp_path: Path) -> Path:
    """A smaller map, so that the model is built in a second."""
    path = tmp_path / "tank.toml"
    path.write_text(shipped_text("tank_uef2017") + "\n[map]\nnodes_x = 25\nnodes_y = 25\n")
    return path


@pytest.mark.slow
def test_tanks_are_known_by_their_arrays(tactomo: Run, tank: Path, tmp_path: Path) -> None:
    some = simulated_tanks(load_description(tank), "tuning", 2)
    np.savez(tmp_path / "two.npz", dv=some.changes, truth=some.truth, name=np.array(some.names))
    asked = ("evaluate", "measured", tmp_path / "two.npz", "--description", tank)
    result = tactomo(*asked, "--json", status=0)
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
    result = tactomo("evaluate", "measured", tmp_path / "presses.npz", "--json", status=0)
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
    result = tactomo("evaluate", command, tmp_path / "other.npz", status=1)
    assert "is no set of" in result.stderr
    result = tactomo("evaluate", command, tmp_path / "absent.npz", status=1)
    assert "cannot read" in result.stderr


@pytest.mark.parametrize(
    ("arrays", "told"),
    [
        ({"dv": np.ones((1, 208)), "truth": np.ones((1, 8, 8)), "name": ["a"]}, "never falls"),
        ({"dv": np.ones((1, 208)), "truth": np.ones((1, 8, 8)), "name": "a"}, "never falls"),
        (
            {"lookup": np.ones((4, 4)), "dv": np.full((9, 4), np.nan), "pos_m": np.ones((9, 2))},
            "leave them out",
        ),
    ],
)
def test_numbers_that_no_instrument_measures(
    tactomo: Run, tmp_path: Path, arrays: dict[str, Any], told: str
) -> None:
    np.savez(tmp_path / "odd.npz", **arrays)
    assert told in tactomo("evaluate", "measured", tmp_path / "odd.npz", status=1).stderr


def test_a_sensor_that_is_no_tank_is_refused_before_the_work(tactomo: Run, tmp_path: Path) -> None:
    empty = np.zeros(0)
    np.savez(tmp_path / "tanks.npz", dv=empty, truth=empty, name=empty)
    result = tactomo("evaluate", "measured", "tanks.npz", "-d", "paper_square", status=1)
    assert "is no round tank" in result.stderr


def test_the_last_are_judged_by_the_first(tactomo: Run, tmp_path: Path) -> None:
    changes, xy_mm = presses_on(1, 400)
    changes[100:300] = np.random.default_rng(0).standard_normal((200, 40))  # neither of both
    path = tmp_path / "skins.npz"
    np.savez(path, a_voltages=changes, a_xy_mm=xy_mm, b_voltages=changes, b_xy_mm=-xy_mm)
    result = tactomo("evaluate", "presses", path, "--train", 100, "--json", status=0)
    a, b = json.loads(result.stdout)["skins"]
    assert (a["name"], b["name"], a["train"], a["judged"]) == ("a", "b", 100, 150)
    assert len(a["median_mm_since"]) == 4
    assert a["median_mm_since"][0] > 10 > 4 > a["median_mm_since"][-1]
    words = tactomo("evaluate", "presses", path, "--train", 300).stdout
    assert "learnt from the first 300" in words


@pytest.mark.parametrize(
    ("arrays", "told"),
    [
        ({"other": np.zeros(3)}, "is no set of presses"),
        ({"a_voltages": np.zeros((9, 4))}, "no a_xy_mm"),
        ({"a_voltages": np.zeros((9, 4)), "a_xy_mm": np.zeros((8, 2))}, "(9, 4)"),
        ({"a_voltages": np.zeros((9, 4)), "a_xy_mm": np.zeros((9, 2))}, "--train 4 or less"),
        ({"a_voltages": np.zeros((40, 4)), "a_xy_mm": np.eye(40, 2)}, "a: press 0"),
    ],
)
def test_files_that_are_none(
    tactomo: Run, tmp_path: Path, arrays: dict[str, Any], told: str
) -> None:
    np.savez(tmp_path / "skins.npz", **arrays)
    result = tactomo("evaluate", "presses", tmp_path / "skins.npz", "--train", 20, status=1)
    assert told in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize(("train", "asked_mm"), [(100, 4.5), (200, 3.6), (800, 2.3)])
def test_measured_skins(tactomo: Run, train: int, asked_mm: float) -> None:
    """Plain kernel ridge regression comes to 7.1, 5.2 and 3.0 mm."""
    result = tactomo(
        "evaluate", "presses", measured("skins_anisotropy.npz"), "--train", train, "--json"
    )
    skins = json.loads(result.stdout)["skins"]
    assert np.mean([one["median_mm"] for one in skins]) < asked_mm
    assert 0.6 < np.median([one["within_sigma"] for one in skins]) < 0.8

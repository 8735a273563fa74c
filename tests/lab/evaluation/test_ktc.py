"""Tanks of the Kuopio Tomography Challenge: simulated ones, the four measured ones, bad files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from challenge_tanks import FINE_RINGS, challenge_pattern, simulated_tank
from fixture_types import Run
from shared_data import measured
from tactomo_lab.evaluation.ktc import (
    evaluate_challenge,
    every_reading,
    kept_readings,
    read_challenge,
)
from tactomo_lab.tanks.model import TankModel
from tactomo_models import DataError, load_description
from tactomo_models.arrays import FloatArray

Arrays = dict[str, Any]

SEED = 0
LEVELS = (1, 4, 7)


@pytest.fixture(scope="module")
def tank_model() -> TankModel:
    return TankModel(load_description("tank_ktc2023"), FINE_RINGS)


@pytest.fixture(scope="module")
def simulated(tank_model: TankModel) -> Arrays:
    """Six tanks in volts and amperes, with noise; of each level two."""
    currents, weights = challenge_pattern()
    drive, measure = 1.5 * currents[::31].T, weights[:31].T
    currents, weights = every_reading(drive, measure)
    one, other = tank_model.pairs
    rng = np.random.default_rng(SEED)
    empty = tank_model.readings_of_empty(currents, weights) / 0.74
    voltages, truth = [], []
    for count in range(6):
        kind, solved = simulated_tank(tank_model, rng)
        transfer = np.zeros((32, 32))
        transfer[one, other] = transfer[other, one] = solved
        change = ((currents @ transfer) * weights).sum(axis=1) / 0.74
        change += 0.03 * np.sqrt(np.mean(change**2)) * rng.standard_normal(len(change))
        lost = ~kept_readings(currents, weights, range(2 * LEVELS[count // 2] - 2))
        voltages.append(np.where(lost, np.nan, empty + change))
        truth.append(np.where(kind > 0, 2, kind < 0))
    return {
        "injection": np.array([drive] * 6),
        "measurement": measure,
        "reference": np.array([empty] * 6),
        "voltages": np.array(voltages),
        "truth": np.array(truth, np.uint8),
        "level": np.repeat(LEVELS, 2),
    }


@pytest.mark.slow
def test_simulated_tanks_are_scored(tactomo: Run, simulated: Arrays, tmp_path: Path) -> None:
    np.savez(tmp_path / "six.npz", **simulated)
    asked = ("evaluate", "ktc", tmp_path / "six.npz")
    result = tactomo(*asked, "--json", status=0)
    told = json.loads(result.stdout)
    scores = [tank["score"] for tank in told["tanks"]]
    assert told["score"] == pytest.approx(sum(scores))
    assert np.mean(scores) > 0.7
    assert [tank["level"] for tank in told["tanks"]] == list(simulated["level"])
    assert [tank["readings"] for tank in told["tanks"]][::2] == [2356, 48 * 25, 27 * 19]
    assert max(tank["seconds"] for tank in told["tanks"]) < 10
    assert "sum" in tactomo(*asked).stdout


@pytest.mark.slow
def test_the_unit_of_the_voltages_does_not_matter(simulated: Arrays, tmp_path: Path) -> None:
    """What counts is what the empty tank shows."""
    tank = load_description("tank_ktc2023")

    def images(changed: Arrays) -> FloatArray:
        two: Arrays = {k: v[2:4] if len(v) == 6 else v for k, v in changed.items()}
        np.savez(tmp_path / "some.npz", **two)
        given = read_challenge(tmp_path / "some.npz", tank)
        return np.array([outcome.image for outcome in evaluate_challenge(given, tank)])

    as_it_is = images(simulated)
    in_mv = {key: 1e3 * simulated[key] for key in ("reference", "voltages")}
    assert (images({**simulated, **in_mv}) == as_it_is).mean() > 0.999


@pytest.mark.parametrize(
    ("key", "change", "said"),
    [
        ("voltages", lambda a: a[:, :-1], "voltages is"),
        ("voltages", lambda a: a * np.nan, "no reading that is a number"),
        ("injection", lambda a: a[:, :16], "injection is"),
        ("truth", lambda a: a + 1, "other values"),
        ("truth", lambda a: a[0, 0, 0], "single number"),
        ("injection", lambda a: a * 1j, "none that is real"),
        ("voltages", lambda a: a * 1e308, "beyond 1e"),
        ("level", lambda a: a[:2], "level is"),
        ("level", lambda a: a * np.nan, "0 to 7"),
        ("level", lambda a: a.astype(str), "0 to 7"),
    ],
)
def test_what_is_no_challenge(
    simulated: Arrays, tmp_path: Path, key: str, change: Callable[[Any], Any], said: str
) -> None:
    np.savez(tmp_path / "bad.npz", **{**simulated, key: change(simulated[key])})
    with pytest.raises(DataError, match=said):
        read_challenge(tmp_path / "bad.npz", load_description("tank_ktc2023"))


def test_what_the_command_refuses(tactomo: Run, simulated: Arrays, tmp_path: Path) -> None:
    np.savez(tmp_path / "turned.npz", **{**simulated, "reference": -simulated["reference"]})
    result = tactomo("evaluate", "ktc", tmp_path / "turned.npz", status=1)
    assert "the reference is no scan of this tank" in result.stderr
    result = tactomo(
        "evaluate", "ktc", tmp_path / "turned.npz", "--description", "paper_square", status=1
    )
    assert "no round tank" in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize(("level", "least"), [(1, 0.88), (4, 0.8), (7, 0.7)])
def test_measured_tanks(level: int, least: float) -> None:
    tank = load_description("tank_ktc2023")
    given = read_challenge(measured("ktc2023_training.npz"), tank).at_level(level)
    np.testing.assert_array_equal(
        np.sign(every_reading(given.currents[0], given.weights)), challenge_pattern()
    )
    outcomes = list(evaluate_challenge(given, tank))
    assert np.mean([outcome.score for outcome in outcomes]) > least
    assert all(
        outcome.readings == np.isfinite(v).sum()
        for outcome, v in zip(outcomes, given.voltages, strict=True)
    )

"""Measured tanks and skin presses, where they lie beside the project."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tactomo_models import load_description
from tactomo_models.evaluation.skin_presses import localise, read_presses
from tactomo_models.evaluation.tanks import (
    TankImager,
    Tanks,
    estimate_scale,
    evaluate_tanks,
    read_tanks,
)

DATA = Path(__file__).parents[2].parent / "shared" / "data"


def measured(name: str) -> Path:
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{name} is not beside the project")
    return path


@pytest.fixture(scope="module")
def tanks() -> Tanks:
    path = measured("tank_uef2017.npz")
    return read_tanks(path, load_description("tank_uef2017"))


@pytest.mark.slow
def test_measured_tanks(tanks: Tanks) -> None:
    imager = TankImager(load_description("tank_uef2017"))
    scale = estimate_scale(imager, tanks.changes)
    outcomes = list(evaluate_tanks(imager, tanks, ["tikhonov", "noser", "levelset"], scale))
    mean = {
        method: np.mean([o.correlation for o in outcomes if o.method == method])
        for method in ("tikhonov", "noser", "levelset")
    }
    assert mean["levelset"] > 0.84
    assert mean["noser"] > 0.7
    assert mean["tikhonov"] > 0.64
    for outcome, truth in zip(outcomes[2::3], tanks.truth, strict=True):
        for sign in (-1, 1):
            if (truth == sign).any():
                assert sign * np.nanmean(outcome.image[truth == sign]) > 0.4, outcome.name


@pytest.mark.slow
def test_turned_tanks_are_not_recognised(tanks: Tanks) -> None:
    """Electrode 0 at the bottom, counter-clockwise: any other way correlates with nothing."""
    imager = TankImager(load_description("tank_uef2017"))
    means = []
    for truth in (tanks.truth, np.rot90(tanks.truth, 1, (1, 2)), tanks.truth[:, :, ::-1]):
        turned = Tanks(tanks.names, tanks.changes, truth)
        outcomes = evaluate_tanks(imager, turned, ["noser"], 1.0)
        means.append(np.mean([outcome.correlation for outcome in outcomes]))
    assert means[0] > max(means[1:]) + 0.2


def test_measured_presses() -> None:
    path = measured("skin_round_presses.npz")
    skin = load_description("skin_round")
    found = {one.method: one.median_mm for one in localise(read_presses(path, skin), skin)}
    assert found["mean position (no measurement)"] > 25
    assert found["NOSER image"] < 6.5
    assert found["ridge regression (no physics)"] < 3

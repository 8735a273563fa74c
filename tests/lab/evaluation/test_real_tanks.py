"""Measured tanks and skin presses, where they lie beside the project."""

from __future__ import annotations

import re

import numpy as np
import pytest
from shared_data import measured
from tactomo_lab.evaluation.presses import IMAGE, TAUGHT, localise, read_presses
from tactomo_lab.evaluation.tanks import TankImager, Tanks, evaluate_tanks, read_tanks
from tactomo_models import load_description

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def tanks() -> Tanks:
    path = measured("tank_uef2017.npz")
    return read_tanks(path, load_description("tank_uef2017"))


def test_measured_tanks(tanks: Tanks) -> None:
    imager = TankImager(load_description("tank_uef2017"))
    methods = ("tikhonov", "noser", "network")
    outcomes = list(evaluate_tanks(imager, tanks, methods))
    mean = {
        method: np.mean([o.correlation for o in outcomes if o.method == method])
        for method in methods
    }
    assert mean["network"] > 0.84
    assert mean["noser"] > 0.7
    assert mean["tikhonov"] > 0.64
    for outcome, truth in zip(outcomes[2::3], tanks.truth, strict=True):
        for sign in (-1, 1):
            if (truth == sign).any():
                assert sign * np.nanmean(outcome.image[truth == sign]) > 0.3, outcome.name


def test_objects_stand_at_the_electrodes_that_their_names_tell() -> None:
    """Another tank, of unknown size: metal and plastic beside electrodes 1, 5, 9, 13."""
    tank = load_description("tank_uef2017")
    imager = TankImager(tank)
    x, y = np.meshgrid(tank.map_x_m, tank.map_y_m)
    with np.load(measured("tank_labelled.npz")) as scans:
        arrays = [scans[key] for key in ("name", "target", "reference")]
    seen = 0
    for name, target, reference in zip(*arrays, strict=True):
        change = np.abs(target.real) - np.abs(reference.real)
        image = imager.reconstruct(change, "noser").structure
        assert image is not None
        for electrode, kind in re.findall(r"electrode(\d\d)_(metal|plastic)", name):
            angle = np.radians(-90 + (int(electrode) - 1) * 22.5)
            near = np.hypot(x - 0.1 * np.cos(angle), y - 0.1 * np.sin(angle)) < 0.03
            strongest = image[near][np.abs(image[near]).argmax()]
            assert (strongest > 0.3) if kind == "metal" else (strongest < -0.3), name
            seen += 1
    assert seen >= 16


def test_measured_presses() -> None:
    path = measured("skin_round_presses.npz")
    skin = load_description("skin_round")
    found = {name: np.median(mm) for name, mm in localise(read_presses(path, skin), skin)}
    assert found[IMAGE] < 6.5
    assert found[TAUGHT] < 1.5

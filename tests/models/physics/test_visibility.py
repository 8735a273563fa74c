"""Where a sensor sees well: the first order against whole solves of the same presses."""

from __future__ import annotations

import numpy as np
import pytest
from tactomo_models import SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.artifact import Artifact, build_artifact, nominal_noise
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.sensitivity import CHANGE, Visibility, find_visibility

PLACES = [(0.0, 0.0), (0.012, -0.006), (-0.018, 0.012)]


@pytest.fixture(scope="module")
def artifact(small: SensorDescription) -> Artifact:
    return build_artifact(small)


@pytest.fixture(scope="module")
def seen(small: SensorDescription, artifact: Artifact) -> Visibility:
    return find_visibility(small, artifact)


def signal_of(
    artifact: Artifact, sensor: SensorDescription, x_m: float, y_m: float, radius_m: float
) -> FloatArray:
    """Changes (M,) of the voltages by a press, in units of their noise: a solve, no first order."""
    model = ForwardModel(sensor, artifact.bare)
    x, y = artifact.bare.points[:, artifact.bare.pressable]
    step_m = sensor.width_m / (sensor.map.nodes_x - 1)
    cover = np.clip((radius_m + step_m - np.hypot(x - x_m, y - y_m)) / step_m, 0, 1)
    cover *= np.pi * radius_m**2 / (cover @ model.node_areas_m2)
    bare = model.bare_voltages
    change = (model.solve(CHANGE * cover).voltages - bare) / np.abs(bare)
    return np.asarray(change / nominal_noise(bare))


@pytest.mark.parametrize(("x_m", "y_m"), PLACES)
def test_the_signal_is_that_of_a_press(
    small: SensorDescription, artifact: Artifact, seen: Visibility, x_m: float, y_m: float
) -> None:
    row, column = np.abs(small.map_y_m - y_m).argmin(), np.abs(small.map_x_m - x_m).argmin()
    x_m, y_m = small.map_x_m[column], small.map_y_m[row]
    assert seen.diameter_m == pytest.approx(0.010)
    solved = np.linalg.norm(signal_of(artifact, small, x_m, y_m, seen.diameter_m / 2))
    assert seen.signal[row, column] == pytest.approx(solved, rel=0.1)


@pytest.mark.parametrize(("x_m", "y_m"), PLACES)
def test_a_press_that_moves_by_its_uncertainty_is_as_unlike_as_noise_is(
    small: SensorDescription, artifact: Artifact, seen: Visibility, x_m: float, y_m: float
) -> None:
    row, column = np.abs(small.map_y_m - y_m).argmin(), np.abs(small.map_x_m - x_m).argmin()
    place_m = seen.place_m[row, column]
    step_m = 0.2 * place_m  # in proportion: the uncertainty itself may be a long way
    here = signal_of(artifact, small, x_m, y_m, 0.005)
    moved = [
        np.linalg.norm(signal_of(artifact, small, x_m + dx, y_m + dy, 0.005) - here) / 0.2
        for dx, dy in ((step_m, 0.0), (0.0, step_m))
    ]
    assert 1.0 < np.linalg.norm(moved) < 6.0


def test_it_tells_nothing_where_no_press_fits(seen: Visibility, small: SensorDescription) -> None:
    known = np.isfinite(seen.signal)
    assert not known[0].any()
    assert not known[:, -1].any()
    assert known[small.map.nodes_y // 2, small.map.nodes_x // 2]
    assert (known == np.isfinite(seen.place_m)).all()

"""Symmetries: a turned scene gives permuted voltages, and a permuted map shows it turned."""

from __future__ import annotations

import numpy as np
import pytest
from small_sensor import SMALL
from tactomo_lab.scenes.simulation import truth_of
from tactomo_models import Press, SensorDescription, SkinSimulator, load_description
from tactomo_models.sensor.symmetry import Symmetry, symmetries
from tactomo_protocol import Channel

SQUARE = SMALL.replace("width_m = 0.06", "width_m = 0.05")
PRESS = Press(0.012, 0.004, 180.0, radius_m=0.006, radius_y_m=0.004, angle_rad=0.4)


def sensor(text: str, folder: object) -> SensorDescription:
    path = folder / "sensor.toml"  # type: ignore[operator]
    path.write_text(text)
    return load_description(str(path))


def turned(press: Press, symmetry: Symmetry) -> Press:
    x, y = symmetry.matrix @ [press.x_m, press.y_m]
    along = symmetry.matrix @ [np.cos(press.angle_rad), np.sin(press.angle_rad)]
    return Press(
        float(x),
        float(y),
        press.pressure_kpa,
        press.radius_m,
        press.radius_y_m,
        float(np.arctan2(along[1], along[0])),
    )


def test_a_square_has_eight_and_an_oblong_sheet_four(tmp_path: object) -> None:
    assert len(symmetries(sensor(SQUARE, tmp_path))) == 8
    assert len(symmetries(sensor(SMALL, tmp_path))) == 4


def test_the_paper_sensor_keeps_every_voltage_under_all_eight() -> None:
    for symmetry in symmetries(load_description("paper_square")):
        assert sorted(symmetry.scan) == list(range(208))
        assert (symmetry.sign == 1).all()  # adjacent pairs turn over together


@pytest.mark.parametrize("text", [SQUARE, SMALL], ids=["square", "oblong"])
def test_turned_scenes_give_permuted_voltages(tmp_path: object, text: str) -> None:
    description = sensor(text, tmp_path)
    simulator = SkinSimulator(description, spacing_m=0.0015)
    rest = simulator.voltages([])[Channel.STRUCTURE]
    change = simulator.voltages([PRESS])[Channel.STRUCTURE] - rest
    for symmetry in symmetries(description):
        expected = symmetry.sign * change[symmetry.scan]
        seen = simulator.voltages([turned(PRESS, symmetry)])[Channel.STRUCTURE] - rest
        # The mesh itself is not symmetric: diagonals alternate.
        assert np.linalg.norm(seen - expected) < 0.05 * np.linalg.norm(change)


@pytest.mark.parametrize("text", [SQUARE, SMALL], ids=["square", "oblong"])
def test_turned_maps_show_the_turned_scene(tmp_path: object, text: str) -> None:
    description = sensor(text, tmp_path)
    truth = truth_of(description, [PRESS]).map
    for symmetry in symmetries(description):
        expected = truth_of(description, [turned(PRESS, symmetry)]).map
        np.testing.assert_allclose(truth.ravel()[symmetry.nodes], expected.ravel(), atol=1e-9)

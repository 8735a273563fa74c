"""Electrodes as pictures show them: discs for pads, and each number where it can be read."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.patches import Circle
from tactomo.cli.plot.electrodes import draw_electrodes
from tactomo_models import load_description
from variants import variant

GAP_MM = 5.0


def test_a_pad_is_a_disc_of_its_size_with_its_number_above() -> None:
    palm = load_description("palm_l")
    places = (*(palm.electrodes.positions_m or ()), (-0.03, 0.02))
    sensor = variant(palm, electrodes={"positions_m": places, "pad_radius_m": 0.004})
    axes = Figure().subplots()
    draw_electrodes(axes, sensor, GAP_MM)
    [pad] = [each for each in axes.patches if isinstance(each, Circle)]
    assert (pad.get_radius(), *pad.center) == (4.0, -30.0, 20.0)
    assert axes.texts[-1].get_position() == (-30.0, 20.0 + 4.0 + GAP_MM)
    assert len(axes.lines) == len(places) - 1

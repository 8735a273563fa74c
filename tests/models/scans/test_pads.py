"""Electrodes inside a sheet: no press is taken for a fault of theirs."""

from __future__ import annotations

import numpy as np
import pytest
from noisy_skin import Skin
from tactomo_models import Press, Reconstructor, SkinSimulator, load_description
from variants import variant

RIM = load_description("palm_l").electrodes.positions_m or ()
PADS = ((-0.03, 0.02), (-0.03, -0.03), (0.03, -0.03))


@pytest.mark.parametrize("inside", [pytest.param(PADS, marks=pytest.mark.slow), PADS[::-1]])
def test_presses_beside_pads_are_no_invalid_voltages(
    inside: tuple[tuple[float, float], ...],
) -> None:
    """Between pads, a press may turn a voltage round, which it cannot between rim electrodes."""
    places = {"positions_m": (*RIM, *inside), "pad_radius_m": 0.003}
    sensor = variant(load_description("palm_l"), electrodes=places)
    skin = Skin(SkinSimulator(sensor))
    made = Reconstructor(sensor, budget_s=2.0)
    made.set_reference(skin.reference())
    for x_m, y_m in ((-0.015, 0.005), (-0.03, 0.0), (0.0, -0.03), (-0.045, 0.035)):
        made.reset()
        frame = made.reconstruct(skin.scan(Press(x_m, y_m, 180.0, 0.01))["magnitude"], None)
        assert not frame.flags
        [contact] = frame.contacts
        assert np.hypot(contact.x_m - x_m, contact.y_m - y_m) < 1e-3


@pytest.mark.slow
def test_pads_on_an_axis_of_symmetry_spoil_nothing() -> None:
    """Some voltages between them are next to nothing at rest."""
    rim = [(-0.03, -0.075), (0.03, -0.075), (0.075, -0.03), (0.075, 0.03)]
    rim += [(-x, -y) for x, y in rim]
    places = (*rim, (-0.03, 0.0), (0.03, 0.0), (0.0, 0.03), (0.0, -0.03))
    plain = {"per_side": None, "pitch_m": None, "positions_m": places, "pad_radius_m": 0.003}
    sensor = variant(load_description("graded_square"), electrodes=plain)
    skin = Skin(SkinSimulator(sensor, unevenness=0.05, impedance_spread=0.1, seed=1))
    made = Reconstructor(sensor, budget_s=2.0)
    made.set_reference(skin.reference())
    for x_m, y_m in ((0.02, 0.035), (-0.03, 0.02), (0.0, 0.0), (0.04, -0.02)):
        made.reset()
        frame = made.reconstruct(skin.scan(Press(x_m, y_m, 180.0, 0.012))["magnitude"], None)
        assert not frame.flags
        [contact] = frame.contacts
        assert np.hypot(contact.x_m - x_m, contact.y_m - y_m) < 1.5e-3

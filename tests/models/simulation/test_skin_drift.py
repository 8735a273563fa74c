"""The simulated skin's own drift: temperature, and what presses leave behind."""

from __future__ import annotations

import numpy as np
import pytest
from tactomo_models import Press, SensorDescription, SkinSimulator
from tactomo_models.arrays import FloatArray
from tactomo_models.simulation.skin_drift import DriftingSkin, SkinDrift, decades_left
from tactomo_protocol import Channel

PRESS = [Press(0.0, 0.0, 180.0, 0.02)]


@pytest.fixture(scope="module")
def sheet(small: SensorDescription) -> SkinSimulator:
    return SkinSimulator(small, seed=3)


def changes(
    skin: DriftingSkin, sheet: SkinSimulator, time_s: float, presses: list[Press]
) -> FloatArray:
    """Change of the logarithms of the structure channel's voltages."""
    now, bare = skin.voltages(presses, time_s), sheet.voltages([])
    return np.asarray(np.log(now[Channel.STRUCTURE] / bare[Channel.STRUCTURE]))


def test_by_itself_a_skin_does_nothing(sheet: SkinSimulator) -> None:
    skin = DriftingSkin(sheet)
    for time_s, presses in ((0.0, []), (5.0, PRESS), (3600.0, [])):
        for name, volts in skin.voltages(presses, time_s).items():
            np.testing.assert_array_equal(volts, sheet.voltages(presses)[name])


def test_a_warmer_sheet_conducts_better_a_little_unevenly(sheet: SkinSimulator) -> None:
    even = DriftingSkin(sheet, SkinDrift(step_k=5.0, uneven=0.0))
    np.testing.assert_allclose(changes(even, sheet, 0.0, []), -0.1, rtol=1e-9)
    uneven = changes(DriftingSkin(sheet, SkinDrift(step_k=5.0)), sheet, 0.0, [])
    assert 1e-4 < uneven.std() < 0.05
    swinging = DriftingSkin(sheet, SkinDrift(swing_k=10.0, period_s=400.0, uneven=0.0))
    seen = [changes(swinging, sheet, 50.0 + time_s, [])[0] for time_s in (0, 100, 200, 300)]
    np.testing.assert_allclose(seen, [0.0, -0.1, 0.0, 0.1], atol=1e-9)


def test_a_press_creeps_and_what_it_leaves_relaxes_with_the_logarithm_of_time(
    sheet: SkinSimulator,
) -> None:
    skin = DriftingSkin(sheet, SkinDrift(creep=0.01))
    assert np.abs(changes(skin, sheet, 0.0, [])).max() < 1e-12
    early = skin.voltages(PRESS, 10.0)[Channel.MAGNITUDE]
    late = skin.voltages(PRESS, 1010.0)[Channel.MAGNITUDE]
    assert not np.array_equal(early, late)
    left = [np.abs(changes(skin, sheet, 1010.1 + t, [])).max() for t in (1.0, 9.0, 99.0, 999.0)]
    assert left[0] > 5e-4
    expected = decades_left(1000.0, np.array([1.0, 9.0, 99.0, 999.0]))
    np.testing.assert_allclose(np.array(left) / left[0], expected / expected[0], rtol=0.15)
    assert np.abs(changes(skin, sheet, 1e5, [])).max() < 1e-12


def test_contact_impedances_wander(sheet: SkinSimulator) -> None:
    skin = DriftingSkin(sheet, SkinDrift(impedance=0.5))
    assert np.abs(changes(skin, sheet, 0.0, [])).max() < 1e-9
    assert np.isfinite(changes(skin, sheet, 3000.0, [])).all()


@pytest.mark.slow
def test_equal_seeds_drift_alike(sheet: SkinSimulator) -> None:
    drift = SkinDrift(swing_k=10.0, impedance=0.2)
    one, same, other = (DriftingSkin(sheet, drift, seed) for seed in (1, 1, 2))
    for skin in (one, same, other):
        skin.voltages([], 0.0)
    seen = [changes(skin, sheet, 9000.0, []) for skin in (one, same, other)]
    np.testing.assert_array_equal(seen[0], seen[1])
    assert not np.array_equal(seen[0], seen[2])

"""The simulated skin: what presses shows in the voltages as the description says it does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tactomo_models import Artifact, Press, SensorDescription, SkinSimulator
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.simulation.simulator import blended
from tactomo_protocol import Channel
from variants import variant

PLACE = (0.005, -0.004)


@pytest.fixture(scope="module")
def bench(small: SensorDescription) -> SkinSimulator:
    return SkinSimulator(small)


def press(kpa: float, radius_m: float = 0.008) -> Press:
    return Press(*PLACE, kpa, radius_m)


def change(bench: SkinSimulator, *presses: Press) -> dict[str, float]:
    """Largest relative change of a voltage, by channel."""
    rest, pressed = bench.voltages([]), bench.voltages(presses)
    return {str(name): float(np.abs(pressed[name] / rest[name] - 1).max()) for name in rest}


def test_the_channels_answer_where_the_description_says(bench: SkinSimulator) -> None:
    """Here: magnitude from 100 to 200 kPa, structure at once and no further."""
    light, onset, half, full, more = (change(bench, press(p)) for p in (1, 100, 150, 200, 400))
    assert light["magnitude"] == onset["magnitude"] == 0
    assert 0.01 < half["magnitude"] < full["magnitude"] == more["magnitude"]
    assert 0.2 < light["structure"] == more["structure"]


def test_a_falling_sensor_goes_the_other_way(
    small: SensorDescription, bench: SkinSimulator
) -> None:
    falling = variant(
        small,
        magnitude={
            "response": {"pressure_kpa": [0.0, 100.0, 200.0], "relative_change": [0.0, 0.0, -0.2]}
        },
        structure={"conductivity_ratio": 0.01},
    )
    other = SkinSimulator(falling)
    for name, rest in bench.voltages([]).items():
        rising = bench.voltages([press(180)])[name] - rest
        fallen = other.voltages([press(180)])[name] - rest
        assert float(np.sign(rising) @ np.sign(fallen)) < -0.9 * len(rest)


@given(st.floats(-4.6, 4.6))
def test_an_outline_that_is_drawn_over_some_width_answers_as_a_sharp_one(log_ratio: float) -> None:
    """Along it, currents gain what they lose across it, to first order in its width."""
    full = np.exp(log_ratio)
    coverage = (np.arange(2000) + 0.5) / 2000
    ratio = blended(full, coverage)
    along = ratio.mean() - (1 + full) / 2
    across = full**2 * ((1 / ratio).mean() - (1 + 1 / full) / 2)
    assert along == pytest.approx(across, abs=1e-6 * max(full, 1) ** 2)


@pytest.mark.parametrize("change", [2.0, -0.6])
def test_a_press_on_a_graded_sheet_answers_alike_on_a_coarse_and_a_fine_mesh(
    small: SensorDescription, change: float
) -> None:
    response = {"pressure_kpa": [0.0, 200.0], "relative_change": [0.0, change]}
    graded = variant(small, magnitude={"response": response})
    name, pressed = Channel.MAGNITUDE, [press(190, 0.006)]
    coarse, fine = (
        skin.voltages(pressed)[name] - skin.voltages([])[name]
        for skin in (SkinSimulator(graded, spacing_m) for spacing_m in (0.002, 0.0007))
    )
    assert coarse @ fine / (fine @ fine) == pytest.approx(1, abs=0.02)


def test_a_press_off_the_sheet_or_of_no_pressure_is_none(bench: SkinSimulator) -> None:
    for nothing in (press(0), Press(0.5, 0.5, 180.0)):
        assert change(bench, nothing) == {"magnitude": 0, "structure": 0}


def test_an_uneven_sheet_is_as_uneven_as_asked_and_the_same_for_a_seed(
    small: SensorDescription, bench: SkinSimulator
) -> None:
    even = bench.voltages([])[Channel.STRUCTURE]
    first, again, other = (
        SkinSimulator(small, unevenness=0.05, impedance_spread=0.2, seed=seed).voltages([])
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first[Channel.STRUCTURE], again[Channel.STRUCTURE])
    assert not np.allclose(first[Channel.STRUCTURE], other[Channel.STRUCTURE], rtol=1e-3)
    assert 0.005 < np.abs(first[Channel.STRUCTURE] / even - 1).max() < 0.5


def test_the_data_are_not_made_by_the_model_that_inverts_them(
    paper: SensorDescription, artifact: Artifact, simulator: SkinSimulator
) -> None:
    """Another mesh: unpressed voltages differ by its error, and by no more than a few percent."""
    forward = ForwardModel(paper, artifact.bare)
    rest = SkinSimulator(paper, spacing_m=0.004).voltages([])[Channel.STRUCTURE]
    predicted = forward.bare_voltages * forward.volts_per_unit
    difference = np.abs(rest / predicted - 1)
    assert 1e-5 < difference.max() < 0.02
    uneven = simulator.voltages([])[Channel.STRUCTURE]
    assert 0.01 < np.abs(uneven / predicted - 1).max() < 0.3

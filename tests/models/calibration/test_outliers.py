"""Slips are told from scatter, and what scatters is no slip."""

from __future__ import annotations

import numpy as np
import pytest
from tactomo_models.calibration.curve import Reading
from tactomo_models.calibration.outliers import find_outliers

LEVELS_KPA = np.concatenate([np.linspace(90, 240, 8), np.linspace(230, 120, 6)])


def table(seed: int, scatter: float, hysteresis: float) -> list[Reading]:
    """Rising and falling loads on a channel that answers from 120 kPa on."""
    rng = np.random.default_rng(seed)
    falls = np.arange(len(LEVELS_KPA)) >= 8
    shown = np.maximum(0, 2e-3 * (LEVELS_KPA - 120)) * (1 + hysteresis * falls)
    shown *= 1 + scatter * rng.standard_normal(len(shown))
    return [
        Reading(pressure_kpa=float(kpa), magnitude=max(0.0, float(m)))
        for kpa, m in zip(LEVELS_KPA, shown, strict=True)
    ]


@pytest.mark.parametrize(("scatter", "hysteresis"), [(0, 0), (0.03, 0.0), (0.03, 0.15), (0.06, 0)])
def test_scatter_and_hysteresis_are_no_slips(scatter: float, hysteresis: float) -> None:
    assert not any(find_outliers(table(seed, scatter, hysteresis)) for seed in range(20))


@pytest.mark.parametrize("factor", [10, 0.1])
@pytest.mark.parametrize("column", ["pressure_kpa", "magnitude"])
@pytest.mark.parametrize("index", [5, 6, 9])
def test_a_wrong_power_of_ten_is_one(column: str, factor: float, index: int) -> None:
    for seed in range(5):
        readings = table(seed, 0.03, 0.05)
        value = getattr(readings[index], column)
        readings[index] = readings[index].model_copy(update={column: value * factor})
        assert find_outliers(readings) == [index]


def test_two_slips_the_worse_one_first_and_too_few_readings() -> None:
    readings = table(1, 0.02, 0.0)
    readings[4] = readings[4].model_copy(update={"magnitude": 0.0})
    readings[6] = readings[6].model_copy(update={"pressure_kpa": 2200.0})
    assert find_outliers(readings) == [6, 4]
    assert find_outliers(readings[3:8]) == find_outliers([]) == []

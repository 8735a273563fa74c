"""A tank's forward model against the daemon's, its derivative, and readings made independent."""

from __future__ import annotations

import numpy as np
import pytest
from challenge_tanks import challenge_pattern
from tactomo_lab.evaluation.ktc import kept_readings
from tactomo_lab.tanks.model import Readings, TankModel
from tactomo_models import load_description
from taylor import taylor_orders


@pytest.fixture(scope="module")
def model() -> TankModel:
    return TankModel(load_description("tank_ktc2023"), rings=12)


def test_taylor(model: TankModel) -> None:
    """|F(x + t v) - F(x) - t J v| falls with t squared."""
    rng = np.random.default_rng(0)
    start, direction = (
        rng.uniform(0.2, 5, len(model.triangles)),
        rng.normal(size=len(model.triangles)),
    )
    by_pair = rng.normal(size=(7, model.pairs.shape[1]))
    slope = model.derivative(by_pair, model.solve(start)[1]) @ direction
    orders = taylor_orders(
        lambda x: by_pair @ model.solve(x)[0],
        start,
        slope,
        direction,
        np.array([1e-2, 5e-3, 2.5e-3]),
    )
    assert orders == pytest.approx(2, abs=0.1)


def test_the_empty_tank_is_the_daemons() -> None:
    from tactomo_models.physics.bare_sheet import scan_voltages, transfer_resistances
    from tactomo_models.physics.mesh import mesh_sheet

    tank = load_description("tank_uef2017")
    sheet = mesh_sheet(tank)
    even = np.ones(sheet.mesh.t.shape[1])
    theirs = scan_voltages(tank, transfer_resistances(tank, sheet, even))
    unit = np.eye(16)
    drive, measure = (unit[p[:, 0]] - unit[p[:, 1]] for p in (tank.pairs.drive, tank.pairs.measure))
    np.testing.assert_allclose(TankModel(tank).readings_of_empty(drive, measure), theirs, rtol=0.01)


@pytest.mark.parametrize("level", [1, 7])
def test_readings_are_independent_numbers(model: TankModel, level: int) -> None:
    """Of fifteen drives by 31 neighbours, and nine by 19, as many as reciprocity leaves."""
    currents, weights = challenge_pattern()
    kept = kept_readings(currents, weights, range(2 * level - 2))
    currents, weights = currents[kept], weights[kept]
    empty = model.readings_of_empty(currents, weights)
    readings = Readings(model, currents, weights, empty)
    assert len(readings.by_pair) == {1: 15 * 31 - 15 * 14 // 2, 7: 9 * 19 - 9 * 8 // 2}[level]
    np.testing.assert_allclose(readings.reduced(empty), readings.by_pair @ model.empty, atol=1e-8)
    # Water that conducts otherwise is next to nothing, the same change of any one reading much.
    assert np.linalg.norm(readings.reduced(0.02 * empty)) < 1
    assert np.linalg.norm(readings.reduced(0.02 * empty * (np.arange(len(empty)) % 2))) > 5


def test_noise_comes_out_as_one(model: TankModel) -> None:
    currents, weights = challenge_pattern()
    empty = model.readings_of_empty(currents, weights)
    readings = Readings(model, currents, weights, empty)
    noise = np.hypot(0.006 * np.sqrt(np.mean(empty**2)), 0.007 * empty)
    rng = np.random.default_rng(0)
    reduced = readings.reduced(noise * rng.standard_normal((200, len(empty))))
    assert 0.9 < np.sqrt(np.mean(reduced**2)) <= 1.02

"""A load cell beside the sheets: what it decides, and what becomes of one that is wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from noisy_skin import Skin
from tactomo_models import (
    Channel,
    DataError,
    Flag,
    Press,
    PressureRange,
    Reconstructor,
    SensorDescription,
    SkinSimulator,
    load_description,
)
from tactomo_models.arrays import FloatArray
from tactomo_models.batch import reconstruct_file
from tactomo_models.methods.account import Frame
from tactomo_models.methods.method import Skin as Prepared
from tactomo_models.methods.search import Belief, Search
from tactomo_models.scans.companion_forces import CompanionReading, SheetsAndCompanions
from tactomo_models.scene.field_fit import FieldFit
from tactomo_models.scene.parameters import COLUMNS, EDGE, PEAK, SIZE, X
from tactomo_models.scene.reconstruction import Reconstruction
from variants import variant

BALL = Press(0.0, 0.0, 180.0, 0.015, profile="dome")
BALL_N = 2 / 3 * 180e3 * np.pi * 0.015**2
CELL = {"gain_n_per_unit": 2.0, "offset": 5.0, "noise_n": 0.5, "limits": [0.0, 400.0]}


@pytest.fixture(scope="module")
def sensor() -> SensorDescription:
    """One graded sheet, with a load cell that reads half newtons from 5 on."""
    return variant(load_description("graded_square"), companion={"load_cell": CELL})


@pytest.fixture(scope="module")
def skin(sensor: SensorDescription) -> Skin:
    return Skin(SkinSimulator(sensor, spacing_m=0.0022))


@pytest.fixture(scope="module")
def reconstructor(sensor: SensorDescription, skin: Skin) -> Reconstructor:
    made = Reconstructor(sensor, budget_s=2.0)
    made.set_reference(skin.reference())
    return made


@pytest.fixture(scope="module")
def scan(skin: Skin) -> FloatArray:
    return skin.scan(BALL)["magnitude"]


def cold(reconstructor: Reconstructor, scan: FloatArray, force_n: float | None) -> Reconstruction:
    reconstructor.reset()
    companions = None if force_n is None else [("load_cell", force_n / 2 + 5)]
    return reconstructor.reconstruct(scan, None, companions=companions)


def test_a_force_is_surer_with_a_load_cell(reconstructor: Reconstructor, scan: FloatArray) -> None:
    alone, both = (cold(reconstructor, scan, force_n) for force_n in (None, BALL_N))
    assert not alone.flags & (Flag.COMPANION_MISSING | Flag.COMPANION_DISPUTED)
    assert not both.flags
    cell = both.companions["load_cell"]
    assert (cell.reading, cell.force_n, cell.state) == (BALL_N / 2 + 5, BALL_N, "fitted")
    assert both.force_n == pytest.approx(BALL_N, rel=0.02)
    off = [abs(frame.contacts[0].peak_kpa - 180) for frame in (alone, both)]
    assert off[1] < 18 < off[0]  # right to 10 %, as `tactomo evaluate field` counts
    # Flat or falling, the sheet alone does not tell, and a falling pressure has no bound.
    assert np.isnan(alone.force_sigma_n)
    assert both.force_sigma_n < 0.01 * BALL_N


def test_a_load_cell_tells_all_force_where_the_sheet_tells_a_bound(
    reconstructor: Reconstructor, skin: Skin
) -> None:
    """The bound of one contact was taken from the table's end: less than the cell allowed for."""
    hard, light = Press(-0.03, 0.0, 285.0, 0.009), Press(0.035, 0.02, 150.0, 0.012)
    wanted = 1e3 * np.pi * (285 * 0.009**2 + 150 * 0.012**2)
    frame = cold(reconstructor, skin.scan(hard, light)["magnitude"], wanted)
    assert PressureRange.ABOVE in [contact.pressure_range for contact in frame.contacts]
    cell = frame.companions["load_cell"]
    assert cell.state == "fitted"
    assert (frame.force_n, frame.force_sigma_n) == (cell.force_n, cell.sigma_n)


@pytest.mark.parametrize("factor", [0.0, 2.0, 3.0])
def test_a_load_cell_that_contradicts_the_sheet_is_named_and_left_out(
    reconstructor: Reconstructor, scan: FloatArray, factor: float
) -> None:
    alone, wrong = (cold(reconstructor, scan, force_n) for force_n in (None, factor * BALL_N))
    assert Flag.COMPANION_DISPUTED in wrong.flags
    assert "companion load_cell reads" in wrong.reason
    assert wrong.companions["load_cell"].state == "disputed"
    assert wrong.force_n == pytest.approx(alone.force_n, rel=1e-6)
    again = reconstructor.reconstruct(scan, None, companions=[("load_cell", BALL_N / 2 + 5)])
    assert not again.flags & Flag.COMPANION_DISPUTED  # it is believed once it agrees


def test_a_load_cell_that_feels_a_force_on_a_bare_sheet_is_named(
    reconstructor: Reconstructor, skin: Skin
) -> None:
    """A cell that hangs went unnamed, and was believed when the next press let go."""
    reconstructor.reset()
    bare, stuck = skin.scan()["magnitude"], [("load_cell", BALL_N / 2 + 5)]
    once, twice = (reconstructor.reconstruct(bare, None, companions=stuck) for _ in range(2))
    assert Flag.COMPANION_DISPUTED not in once.flags  # a single reading may be noise
    assert Flag.COMPANION_DISPUTED in twice.flags
    assert f"companion load_cell reads {BALL_N:.3g} N" in twice.reason
    assert (twice.companions["load_cell"].state, twice.force_n) == ("disputed", 0.0)
    free = reconstructor.reconstruct(bare, None, companions=[("load_cell", 5.0)])
    assert not free.flags


def test_readings_on_a_bare_sheet_before_and_after_a_press_are_not_two_in_a_row(
    reconstructor: Reconstructor, skin: Skin, scan: FloatArray
) -> None:
    """A cell feels a press a frame before the sheet does, and a frame longer."""
    reconstructor.reset()
    bare, felt = skin.scan()["magnitude"], [("load_cell", BALL_N / 2 + 5)]
    frames = [reconstructor.reconstruct(each, None, companions=felt) for each in (bare, scan, bare)]
    assert [bool(frame.contacts) for frame in frames] == [False, True, False]
    assert not any(Flag.COMPANION_DISPUTED in frame.flags for frame in frames)


@pytest.mark.parametrize("factor", [pytest.param(0.5, marks=pytest.mark.slow), 2.0])
def test_a_load_cell_that_is_wrong_costs_a_moving_scene_nothing(
    sensor: SensorDescription, skin: Skin, monkeypatch: pytest.MonkeyPatch, factor: float
) -> None:
    """Once it is left out, frames are those of the sheet alone, and as quick."""
    advanced: list[bool] = []
    advance = Search.advance

    def counted(self: Search, belief: Belief | None, frame: Frame) -> Belief:
        advanced.append(belief is None)
        return advance(self, belief, frame)

    monkeypatch.setattr(Search, "advance", counted)
    places = np.linspace(-0.02, 0.02, 12)
    presses = [replace(BALL, x_m=x) for x in places]
    scans, reference = [skin.scan(press)["magnitude"] for press in presses], skin.reference()
    forces = []
    for wrong in (False, True):
        made = Reconstructor(sensor)
        made.set_reference(reference)
        advanced.clear()
        cell = [("load_cell", factor * BALL_N / 2 + 5)] if wrong else None
        frames = [made.reconstruct(scan, None, companions=cell) for scan in scans]
        forces.append([frame.force_n for frame in frames])
        assert all(frame.tier == "fit" for frame in frames)
    assert all(Flag.COMPANION_DISPUTED in frame.flags for frame in frames)
    assert forces[1] == pytest.approx(forces[0], rel=1e-9)
    assert len(advanced) == len(scans) + 1


@pytest.mark.parametrize(("factor", "is_believed"), [(0.6, False), (1.0, True), (2.0, False)])
def test_a_force_that_the_sheet_makes_unlikely_is_left_out_until_it_is_likely(
    reconstructor: Reconstructor, skin: Skin, factor: float, is_believed: bool
) -> None:
    """What a sheet allows with a shape of its own, it allows of most forces: the evidence tells."""
    small = Press(0.03, 0.03, 280.0, 0.008)
    force_n = 280e3 * np.pi * 0.008**2
    frames = []
    reconstructor.reset()
    for times in (*[factor] * 4, 1.0, 1.0):
        scan = skin.scan(small)["magnitude"]
        reading = ("load_cell", times * force_n / 2 + 5)
        frames.append(reconstructor.reconstruct(scan, None, companions=[reading]))
    disputed = [Flag.COMPANION_DISPUTED in frame.flags for frame in frames]
    assert disputed[:4] == [not is_believed] * 4
    assert not disputed[5]
    assert frames[5].companions["load_cell"].state == "fitted"


@pytest.mark.parametrize("reading", [np.nan, 400.5, -0.1])
def test_a_reading_beyond_its_limits_is_none(
    reconstructor: Reconstructor, scan: FloatArray, reading: float
) -> None:
    measurement = reconstructor.compare(scan, None, companions=[("load_cell", reading)])
    assert not measurement.companions
    assert Flag.COMPANION_MISSING in measurement.flags


def test_a_reading_from_before_the_sheets_moved_tells_nothing(
    reconstructor: Reconstructor, skin: Skin
) -> None:
    """At 20 frames a second, of a cell that shows a force after 70 ms."""
    reconstructor.reset()
    found = []
    for frame in range(8):
        scan = skin.scan(*[BALL] * (frame >= 4))["magnitude"]
        reading = CompanionReading("load_cell", 30.0, time_s=frame / 20, since_s=0.07)
        measurement = reconstructor.compare(scan, None, companions=[reading])
        assert Flag.COMPANION_MISSING not in measurement.flags
        frame_of_it = reconstructor.solve(measurement)
        found.append(frame_of_it.companions["load_cell"].state)
    assert found[:4] == ["late", "late", "unused", "disputed"]  # nothing presses
    assert found[4:6] == ["late", "late"]
    assert not {"late", "unused"} & set(found[6:])


def test_a_companion_feels_its_region_alone(sensor: SensorDescription) -> None:
    half = [[0.0, -0.1], [0.1, -0.1], [0.1, 0.1], [0.0, 0.1]]
    right = variant(sensor, companion={"load_cell": {**CELL, "region_m": half}})
    of_all, of_half = (
        Prepared.of(each).tare.sensor.companion_weights["load_cell"].sum()
        for each in (sensor, right)
    )
    # 1 kPa on the sheet that can be pressed, and on half of it but for a row of nodes
    assert of_half / of_all == pytest.approx(0.5, abs=0.02)


def test_the_jacobian_of_a_companion_is_its_derivative(
    reconstructor: Reconstructor, scan: FloatArray
) -> None:
    measurement = reconstructor.compare(scan, None, companions=[("load_cell", 40.0)])
    assert isinstance(measurement.data, SheetsAndCompanions)
    fit = FieldFit(Prepared.of(reconstructor.description).forward, reconstructor.description)
    each = np.zeros((1, COLUMNS))
    each[0, [X, SIZE, PEAK, EDGE]] = 0.3, np.log(0.013), 0.6, 0.5
    family = Search(fit).field.of(each)

    def residual(parameters: FloatArray) -> FloatArray:
        fitted = fit.evaluate(family, parameters, fit.likely, measurement.data)
        assert fitted is not None
        return fitted.companion_residuals

    at = family.join(each)
    fitted = fit.evaluate(family, at, fit.likely, measurement.data)
    assert fitted is not None
    J = fit.jacobian(fitted, measurement.data)
    assert len(J) == len(fitted.residual) == len(measurement.changes[Channel.MAGNITUDE].change) + 1
    step = 1e-6 * np.random.default_rng(1).standard_normal(len(at))
    change = residual(at + step) - residual(at - step)
    np.testing.assert_allclose(change, 2 * J[-1:, :-1] @ step, rtol=1e-4)


def test_a_file_gives_readings_at_rest_and_of_each_frame(
    tmp_path: Path, sensor: SensorDescription, skin: Skin, scan: FloatArray
) -> None:
    rest = skin.reference()
    arrays: dict[str, Any] = {
        "magnitude": np.array([scan, scan]),
        "magnitude_reference": rest.magnitude,
        "companion_load_cell": np.array([BALL_N / 2 + 11, np.nan]),
        "companion_load_cell_reference": np.array([10.0, 12.0]),
    }
    source, target = tmp_path / "in.npz", tmp_path / "out.npz"
    np.savez(source, **arrays)
    reconstruct_file(source, target, description=sensor)
    with np.load(target) as out:
        assert out["force_n"][0] == pytest.approx(BALL_N, rel=0.02)
        assert [bool(Flag.COMPANION_MISSING & int(flags)) for flags in out["flags"]] == [
            False,
            True,
        ]
    np.savez(source, **{**arrays, "companion_load_cell": np.zeros(3)})
    with pytest.raises(DataError, match="3 readings of 2 frames"):
        reconstruct_file(source, target, description=sensor)


def test_readings_at_rest_beyond_the_limits_do_not_count(
    tmp_path: Path, skin: Skin, scan: FloatArray
) -> None:
    cell = {"load_cell": {**CELL, "limits": [-100.0, 1000.0]}}
    sensor = variant(load_description("graded_square"), companion=cell)
    source, target = tmp_path / "in.npz", tmp_path / "out.npz"
    arrays: dict[str, Any] = {
        "magnitude": scan[None],
        "magnitude_reference": skin.reference().magnitude,
        "companion_load_cell": np.array([BALL_N / 2 + 11]),
    }
    np.savez(source, **arrays, companion_load_cell_reference=np.array([10.0, 12.0, 1e4]))
    reconstruct_file(source, target, description=sensor)
    with np.load(target) as out:
        assert out["force_n"][0] == pytest.approx(BALL_N, rel=0.02)
    np.savez(source, **arrays, companion_load_cell_reference=1e4)
    with pytest.raises(DataError, match="no number within its limits; give readings"):
        reconstruct_file(source, target, description=sensor)

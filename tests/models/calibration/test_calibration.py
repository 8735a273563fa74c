"""Calibrations: the curve is right, its uncertainty is honest, and nonsense is refused by name."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tactomo_models import CalibrationError, SensorDescription
from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.calibration.calibration_file import (
    CALIBRATIONS,
    PressureCalibration,
    Subject,
    calibration_for,
)
from tactomo_models.calibration.curve import Reading, directions_of, fit_curve, still_wanted
from tactomo_models.calibration.outliers import find_outliers
from tactomo_models.scene.pressure import pressures_of

Response = Callable[[FloatArray], FloatArray]


def kinked(kpa: FloatArray) -> FloatArray:
    return np.interp(kpa, [0, 130, 140, 200, 300], [0, 0, 0.03, 0.25, 0.45])


def saturating(kpa: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (1 - np.exp(-np.maximum(kpa - 110, 0) / 80)))


def without_dead_zone(kpa: FloatArray) -> FloatArray:
    return np.asarray(0.3 * (np.maximum(kpa - 20, 0) / 200) ** 0.7)


class Sensor:
    """A simulated magnitude channel under a load cell."""

    def __init__(
        self, response: Response, seed: int, noise: float, scatter: float, hysteresis: float
    ) -> None:
        self.response, self.noise = response, noise
        self._scatter, self._hysteresis = scatter, hysteresis
        self._rng = np.random.default_rng(seed)

    def magnitudes(self, kpa: FloatArray, falling: BoolArray) -> FloatArray:
        factor = 1 + self._hysteresis * np.where(falling, 0.5, -0.5)
        factor = factor + self._scatter * self._rng.standard_normal(len(kpa))
        noise = self.noise * self._rng.standard_normal(len(kpa))
        return np.maximum(0, self.response(kpa) * factor + noise)

    def readings(self, levels: int, lightest: float = 60.0) -> list[Reading]:
        up = np.linspace(lightest, 260.0, levels)
        kpa = np.concatenate([up, up[::-1]])
        falling = np.arange(len(kpa)) >= levels
        return [
            Reading(
                pressure_kpa=p,
                magnitude=m,
                magnitude_sigma=self.noise,
                direction="down" if down else "up",
            )
            for p, m, down in zip(kpa, self.magnitudes(kpa, falling), falling, strict=True)
        ]


@pytest.mark.parametrize("response", [kinked, saturating, without_dead_zone])
def test_without_noise_the_curve_is_the_sensors(response: Response) -> None:
    fit = fit_curve(Sensor(response, 0, 0.0, 0.0, 0.0).readings(15))
    low, high = fit.curve.range_kpa
    assert high == pytest.approx(260)
    kpa = np.linspace(low + 10, high - 5, 50)
    np.testing.assert_allclose(fit.curve.pressure(response(kpa)), kpa, atol=5)


@pytest.mark.parametrize(
    ("noise", "scatter", "hysteresis"),
    [(0.005, 0.0, 0.0), (0.003, 0.02, 0.08)],
    ids=["noise", "all of it"],
)
def test_held_out_readings_lie_within_the_stated_uncertainty(
    noise: float, scatter: float, hysteresis: float
) -> None:
    """Near 68 % within one standard uncertainty, 95 % within two, from 12 readings and 24."""
    shares = []
    rng = np.random.default_rng(1)
    for seed, response in enumerate([kinked, saturating, without_dead_zone] * 5):
        sensor = Sensor(response, seed, noise, scatter, hysteresis)
        curve = fit_curve(sensor.readings(6 + 6 * (seed % 2))).curve
        kpa = rng.uniform(*curve.range_kpa, 100)
        magnitude = sensor.magnitudes(kpa, rng.random(100) < 0.5)
        unknown = np.full(100, np.nan)
        found = pressures_of(curve, magnitude, np.full(100, noise), unknown, unknown)
        known = np.isfinite(found.sigma_kpa)
        shares.append((np.abs(found.kpa - kpa) / found.sigma_kpa)[known])
    off = np.concatenate(shares)
    assert 0.60 < np.mean(off < 1) < 0.80
    assert np.mean(off < 2) > 0.88


@pytest.mark.parametrize(("response", "onset"), [(kinked, 130.0), (saturating, 110.0)])
def test_the_onset_is_found_from_the_readings(response: Response, onset: float) -> None:
    fit = fit_curve(Sensor(response, 3, 0.003, 0.0, 0.0).readings(21))
    assert fit.onset_kpa == pytest.approx(onset, abs=8)
    assert fit.curve.range_kpa[0] == fit.onset_kpa


def test_where_the_lightest_reading_answers_the_range_begins_with_it() -> None:
    fit = fit_curve(Sensor(without_dead_zone, 3, 0.003, 0.0, 0.0).readings(8, lightest=80))
    assert np.isnan(fit.onset_kpa)
    assert fit.curve.range_kpa == pytest.approx((80, 260))
    assert fit.curve.range_of(0.5 * float(fit.curve.magnitude[0]), 0.003) == "below"


def test_hysteresis_is_measured_where_loads_rise_and_fall() -> None:
    """8 % of the magnitude: 0.02 at 200 kPa, by a slope of 0.22 to 60 kPa some 5 kPa."""
    readings = Sensor(kinked, 2, 0.001, 0.0, 0.08).readings(12)
    fit = fit_curve(readings)
    assert 3 < fit.hysteresis_kpa < 15
    without = fit_curve(Sensor(kinked, 2, 0.001, 0.0, 0.0).readings(12))
    assert abs(without.hysteresis_kpa) < 1
    assert fit.repeatability_kpa > 4 * max(without.repeatability_kpa, 0.3)
    assert np.isnan(fit_curve([r for r in readings if r.direction == "up"]).hysteresis_kpa)


@settings(max_examples=40)
@given(st.lists(st.tuples(st.floats(0, 400), st.floats(0, 1)), max_size=25))
def test_any_readings_make_a_rising_curve_or_are_refused(pairs: list[tuple[float, float]]) -> None:
    readings = [Reading(pressure_kpa=kpa, magnitude=m) for kpa, m in pairs]
    try:
        curve = fit_curve(readings).curve
    except CalibrationError:
        return
    assert np.all(np.diff(curve.magnitude) > 0)
    assert np.all(np.diff(curve.pressure_kpa) >= 0)
    assert np.all(np.isfinite(curve.sigma_kpa))
    assert np.all(curve.sigma_kpa >= 0)


LEVELS = np.linspace(100, 250, 10)


def readings_of(kpa: FloatArray = LEVELS, magnitude: FloatArray | None = None) -> list[Reading]:
    found = kinked(kpa) if magnitude is None else magnitude
    return [Reading(pressure_kpa=p, magnitude=m) for p, m in zip(kpa, found, strict=True)]


@pytest.mark.parametrize(
    ("readings", "said"),
    [
        ([], "there are no readings"),
        (readings_of(LEVELS[-3:]), "answers to 3 of 3 readings"),
        (readings_of(LEVELS / 3), "does not answer to any of the 10 readings, up to 83 kPa"),
        (readings_of(LEVELS * 1e3, kinked(LEVELS)), "is it in Pa"),
        (readings_of(LEVELS / 1e3, kinked(LEVELS)), "is it in MPa"),
        (readings_of(LEVELS, 100 * kinked(LEVELS)), "is it in per cent"),
        (readings_of(LEVELS, kinked(LEVELS)[::-1]), "does not rise with the pressure: it is"),
    ],
)
def test_readings_that_make_no_curve_are_refused_with_the_reason(
    readings: list[Reading], said: str
) -> None:
    with pytest.raises(CalibrationError, match=said):
        fit_curve(readings)


@pytest.mark.filterwarnings("error")
def test_of_readings_without_an_answer_none_is_odd() -> None:
    assert find_outliers(readings_of(LEVELS / 3)) == []


def test_it_is_said_what_is_still_wanted_until_it_is_enough() -> None:
    readings = Sensor(kinked, 0, 0.003, 0.0, 0.0).readings(12)
    assert still_wanted(readings) == []
    rising = [reading for reading in readings if reading.direction == "up"]
    assert still_wanted(rising)[-1] == "some with the load falling, for the hysteresis"
    answering = [reading for reading in readings if reading.magnitude > 0.05]
    assert any("for the onset" in wanted for wanted in still_wanted(answering))
    assert any("10 more" in wanted for wanted in still_wanted([]))


def test_directions_follow_from_the_order_of_taking() -> None:
    taken = [50.0, 100.0, 101.0, 150.0, 100.0, 100.5, 50.0]
    assert directions_of(taken) == ["up", "up", "up", "up", "down", "down", "down"]


@pytest.fixture
def subject(small: SensorDescription) -> Subject:
    return Subject(sensor="left", description=small.name, sha256=small.sha256)


@pytest.fixture
def made(subject: Subject) -> PressureCalibration:
    return PressureCalibration.of_readings(subject, Sensor(kinked, 0, 0.003, 0, 0).readings(8))


def test_what_is_kept_is_found_again(small: SensorDescription, made: PressureCalibration) -> None:
    assert calibration_for("left", small, None, pytest.fail) is None
    CALIBRATIONS.save(made, CALIBRATIONS.path("left"))
    found = calibration_for("left", small, None, pytest.fail)
    assert found == made
    assert found is not None
    again = fit_curve(found.readings).curve
    np.testing.assert_allclose(found.curve.pressure_kpa, again.pressure_kpa, rtol=1e-4)


def test_one_beside_the_description_is_found_too(
    small: SensorDescription, made: PressureCalibration, tmp_path: Path
) -> None:
    CALIBRATIONS.save(made, tmp_path / "sheet.pressure.json")
    source = tmp_path / "sheet.toml"
    assert calibration_for("left", small, source, pytest.fail) == made
    told: list[str] = []
    assert calibration_for("right", small, source, told.append) is None
    assert "is of the sensor left, not right" in told[0]


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("format", 2, "format 2"),
        ("sigma_kpa", [1.0, 2.0], "differ in length"),
        ("magnitude", None, "magnitude"),
        ("extra", 1, "unknown key extra"),
        ("pressure_kpa", "negative", r"pressure_kpa\.0 = -.*equal to 0"),
        ("sigma_kpa", "huge", r"sigma_kpa\.\d+ = 1e\+308: .* 5000"),
        ("onset_kpa", 1e308, r"onset_kpa = 1e\+308: .* 5000"),
        ("hysteresis_kpa", -1e308, r"hysteresis_kpa = -1e\+308: .* -5000"),
        ("repeatability_kpa", 1e308, r"repeatability_kpa = 1e\+308: .* 5000"),
    ],
)
def test_a_damaged_file_is_refused(
    made: PressureCalibration, tmp_path: Path, key: str, value: object, said: str
) -> None:
    path = tmp_path / "left.pressure.json"
    numbers = list(getattr(made, key, ()) if isinstance(value, str) else ())
    if value == "negative":
        value = [number - 300 for number in numbers]
    elif value == "huge":
        value = [*numbers[:-1], 1e308]
    path.write_text(json.dumps({**made.model_dump(), key: value}))
    with pytest.raises(CalibrationError, match=said):
        CALIBRATIONS.read(path)


def test_what_cannot_be_read_or_written_is_told(
    small: SensorDescription, made: PressureCalibration, tmp_path: Path
) -> None:
    with pytest.raises(CalibrationError, match=r"cannot read .*: it is no regular file; put"):
        CALIBRATIONS.load(tmp_path, "left", small)
    (tmp_path / "file").touch()
    with pytest.raises(CalibrationError, match="cannot write"):
        CALIBRATIONS.save(made, tmp_path / "file" / "left.pressure.json")


def test_a_pipe_in_a_calibrations_place_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "left.pressure.json")
    with pytest.raises(CalibrationError, match="no regular file"):
        CALIBRATIONS.read(tmp_path / "left.pressure.json")

"""A pressure calibration is found by the sensor's name, told, and refused where it is foreign."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tactomo.recording import open_recording
from tactomo_models import CalibrationError, load_description
from tactomo_models.calibration import Reading
from tactomo_models.calibration_file import (
    PressureCalibration,
    Subject,
    calibration_path,
    save_calibration,
)

SENSOR = load_description("paper_square")
SUBJECT = Subject(sensor="left", description=SENSOR.name, sha256=SENSOR.sha256)
LEVELS = [100.0, 150.0, 160.0, 180.0, 200.0, 220.0, 240.0]
READINGS = [
    Reading(pressure_kpa=kpa, magnitude=max(0.0, (kpa - 140) * 2e-3)) for kpa in LEVELS + LEVELS
]


@pytest.fixture(autouse=True)
def _own_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)


def kept(path: Path | None = None, **changes: Any) -> PressureCalibration:
    """Keep a calibration of this sensor, or of one that differs so."""
    subject = SUBJECT.model_copy(update=changes)
    made = PressureCalibration.of_readings(subject, READINGS)
    save_calibration(made, path or calibration_path("left"))
    return made


def test_it_is_found_by_the_sensors_name_and_told_in_the_status(bench: Callable[..., Any]) -> None:
    made = kept()
    description = bench().ask("status")["description"]
    told = description["calibration"]
    assert told["readings"] == len(READINGS)
    assert told["range_kpa"] == pytest.approx([140, 240], abs=2)
    assert told["taken"] == made.taken
    assert description["pressure_max_kpa"] == 240
    response = description["magnitude_response"]
    assert np.interp(0.1, response["relative_change"], response["pressure_kpa"]) == pytest.approx(
        190, abs=2
    )


def test_without_one_pressures_are_the_descriptions(bench: Callable[..., Any]) -> None:
    daemon = bench()
    description = daemon.ask("status")["description"]
    assert description["calibration"] is None
    assert description["pressure_max_kpa"] == 300
    assert daemon.ask("status")["events"]["counts"].get("calibration_refused", 0) == 0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sensor": "right"}, "is of the sensor right, not left"),
        ({"sha256": "0" * 64, "description": "mine"}, "as mine describes it (sha256 000000000000)"),
    ],
)
def test_another_sensors_is_refused_by_name(
    bench: Callable[..., Any], tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    kept(**changes)
    status = bench().ask("status")
    assert status["description"]["calibration"] is None
    (trouble,) = status["events"]["troubles"]
    assert trouble["name"] == "calibration_refused"
    assert said in trouble["detail"]
    assert "run: tactomo calibrate left" in trouble["detail"]
    asked_for = tmp_path / "asked_for.pressure.json"
    kept(asked_for, **changes)
    with pytest.raises(CalibrationError, match="run: tactomo calibrate left"):
        bench(calibration=asked_for)


def test_one_that_is_asked_for_must_be_there(bench: Callable[..., Any], tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"there is no calibration .*absent"):
        bench(calibration=tmp_path / "absent")


def test_a_damaged_one_is_told_and_not_used(bench: Callable[..., Any]) -> None:
    kept()
    path = calibration_path("left")
    path.write_text(path.read_text().replace('"format": 1', '"format": 2'))
    (trouble,) = bench().ask("status")["events"]["troubles"]
    assert "is of format 2, and this tactomo reads format 1" in trouble["detail"]


def test_it_is_not_in_force_with_another_device(bench: Callable[..., Any]) -> None:
    kept(device_ids=("skin-elsewhere",))
    daemon = bench()
    daemon.tare()
    refusal = daemon.listener.event("calibration_refused")
    assert "was made with skin-elsewhere, and " in refusal["detail"]
    assert daemon.ask("status")["description"]["calibration"] is None


def test_with_its_own_device_it_is(bench: Callable[..., Any]) -> None:
    device_id = open_hello(bench())
    kept(device_ids=(device_id,))
    again = bench()
    again.tare()
    assert again.ask("status")["description"]["calibration"]["device_ids"] == [device_id]


def open_hello(daemon: Any) -> str:
    daemon.tare()
    (port,) = daemon.ask("status")["ports"]
    return str(port["device"]["device_id"])


def test_a_recording_takes_it_along(
    bench: Callable[..., Any], replay: Callable[..., Any], tmp_path: Path
) -> None:
    kept()
    daemon = bench(record=tmp_path / "press.mcap")
    daemon.tare()
    daemon.step(load=0.5)
    daemon.ask("record_stop")
    calibration_path("left").unlink()
    recording = open_recording(tmp_path / "press.mcap")
    assert '"pressure_kpa"' in recording.origin.calibration
    again = open_recording(replay(recording.path).path)
    assert again.origin == replace(recording.origin, ports=again.origin.ports)

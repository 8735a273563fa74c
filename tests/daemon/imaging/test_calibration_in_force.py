"""A pressure calibration is found by the sensor's name, told, and refused where it is foreign.

So it is at the daemon's start, and so when it is read again while the daemon runs.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_bench import BOTH, MEASUREMENTS, REST
from fixture_types import Start
from tactomo.recordings import recorder
from tactomo.recordings.recording import open_recording
from tactomo_client import CalibrationRefused
from tactomo_models import CalibrationError, load_description
from tactomo_models.calibration.calibration_file import CALIBRATIONS, PressureCalibration, Subject
from tactomo_models.calibration.curve import Reading
from tactomo_models.calibration.taught_skin import TAUGHT, TaughtSkin

SENSOR = load_description("paper_square")
SUBJECT = Subject(sensor="left", description=SENSOR.name, sha256=SENSOR.sha256)
RELOADED = "calibration_reloaded"
LEVELS = [100.0, 150.0, 160.0, 180.0, 200.0, 220.0, 240.0]
READINGS = [
    Reading(pressure_kpa=kpa, magnitude=max(0.0, (kpa - 140) * 2e-3)) for kpa in LEVELS + LEVELS
]


def kept(path: Path | None = None, factor: float = 1.0, **changes: Any) -> PressureCalibration:
    """Keep a calibration of this sensor, whose pressures are by a factor higher, or of another."""
    subject = SUBJECT.model_copy(update=changes)
    readings = [r.model_copy(update={"pressure_kpa": factor * r.pressure_kpa}) for r in READINGS]
    made = PressureCalibration.of_readings(subject, readings)
    CALIBRATIONS.save(made, path or CALIBRATIONS.path("left"))
    return made


def test_it_is_found_by_the_sensors_name_and_told_in_the_status(bench: Start) -> None:
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


def test_another_sensors_is_refused_by_name(bench: Start, tmp_path: Path) -> None:
    kept(sensor="right")
    status = bench().ask("status")
    assert status["description"]["calibration"] is None
    (trouble,) = status["events"]["troubles"]
    assert trouble["name"] == "calibration_refused"
    assert "is of the sensor right, not left" in trouble["detail"]
    assert "run: tactomo calibrate live --sensor left" in trouble["detail"]
    asked_for = tmp_path / "asked_for.pressure.json"
    kept(asked_for, sensor="right")
    with pytest.raises(CalibrationError, match="run: tactomo calibrate live --sensor left"):
        bench(calibration=asked_for)


def test_a_damaged_one_is_told_and_not_used(bench: Start) -> None:
    kept()
    path = CALIBRATIONS.path("left")
    path.write_text(path.read_text().replace('"format": 1', '"format": 2'))
    (trouble,) = bench().ask("status")["events"]["troubles"]
    assert "is of format 2, and this tactomo reads format 1" in trouble["detail"]


def test_it_is_not_in_force_with_another_device(bench: Start) -> None:
    kept(device_ids=("skin-elsewhere",))
    daemon = bench().tare()
    refusal = daemon.listener.event("calibration_refused")
    assert "was made with skin-elsewhere, and " in refusal["detail"]
    assert daemon.ask("status")["description"]["calibration"] is None


def test_another_device_is_judged_by_the_new_one(bench: Start) -> None:
    daemon = bench()
    kept(device_ids=("bench-2",))
    daemon.ask("reload_calibration")  # nobody has said yet who it is
    daemon.tare()
    daemon.listener.event("calibration_refused")
    assert daemon.ask("status")["description"]["calibration"] is None
    kept(device_ids=("bench-1", "bench-2"))
    assert daemon.ask("reload_calibration")["calibration"]["readings"] == len(READINGS)


def test_a_new_one_is_in_force_at_once_and_one_that_was_deleted_no_more(bench: Start) -> None:
    daemon = bench().tare()

    def in_force() -> tuple[Any, float]:
        description = daemon.ask("status")["description"]
        return description["calibration"], description["pressure_max_kpa"]

    assert in_force() == (None, 300)
    for factor in (1.0, 1.1):
        made = kept(factor=factor)
        told = daemon.ask("reload_calibration")["calibration"]
        assert told["range_kpa"] == list(made.curve.range_kpa)
        assert in_force() == (told, made.pressure_kpa[-1])
        response = daemon.ask("status")["description"]["magnitude_response"]
        assert response["pressure_kpa"] == list(made.pressure_kpa)
        daemon.listener.wait("status", lambda s, now=told: s["description"]["calibration"] == now)
        daemon.listener.wait(
            "event", lambda e, made=made: (e["name"], e["detail"]) == (RELOADED, made.words)
        )
    CALIBRATIONS.path("left").unlink()
    assert daemon.ask("reload_calibration") == {"calibration": None, "taught": None}
    assert in_force() == (None, 300)
    daemon.listener.wait("event", lambda e: "pressures are the description's" in e["detail"])
    assert "calibration_refused" not in daemon.ask("status")["events"]["counts"]


def test_one_that_cannot_be_used_leaves_the_one_in_force(bench: Start) -> None:
    made = kept()
    daemon = bench().tare()
    for changes, said in (
        ({"sha256": "0" * 64}, "sha256 000000000000"),
        ({"device_ids": ("skin-elsewhere",)}, "was made with skin-elsewhere, and bench-1 is"),
        (None, "is damaged"),
    ):
        if changes is None:
            CALIBRATIONS.path("left").write_text("{")
        else:
            kept(**changes)
        with pytest.raises(CalibrationRefused, match="what was in force stays so") as refusal:
            daemon.ask("reload_calibration")
        assert said in refusal.value.cause
        daemon.listener.wait(
            "event", lambda e, s=said: e["name"] == "calibration_refused" and s in e["detail"]
        )
    status = daemon.ask("status")
    assert status["description"]["calibration"]["taken"] == made.taken
    assert status["events"]["counts"].get(RELOADED, 0) == 0


def test_the_configured_file_is_the_one_that_is_read_again(bench: Start, tmp_path: Path) -> None:
    kept(factor=2.0)
    configured = tmp_path / "configured.pressure.json"
    kept(configured)
    daemon = bench(calibration=configured)
    kept(configured, factor=1.1)
    assert daemon.ask("reload_calibration")["calibration"]["range_kpa"][1] == pytest.approx(264)
    configured.unlink()
    with pytest.raises(CalibrationRefused, match="there is no calibration"):
        daemon.ask("reload_calibration")
    status = daemon.ask("status")
    assert status["description"]["pressure_max_kpa"] == pytest.approx(264)


class Pressed:
    """A skin that is pressed, and what the live daemon says of it."""

    def __init__(self, bench: Start, **config: Any) -> None:
        self.bench = bench(**config)
        self.bench.tare()
        self._first = self.bench.skin.counter + 1

    def press(self) -> float:
        """Return what a contact reads, kPa."""
        for load in (0.1, 0.05, 0.06):
            counter = self.bench.skin.scan(load)
            frame = self.bench.listener.wait(
                "contacts", lambda frame, now=counter: frame["scan_counter"] == now
            )
        return float(frame["contacts"][0]["pressure_kpa"])

    def reload(self, factor: float | None) -> None:
        """Have another calibration read, or have it seen that there is none."""
        if factor is None:
            CALIBRATIONS.path("left").unlink()
        else:
            kept(factor=factor)
        self.bench.ask("reload_calibration")

    @property
    def live(self) -> dict[int, Any]:
        """Pressures since the tare."""
        found = pressures(self.bench.listener.of("contacts"))
        return {counter: kpa for counter, kpa in found.items() if counter >= self._first}


def pressures(frames: list[dict[str, Any]]) -> dict[int, list[float]]:
    """What each frame's contacts read, kPa, by its counter."""
    return {f["scan_counter"]: [c["pressure_kpa"] for c in f["contacts"]] for f in frames}


@pytest.mark.slow
def test_a_replay_goes_by_each_calibration_from_its_frame_on(
    bench: Start, replay: Start, tmp_path: Path
) -> None:
    pressed = Pressed(bench)
    path = tmp_path / "a.mcap"
    pressed.bench.ask("record_start", path=path.name)
    pressed.press()  # the reconstructor remembers: soon each press is after one like it
    described = pressed.press()
    pressed.reload(1.1)
    once = pressed.press()
    pressed.reload(1.2)
    assert pressed.press() == pytest.approx(once * 1.2 / 1.1, abs=3)
    pressed.reload(None)
    assert pressed.press() == pytest.approx(described, abs=3)
    pressed.reload(1.3)
    pressed.bench.ask("record_stop")
    live = pressed.live
    assert len(live) == 15
    kept(factor=3.0)  # whatever is kept by that name meanwhile
    again = replay(path)
    assert pressures(again.of("contacts")) == live
    assert pressures(replay(again.path).of("contacts")) == live
    by_one = pressures(replay(path, calibration=CALIBRATIONS.path("left")).of("contacts"))
    assert min(kpa for (kpa,) in by_one.values()) > 2 * described


@pytest.mark.slow
def test_files_that_were_cut_replay_by_the_calibration_of_each(
    bench: Start, replay: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file is begun, then the calibration changes, then the first frame comes into that file."""
    monkeypatch.setattr(recorder, "LOOK_S", 0.3)
    folder = tmp_path / "set"
    kept()
    pressed = Pressed(bench, recording={"folder": folder, "at_start": True, "rotate_mb": 0.01})
    for factor in (1.1, None, 1.2):
        files = pressed.bench.ask("status")["recorder"]["files"]
        while pressed.bench.ask("status")["recorder"]["files"] == files:
            pressed.press()
        pressed.reload(factor)
    pressed.press()
    pressed.bench.ask("record_stop")
    pressed.reload(1.3)
    pressed.bench.ask("record_start")
    pressed.press()
    pressed.bench.ask("record_stop")
    kept(factor=3.0)
    live = pressed.live
    parts = sorted(folder.iterdir())
    assert len(parts) >= 4
    heard = 0
    for part in map(open_recording, parts):
        if part.summary.frames and part.origin.calibration:  # none: begun just before the end
            alone = pressures(replay(part.path).of("contacts"))
            assert alone == {counter: live.get(counter, []) for counter in alone}
            heard += 1
    assert heard >= 3


def taught(**changes: Any) -> TaughtSkin:
    """Keep what the skin of the bench was taught, or another one."""
    rng = np.random.default_rng(0)
    xy_mm = rng.uniform(-50, 50, (40, 2))
    fields: dict[str, Any] = {
        "subject": SUBJECT,
        "taken": "2026-01-31T12:00:00+00:00",
        "channels": BOTH,
        "usable": np.ones(2 * MEASUREMENTS, bool),
        "changes": xy_mm @ rng.standard_normal((2, 2 * MEASUREMENTS)),
        "xy_mm": xy_mm,
        "guess_mm": xy_mm + 1.0,
        "loads": np.full(40, np.nan),
        "force_n": np.full(40, np.nan),
        "tiers": frozenset(["fit"]),
        "without_mm": 1.4,
        "with_mm": 0.2,
        "force_error": np.nan,
        "reference": np.stack([REST, REST]),
    }
    made = TaughtSkin(**{**fields, **changes})
    TAUGHT.save(made, TAUGHT.path("left"))
    return made


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"subject": SUBJECT.model_copy(update={"sensor": "right"})}, "is of the sensor right"),
        (
            {"subject": SUBJECT.model_copy(update={"device_ids": ("skin-elsewhere",)})},
            "was made with skin-elsewhere, and bench-1 is",
        ),
        (
            {"reference": np.stack([REST, REST[::-1]])},
            "does not fit the skin any more: its structure voltages at rest are",
        ),
        (None, "is damaged"),
    ],
)
def test_what_was_taught_on_another_skin_is_not_used(
    bench: Start, changes: dict[str, Any] | None, said: str
) -> None:
    taught(**(changes or {}))
    if changes is None:
        TAUGHT.path("left").write_bytes(b"PK")
    daemon = bench().tare()
    status = daemon.ask("status")
    (trouble,) = status["events"]["troubles"]
    assert said in trouble["detail"]
    assert status["description"]["taught"] is None
    with pytest.raises(CalibrationRefused, match="what was in force stays so"):
        daemon.ask("reload_calibration")


def test_a_sheet_that_drifts_evenly_is_the_one_that_was_taught(bench: Start) -> None:
    taught(reference=0.8 * np.stack([REST, REST]))
    daemon = bench().tare()
    assert daemon.ask("status")["description"]["taught"] is not None

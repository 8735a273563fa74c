"""`calibrate`: from files, and guided at a terminal; what it keeps is what it then shows."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_control import FakeControl
from fixture_types import Run
from tactomo.running import Running, announced
from tactomo_client import Contact, ControlError
from tactomo_client.fake import FakeSensor
from tactomo_models import SkinSimulator, load_description
from tactomo_models.calibration.calibration_file import CALIBRATIONS
from tactomo_models.scene.press import Press
from terminal import Terminal
from waiting import repeated

SENSOR = load_description("paper_square")
STATUS = {
    "state": "running",
    "description": {
        "model": SENSOR.name,
        "sha256": SENSOR.sha256,
        "modalities": ["magnitude", "structure"],
        "magnitude_response": {
            "pressure_kpa": [0.0, 130.0, 300.0],
            "relative_change": [0.0, 0.0, 0.45],
        },
    },
    "ports": [{"url": "/dev/ttySKIN", "device": {"device_id": "skin-7f3a"}}],
}
FIT = ("calibrate", "fit", "log.csv", "--sensor", "palm")
ROWS = [(kpa, max(0.0, (kpa - 120) * 2e-3)) for kpa in (90, 130, 160, 190, 220, 200, 170, 140)]
CSV = "pressure_kpa,magnitude\n" + "".join(f"{kpa},{m:.4f}\n" for kpa, m in ROWS)


@pytest.mark.slow
def test_a_table_of_magnitudes_is_fitted_kept_and_shown(tactomo: Run, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(CSV)
    tried = tactomo(*FIT, "--dry-run", status=0)
    assert not CALIBRATIONS.path("palm").exists()
    assert "kept in" not in tried.stdout
    assert "disagrees" not in tried.stderr
    options = ("--picture", "curve.png", "--device-id", "skin-7f3a")
    made = tactomo(*FIT, *options, status=0)
    assert "palm: 8 readings of" in made.stdout
    assert "kPa contacts are `below` (touched, pressure unknown)" in made.stdout
    assert "beyond 220 kPa they are `above`" in made.stdout
    assert f"kept in {CALIBRATIONS.path('palm')}" in made.stdout
    assert (tmp_path / "curve.png").stat().st_size > 10_000
    kept = CALIBRATIONS.read(CALIBRATIONS.path("palm"))
    assert kept.subject.device_ids == ("skin-7f3a",)
    assert kept.curve.range_kpa == pytest.approx((120, 220), abs=4)
    assert kept.curve.pressure(np.array(0.12)) == pytest.approx(180, abs=1)
    shown = tactomo("calibrate", "show", "--sensor", "palm")
    assert shown.stdout.splitlines()[:12] == made.stdout.splitlines()[:12]


@pytest.mark.parametrize(
    ("row", "kpa", "magnitude"),
    [(5, 220, 2.0), (4, 190, 0.014), (6, 2000, 0.16), (6, 20, 0.16), (5, 2200, 0.2)],
)
def test_a_slip_in_a_table_is_named_by_its_line(
    tactomo: Run, tmp_path: Path, row: int, kpa: float, magnitude: float
) -> None:
    lines = CSV.splitlines()
    lines[row] = f"{kpa:g},{magnitude:g}"
    (tmp_path / "log.csv").write_text("\n".join(["# by hand", *lines, "0,0"]) + "\n")
    made = tactomo(*FIT, "--dry-run")
    said = f"line {row + 2} ({kpa:.0f} kPa, |Δσ|/σ₀ {magnitude:.3f}) disagrees with the others"
    assert said in made.stderr
    assert made.stderr.count("disagrees") == 1


def test_pressures_that_may_be_of_another_unit_are_told(tactomo: Run, tmp_path: Path) -> None:
    psi = "".join(f"{kpa / 6.895:.3f},{magnitude:.4f}\n" for kpa, magnitude in ROWS)
    for table, is_doubted in ((CSV, False), (f"pressure_kpa,magnitude\n{psi}", True)):
        (tmp_path / "log.csv").write_text(table)
        made = tactomo(*FIT, "--dry-run", status=0)
        assert ("is the column pressure_kpa in kPa" in made.stderr) == is_doubted


@pytest.mark.slow
def test_a_table_with_a_slip_is_kept_on_request_alone(tactomo: Run, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(CSV + "220,2.0\n")
    words = (*FIT, "--picture", "curve.png")
    refused = tactomo(*words, status=1)
    assert "line 10 (220 kPa, |Δσ|/σ₀ 2.000)" in refused.stderr.splitlines()[-1]
    assert not CALIBRATIONS.path("palm").exists()
    assert (tmp_path / "curve.png").exists()  # which shows the slip
    tactomo(*words, "--keep-odd", status=0)
    assert CALIBRATIONS.read(CALIBRATIONS.path("palm")).subject.sensor == "palm"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("fit", "absent.csv"), "cannot read absent.csv"),
        (("fit", "few.csv"), "answers to 2 of 2 readings"),
        (("fit", "force.csv"), "give --diameter-mm or --area-mm2"),
        (("fit", "times.csv"), "give the recording of that time by --recording"),
        (("fit", "log.csv", "-d", "tank_disc"), "has no magnitude channel"),
        (("fit", "log.csv", "--recording", "a.mcap"), "no column time_s or realtime_s"),
        (("fit", "times.csv", "--recording", "a.mcap"), "a.mcap"),
        (("show",), "run: tactomo calibrate live --sensor palm"),
        (("live", "--address", "ipc:///nowhere/at/all"), "no daemon answers"),
    ],
)
def test_what_cannot_be_used_is_told(
    tactomo: Run, tmp_path: Path, options: tuple[str, ...], said: str
) -> None:
    (tmp_path / "log.csv").write_text(CSV)
    (tmp_path / "few.csv").write_text("pressure_kpa,magnitude\n150,0.1\n200,0.2\n")
    (tmp_path / "force.csv").write_text("force_n,magnitude\n100,0.1\n")
    (tmp_path / "times.csv").write_text("time_s,pressure_kpa\n1,100\n")
    result = tactomo("calibrate", *options, "--sensor", "palm", status=1)
    assert said in result.stderr


KEPT = {"taken": "2026-01-31T12:00:00+00:00", "readings": 9, "range_kpa": [120.0, 220.0]}


@pytest.mark.parametrize(
    ("answers", "said"),
    [
        (
            {"reload_calibration": ControlError("of b", "stays", "calibration_refused")},
            "of b; stays",
        ),
        ({"reload_calibration": ControlError("an old one", "", "unknown_command")}, "an old one"),
        ({"reload_calibration": {"calibration": None}}, "the description's table"),
        ({"reload_calibration": {"calibration": KEPT}}, "2026-01-31T12"),
    ],
)
def test_what_the_running_daemon_makes_of_it_is_told(
    tactomo: Run, tmp_path: Path, answers: dict[str, Any], said: str
) -> None:
    (tmp_path / "log.csv").write_text(CSV)
    with FakeControl(answers) as control, announced(Running("daemon", control.address, "palm")):
        made = tactomo(*FIT)
    assert made.returncode == 0, made.stderr
    assert f"kept in {CALIBRATIONS.path('palm')}" in made.stdout
    assert said in made.stdout
    assert "in force now" not in made.stdout


def test_the_daemon_that_runs_is_asked_to_read_it_again(tactomo: Run) -> None:
    with FakeControl() as control, announced(Running("daemon", control.address, "palm")):
        command = ("calibrate", "reload", "-s", "palm")
        control.answers["reload_calibration"] = {"calibration": KEPT}
        told = tactomo(*command)
        assert "in force now" in told.stdout
        assert "9 readings of 2026-01-31" in told.stdout
        control.answers["reload_calibration"] = {"calibration": None}
        assert "goes by the description's table" in tactomo(*command).stdout
        control.answers["reload_calibration"] = ControlError("damaged", "", "calibration_refused")
        refused = tactomo(*command)
        assert (refused.returncode, refused.stdout) == (1, "")
        assert "damaged" in refused.stderr
        other = tactomo("calibrate", "reload", "-s", "sole", status=1)
        assert "no sensor 'sole' runs on this computer, but palm" in other.stderr


@pytest.mark.parametrize(
    "options",
    [
        (),
        ("fit",),
        ("live", "--recording", "a.mcap"),
        ("fit", "a", "--diameter-mm", "3", "--area-mm2", "3"),
        ("fit", "a", "--diameter-mm", "1e300"),
        ("fit", "a", "--time-offset", "nan"),
    ],
)
def test_options_that_do_not_go_together_or_make_no_sense(
    tactomo: Run, options: tuple[str, ...]
) -> None:
    tactomo("calibrate", *options, status=2)


@pytest.mark.slow
def test_a_recording_tells_what_the_sensor_showed(tactomo: Run, tmp_path: Path) -> None:
    """Six presses of one second each, ten scans a second, and what a load cell said at each."""
    skin = SkinSimulator(SENSOR, unevenness=0.03, seed=4)
    rng = np.random.default_rng(2)
    levels = (0.0, 120.0, 150.0, 170.0, 190.0, 210.0, 180.0)
    volts = [skin.voltages([Press(0.01, 0.0, kpa)] if kpa else []) for kpa in levels]
    scans: dict[str, Any] = {}
    for name, rest in volts[0].items():
        noise = (
            1e-3 * np.sqrt(np.mean(rest**2)) * rng.standard_normal((10 * len(levels), len(rest)))
        )
        scans[name] = np.repeat([each[name] for each in volts], 10, axis=0) + noise
        scans[f"{name}_reference"] = rest
    np.savez(tmp_path / "presses.npz", **scans)
    tactomo(
        *("import", "presses.npz", "presses.mcap", "--rate", "10", "--sensor", "palm"),
        *("--reference-frames", "0:10"),
        status=0,
    )
    area_mm2 = np.pi / 4 * 30**2
    rows = [f"{i + 0.5},{1e-3 * kpa * area_mm2:.3f}\n" for i, kpa in enumerate(levels)]
    (tmp_path / "log.csv").write_text("time_s,force_n\n" + "".join(rows))
    options = ("--recording", "presses.mcap", "--diameter-mm", "30")
    tactomo(*FIT, *options, status=0)
    kept = CALIBRATIONS.read(CALIBRATIONS.path("palm"))
    assert len(kept.readings) == 6
    assert kept.subject.device_ids
    knots = [130, 140, 200, 300], [0, 0.03, 0.25, 0.45]
    off = [
        abs(reading.magnitude - float(np.interp(reading.pressure_kpa, *knots)))
        for reading in kept.readings
    ]
    other = tactomo("calibrate", "fit", "log.csv", "--sensor", "sole", *options)
    assert "is a recording of palm, not of sole" in other.stderr
    assert max(off) < 0.06
    if max(off) > 0.02:
        pytest.xfail("an indenter is not known to be flat, and a mean over kinds is off")


class Pressed(FakeSensor):
    """A stream of one contact of a magnitude that a test sets, twenty times a second."""

    def __init__(self) -> None:
        super().__init__("palm")
        self.magnitude = 0.0
        self.contacts = 1

    def say(self) -> None:
        contact = Contact(1, 3.0, -2.0, 700.0, self.magnitude, 0.003, None)
        self.publish([contact] * self.contacts)
        self.publish_message("status", STATUS)


@pytest.fixture
def pressed() -> Iterator[Pressed]:
    with Pressed() as sensor, repeated(sensor.say):
        yield sensor


def take(terminal: Terminal, pressed: Pressed, number: int, kpa: float, magnitude: float) -> None:
    terminal.wait_for(f"Reading {number}, going")
    pressed.magnitude = magnitude
    terminal.enter("")
    terminal.wait_for("still: |Δσ|/σ₀")
    terminal.wait_for("Load cell in N")
    terminal.enter(f"{1e5 * kpa:g}")  # a slip
    terminal.wait_for("a number from 0 to 5000, please")
    terminal.enter(f"{kpa:g}")  # on an indenter of 1000 mm²
    terminal.wait_for("kPa, taken")


@pytest.mark.slow
def test_a_session_keeps_what_was_taken_and_goes_on(pressed: Pressed) -> None:
    command = (
        "calibrate",
        "live",
        "-s",
        "palm",
        "--address",
        pressed.address,
        "--area-mm2",
        "1000",
    )
    log = CALIBRATIONS.path("palm").with_name("palm.readings.csv")
    with Terminal(*command) as terminal:
        take(terminal, pressed, 1, *ROWS[0])
        terminal.wait_for("Still wanted: 10 more")
        take(terminal, pressed, 2, 400, 0.4)
        terminal.wait_for("Reading 3")
        terminal.enter("undo")
        terminal.wait_for("dropped the reading at 400 kPa")
        pressed.contacts = 2
        terminal.enter("")
        terminal.wait_for("2 contacts: press one place only")
        terminal.press_ctrl_c()
        terminal.wait_for("1 readings are kept in")
        assert terminal.wait() == 1  # nothing that could be a curve
        assert "the magnitude channel does not answer to any" in terminal.shown
    assert len(log.read_text().splitlines()) == 2
    assert not CALIBRATIONS.path("palm").exists()
    pressed.contacts = 1
    with Terminal(*command) as terminal:
        terminal.wait_for("Going on with 1 readings")
        for number, row in enumerate(ROWS[1:], start=2):
            take(terminal, pressed, number, *row)
        terminal.wait_for("curve: ±")
        assert "contradict" not in terminal.shown
        take(terminal, pressed, 9, 1.9, 0.15)  # for 195
        terminal.wait_for("The other readings contradict this reading: undo drops it")
        terminal.wait_for("Reading 10")
        terminal.enter("undo")
        terminal.wait_for("dropped the reading at 2 kPa")
        terminal.press_ctrl_c()
        assert terminal.wait() == 0, terminal.shown
    kept = CALIBRATIONS.read(CALIBRATIONS.path("palm"))
    taken = [(r.pressure_kpa, r.magnitude) for r in kept.readings]
    np.testing.assert_allclose(taken, ROWS, rtol=1e-6)
    assert [r.direction for r in kept.readings] == ["up"] * 5 + ["down"] * 3
    assert kept.subject.device_ids == ("skin-7f3a",)

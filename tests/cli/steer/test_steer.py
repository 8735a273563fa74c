"""`status`, `tare`, `record`, `tier` and `poke` against a control socket."""

from __future__ import annotations

import dataclasses
import json
import re
import signal
import subprocess
import sys
from contextlib import suppress
from threading import Timer
from types import SimpleNamespace
from typing import Any

import pytest
from fake_control import FakeControl
from fixture_types import Run
from tactomo.cli.steer.steer import lines_of
from tactomo.errors import TactomoError
from tactomo.running import Running, announced
from tactomo.service.health_issues import FLAG_ADVICE, health_issues
from tactomo_client import ControlError
from tactomo_client.fake import FakeSensor
from tactomo_models import Flag
from waiting import PATIENCE_S, repeated, wait_until

STATUS = {
    "sensor": "left_forearm",
    "state": "running",
    "version": "0.1.0",
    "uptime_s": 12.0,
    "description": {
        **{"model": "paper_square", "modalities": ["magnitude", "structure"]},
        "pressure_max_kpa": 250.0,
        "calibration": {
            **{"taken": "2026-01-31T12:00:00+00:00", "readings": 14},
            **{"range_kpa": [131.2, 250.0], "sigma_kpa": 2.34},
        },
    },
    "source": {"kind": "twin"},
    "ports": [
        {
            **{"url": "/dev/ttyACM0", "connected": True, "state": "running"},
            "device": {"device_id": "twin-paper_square", "channels": ["magnitude"]},
            "packets": 9999,
            "corrupt": 300,
            "received_last_minute": {"packets": 99, "corrupt": 3},
        },
        {"url": "/dev/ttyACM1", "connected": False, "device": None},
    ],
    "rates": {"magnitude_hz": 20.0, "structure_hz": None, "frames_hz": 19.96},
    "latency_ms": {"p50": 4.25, "p99": 11.0},
    "stage_ms": {"reconstruct": {"p50": 3.5, "p99": 9.0}},
    "tier": "levelset",
    "tier_requested": "auto",
    "budget_ms": 12.0,
    "plan": {"tier": "fit", "share": 0.5},
    "flags": ["structure_missing"],
    "misfit": 1.02,
    "dropped_scans": 2,
    "incomplete_scans": 7,
    "reference": {"scans": 20, "taken_realtime_ns": 0},
    "baseline": {
        **{"state": "refused", "refusal": "[neither] contact nor drift", "moves": 3},
        "drift": {"magnitude": {"gain": -0.0123, "uneven": 0.0009}},
    },
    "recording": {"path": "/tmp/a.mcap", "bytes": 2_500_000},
    "companions": {
        "cell": {"state": "disputed", "reading": 255.5, "force_n": 127.0, "force_sigma_n": 2.5},
        "pad": {"state": "missing", "reading": None, "force_n": None, "force_sigma_n": None},
    },
    "subscribers": 1,
}
NEW_DAEMON = {
    **STATUS,
    **{"state": "waiting_for_data", "ports": [], "latency_ms": None, "stage_ms": {}},
    **{"tier": None, "flags": [], "misfit": None, "reference": None, "recording": None},
}


def judge(control: Any) -> None:
    """Have the status say what the daemon would find wrong with it."""
    status = control.answers["status"]
    status["issues"] = [dataclasses.asdict(issue) for issue in health_issues(status)]


def test_status_shows_what_matters(tactomo: Run, control: Any) -> None:
    control.answers["status"] = STATUS
    result = tactomo("status", status=0)
    for words in (
        *(
            "left_forearm: running",
            "/dev/ttyACM0 (running)",
            "300 corrupt",
            "no device has answered yet",
        ),
        *(
            "p50 4.25 ms",
            "structure_missing: no usable scans of the structure channel",
            "19.96 frames/s",
            "2 dual scans dropped",
        ),
        *("20 dual scans", "/tmp/a.mcap (2.5 MB)", "auto; the newest frame by levelset"),
        *("refused: [neither] contact nor drift", "magnitude drifted by -1.23%, unevenly by 0.09%"),
        "cell reads 255.5: 127.0 ± 2.5 N, not used: it contradicts the sheets",
        "pad no reading within its limits",
        "calibrated 2026-01-31 by 14 readings: 131 to 250 kPa ± 2.3",
        "12 ms of work, 50% of it while other programs use the processor",
    ):
        assert words in result.stdout


def test_status_begins_with_what_is_wrong_and_what_to_do(tactomo: Run, control: Any) -> None:
    closed = {"url": "/dev/ttyACM1", "connected": False, "state": "closed", "problem": "no device"}
    trouble = {"name": "port_lost", "severity": "error", "detail": "gone", "age_s": 240.0}
    control.answers["status"] = {
        **STATUS,
        **{"state": "stale", "ports": [STATUS["ports"][0], closed], "frames": 99},  # type: ignore[index]
        "events": {"counts": {"port_lost": 2, "tared": 1}, "troubles": [trouble]},
        "process": {"pid": 7, "cpu_s": 1.2, "memory_bytes": 90_000_000, "threads": 6},
    }
    judge(control)
    result = tactomo("status")
    lines = [line.strip() for line in result.stdout.splitlines()]
    assert lines[:6] == [
        "scans have stopped coming",
        "see what is wrong with the ports",
        "/dev/ttyACM1 is closed: no device",
        "plug it in, or check the cable; it is tried again until it is there",
        "/dev/ttyACM0: 3 of 102 packets came damaged within the last minute",
        "check the cable, its shield and the baud rate",
    ]
    assert "port lost, 4 min ago: gone" in result.stdout
    assert "port lost 2 times, tared once" in result.stdout
    assert "pid 7, 10.0 % of a core on average, 90.0 MB, 6 threads" in result.stdout


HOSTILE = "x[/b]y skin[left] \x1b]0;title\x07\x1b[2J\x9b2J\u202e"


def hostile(told: Any) -> Any:
    """The same with text of a board, a file or a stranger in every place for text."""
    if isinstance(told, dict):
        return {key: hostile(value) for key, value in told.items()}
    if isinstance(told, list):
        return [hostile(value) for value in told]
    return told + HOSTILE if isinstance(told, str) else told


def test_what_others_call_themselves_is_shown_and_steers_no_terminal(
    tactomo: Run, control: Any
) -> None:
    """In a status, in an event, and in a refusal."""
    trouble = {"name": "port_lost", "severity": "error", "detail": HOSTILE, "age_s": 240.0}
    control.answers["status"] = {
        **hostile({**STATUS, "state": ""}),
        **{"state": "running", "tier": "fit", "events": {"troubles": [trouble]}},
        "issues": [{"severity": "error", "what": HOSTILE, "next_step": HOSTILE}],
    }
    control.answers["tare"] = ControlError("tare_refused", HOSTILE, HOSTILE)
    shown = tactomo("status", status=0).stdout
    refused = tactomo("tare", status=1).stderr
    for text in (shown, refused):
        assert "x[/b]y skin[left]" in text
        assert not re.search("[\x07\x9b\u202e]|\x1b(?!\\[[0-9;]*m)", text)  # colours are ours


def test_what_is_lost_is_told_by_counts_of_the_last_minute(tactomo: Run, control: Any) -> None:
    """Whatever the rates say: a dead channel's is 0, and what was long ago is over."""
    idle = {"url": "/dev/ttyACM0", "connected": True, "state": "idle", "problem": None}
    control.answers["status"] = {
        **STATUS,
        **{"ports": [idle], "rates": {"magnitude_hz": 0.0}, "dropped_scans": 7058, "frames": 9000},
        "last_minute": {"frames": 600, "dropped_scans": 150, "incomplete_scans": 600},
    }
    judge(control)
    shown = tactomo("status").stdout
    assert "150 of 750 dual scans within the last minute were left out" in shown
    assert "600 of 750 dual scans within the last minute lacked a channel" in shown
    assert "check the cable of the channel" in shown  # a busy computer does not explain it all
    assert "/dev/ttyACM0 is idle\n" in shown
    over = {"last_minute": {"frames": 600, "dropped_scans": 0, "incomplete_scans": 0}}
    control.answers["status"] |= over
    judge(control)
    shown = tactomo("status").stdout
    assert "left out" not in shown
    assert "7058 dual scans dropped" in shown


def test_a_replay_sends_nobody_to_a_cable_that_is_not_there(tactomo: Run, control: Any) -> None:
    losses = {"frames": 600, "dropped_scans": 150, "incomplete_scans": 600}
    replay = {"position_s": 1.0, "duration_s": 9.0, "speed": 1.0, "exact": True}
    control.answers["status"] = {**STATUS, "replay": replay, "last_minute": losses}
    judge(control)
    shown = tactomo("status").stdout
    assert "so it was recorded" in shown
    assert "give the daemon more of the processor" in shown  # that is of this computer
    assert "cable" not in shown


def test_before_the_first_tare_it_says_that_one_is_being_taken(tactomo: Run, control: Any) -> None:
    told = {"ports": [], "flags": ["no_reference"], "dropped_scans": 0, "incomplete_scans": 0}
    control.answers["status"] = {**STATUS, **told, "state": "taring"}
    judge(control)
    shown = tactomo("status").stdout
    assert "a reference is being taken" in shown
    assert "no scans" not in shown
    assert "tactomo tare" not in shown


def test_a_status_that_no_daemon_sends_ends_in_no_traceback(tactomo: Run, control: Any) -> None:
    for key in STATUS:
        for value in (None, 7, "x", [], [1], {"a": 1}, 1e308):
            with suppress(TactomoError):
                lines_of({**STATUS, key: value})
    control.answers["status"] = {**STATUS, "uptime_s": "long"}
    said = tactomo("status", status=1).stderr
    assert said.startswith("tactomo: what answers is no daemon of this version: ")
    assert "tactomo status --json" in said


def test_every_flag_has_its_advice() -> None:
    assert set(FLAG_ADVICE) == {flag.name.lower() for flag in Flag if flag.name}


def test_status_as_json_and_of_a_daemon_that_has_no_data_yet(tactomo: Run, control: Any) -> None:
    control.answers["status"] = STATUS
    assert json.loads(tactomo("status", "--json").stdout) == STATUS
    control.answers["status"] = NEW_DAEMON
    result = tactomo("status", status=0)
    assert "left_forearm: waiting for data" in result.stdout
    assert "unknown: no map yet" in result.stdout


@pytest.mark.slow
def test_status_of_one_sensor_is_what_its_stream_tells(tactomo: Run) -> None:
    with (
        FakeSensor("left_forearm") as fake,
        repeated(lambda: fake.publish_message("status", STATUS)),
    ):
        result = tactomo("status", "-s", "left_forearm", "--address", fake.address)
        other = tactomo("status", "-s", "right", "--address", fake.address)
    assert result.returncode == 0, result.stderr
    assert "left_forearm: running" in result.stdout
    assert other.returncode == 1
    assert f"no daemon answers at {fake.address} for a sensor 'right'" in other.stderr


@pytest.mark.parametrize(
    ("status", "contacts", "told"),
    [
        ({}, {}, ""),
        ({"reference": None, "rates": {"frames_hz": 0.25}}, {}, "80 s"),
        ({}, {"contacts": 2}, "shown meanwhile: 2 contacts. If something was on the skin"),
        ({}, {"contacts": 2}, "tare again"),
    ],
)
def test_tare_says_what_the_reference_is_made_of(
    tactomo: Run, control: Any, status: dict[str, Any], contacts: dict[str, int], told: str
) -> None:
    control.answers |= {"status": status, "tare": {"scans": 20, **contacts}}
    result = tactomo("tare")
    assert (result.returncode, result.stdout) == (0, "new reference from 20 dual scans\n")
    assert told in result.stderr
    assert bool(told) == bool(result.stderr)


def test_a_refusal_is_one_line_with_cause_and_next_step(tactomo: Run, control: Any) -> None:
    control.answers["tare"] = ControlError(
        "somebody presses", "let go and tare again", "tare_refused"
    )
    result = tactomo("tare", status=1)
    assert result.stderr == "tactomo: somebody presses; let go and tare again\n"


def test_record_start_gives_a_name(tactomo: Run, control: Any) -> None:
    control.answers["record_start"] = {"path": "/x.mcap"}
    tactomo("record", "start", "x.mcap", status=0)
    tactomo("record", "start", status=0)
    assert control.requests == [("record_start", {"path": "x.mcap"}), ("record_start", {})]


def test_record_a_file_for_some_seconds(
    tactomo: Run, control: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a clock that passes an hour over the start, which does not count."""
    passed_s = 0.0

    class SlowDisk(dict[str, Any]):
        def get(self, command: str, otherwise: Any = None) -> Any:
            nonlocal passed_s
            passed_s += 3600.0 if command == "record_start" else 0.25
            return super().get(command, otherwise)

    control.answers = SlowDisk()
    monkeypatch.setattr(
        "tactomo.cli.steer.steer.time",
        SimpleNamespace(monotonic=lambda: passed_s, sleep=lambda _: None),
    )
    control.answers["record_start"] = {"path": "/x.mcap"}
    control.answers["record_stop"] = {"path": "/x.mcap", "bytes": 1_230_000}
    control.answers["status"] = STATUS
    result = tactomo("record", "x.mcap", "--seconds", "0.6", status=0)
    assert result.stdout == "recorded /x.mcap (1.23 MB)\n"
    asked = [command for command, _ in control.requests]
    assert asked == ["record_start", *["status"] * 3, "record_stop"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_recording_ends_with_the_command_and_its_terminal(
    control: Any, number: signal.Signals
) -> None:
    """The daemon went on to record, until its disk was full."""
    control.answers["record_start"] = {"path": "/x.mcap"}
    control.answers["record_stop"] = {"path": "/x.mcap", "bytes": 1_230_000}
    control.answers["status"] = STATUS
    command = [sys.executable, "-m", "tactomo.cli", "record", "x.mcap"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        wait_until(lambda: "status" in [asked for asked, _ in control.requests], "the recording")
        process.send_signal(number)
        said, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert said == "recorded /x.mcap (1.23 MB)\n"
    assert control.requests[-1][0] == "record_stop"


def test_tier_and_budget(tactomo: Run, control: Any) -> None:
    control.answers["set_tier"] = {"tier": "tikhonov"}
    control.answers["set_budget"] = {"budget_ms": 20.0}
    tactomo("method", "tikhonov", "--budget-ms", "20", status=0)
    assert control.requests == [
        ("set_tier", {"tier": "tikhonov"}),
        ("set_budget", {"budget_ms": 20.0}),
    ]


def test_poke_sends_numbers_as_numbers(tactomo: Run, control: Any) -> None:
    control.answers["mute"] = {"done": True}
    result = tactomo(
        "poke", "mute", "channel=structure", "seconds=2.5", "port=1", "--address", control.address
    )
    assert json.loads(result.stdout) == {"done": True}
    assert control.requests == [("mute", {"channel": "structure", "seconds": 2.5, "port": 1})]


def test_poke_tells_that_there_is_nothing_to_release(tactomo: Run, control: Any) -> None:
    command = ("poke", "release", "id=thumb", "--address", control.address)
    control.answers["release"] = {"released": True}
    assert tactomo(*command, status=0).stdout == ""
    control.answers["release"] = {"released": False}
    result = tactomo(*command)
    assert (result.returncode, result.stdout) == (1, "")
    assert "no press has this id" in result.stderr


def test_a_poke_waits_for_the_reference_of_the_daemon(tactomo: Run, control: Any) -> None:
    line = {"path": "/dev/made_up", "open": True, "sent": 1}
    control.answers["status"] = {"rate_hz": 20.0, "ports": [line]}
    starting = {"state": "running", "reference": None}
    with FakeControl({"status": starting}) as reader:
        program = Running("daemon", reader.address, "palm", ports=("/dev/made_up",))
        tared = {"state": "running", "reference": {"scans": 20}}
        timer = Timer(1.0, lambda: reader.answers.update(status=tared))
        with announced(program):
            timer.start()
            result = tactomo("poke", "press", "x_mm=1", "--address", control.address)
            timer.join()
    assert result.returncode == 0, result.stderr
    assert "palm has no reference yet" in result.stderr
    told = [command for command, _ in control.requests]
    assert told[-1] == "press"
    assert len(told) > 3


def test_a_poke_does_not_wait_where_a_program_of_the_users_own_reads(
    tactomo: Run, control: Any
) -> None:
    line = {"path": "/dev/made_up", "open": True, "sent": 100}
    control.answers["status"] = {"rate_hz": 20.0, "ports": [line]}
    result = tactomo("poke", "press", "x_mm=1", "--address", control.address)
    assert (result.returncode, result.stderr) == (0, "")
    assert [command for command, _ in control.requests] == ["status", "press"]

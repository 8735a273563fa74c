"""`Daemon`: each command, its typed result, its errors by their class, one connection for all."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from fake_control import FakeControl
from tables import table
from tactomo_client import (
    AlreadyRecording,
    ControlError,
    Daemon,
    MessageError,
    NoAnswer,
    NotRecording,
    errors,
)
from waiting import wait_until

PATIENCE_S = 30.0


def test_each_command_has_its_typed_result() -> None:
    answers: dict[str, Any] = {
        "status": {"state": "running", "latency_ms": {"p50": 4.0, "p99": 9}},
        "tare": {"scans": 20},
        "record_start": {"path": "/data/a.mcap"},
        "record_stop": {"path": "/data/a.mcap", "bytes": 123},
        "set_tier": {"tier": "fit"},
        "set_budget": {"budget_ms": None},
        "reload_calibration": {"calibration": {"readings": 12, "range_kpa": [140.0, 240.0]}},
    }
    with FakeControl(answers) as control, Daemon(control.address, timeout_s=PATIENCE_S) as daemon:
        status = daemon.status()
        assert status.state == "running"
        assert status.latency_ms is not None
        assert status.latency_ms.p99 == 9.0
        assert not status.is_stale
        assert daemon.tare().scans == 20
        assert daemon.record_start("/data/a.mcap", maps=True).path == "/data/a.mcap"
        assert daemon.record_stop().bytes == 123
        assert daemon.set_tier("fit").tier == "fit"
        assert daemon.set_budget(None).budget_ms is None
        calibration = daemon.reload_calibration().calibration
        assert calibration is not None
        assert (calibration.readings, calibration.range_kpa) == (12, (140.0, 240.0))
    assert control.requests == [
        ("status", {}),
        ("tare", {}),
        ("record_start", {"path": "/data/a.mcap", "maps": True}),
        ("record_stop", {}),
        ("set_tier", {"tier": "fit"}),
        ("set_budget", {"budget_ms": None}),
        ("reload_calibration", {}),
    ]


def test_every_error_of_the_document_has_its_class_and_no_other() -> None:
    rows = table("clients/STREAM.md", "### Commands of the daemon", "Command")
    named = {n for row in rows.values() for n in re.findall(r"`(\w+)`", row["Own errors"])}
    assert named | {"bad_argument", "no_answer"} == errors._OF_NAME.keys()


def test_an_error_is_raised_as_its_class() -> None:
    refusals = {
        "record_start": ControlError("runs already", "stop it", "already_recording"),
        "record_stop": ControlError("none runs", "", "not_recording"),
        "tare": ControlError("of a later version", "", "something_new"),
    }
    with FakeControl(refusals) as control, Daemon(control.address, timeout_s=PATIENCE_S) as daemon:
        with pytest.raises(AlreadyRecording, match="runs already; stop it"):
            daemon.record_start()
        with pytest.raises(NotRecording):
            daemon.record_stop()
        with pytest.raises(ControlError) as caught:
            daemon.tare()
        assert (type(caught.value), caught.value.name) == (ControlError, "something_new")


def test_a_recording_ends_with_its_block_whatever_happens_in_it(tmp_path: Path) -> None:
    stopped = {"path": "/data/a.mcap", "bytes": 7}
    answers: dict[str, Any] = {"record_start": {"path": "/data/a.mcap"}, "record_stop": stopped}
    with FakeControl(answers) as control, Daemon(control.address, timeout_s=PATIENCE_S) as daemon:
        with daemon.record() as recording:
            assert (recording.path, recording.file) == ("/data/a.mcap", None)
        assert recording.file is not None
        assert recording.file.bytes == 7
        with pytest.raises(KeyboardInterrupt), daemon.record():
            raise KeyboardInterrupt
        control.answers["record_stop"] = ControlError("the disk is full", "", "cannot_write")
        with pytest.raises(ZeroDivisionError), daemon.record():  # not what stopping said
            raise ZeroDivisionError
    assert [name for name, _ in control.requests] == ["record_start", "record_stop"] * 3


def test_a_daemon_that_was_away_answers_again() -> None:
    with FakeControl({"tare": {"scans": 1}}) as control:
        daemon = Daemon(control.address, timeout_s=PATIENCE_S)
        assert daemon.tare().scans == 1
    daemon.timeout_s = 0.05

    def refusal() -> str:
        with pytest.raises(NoAnswer, match="nothing answered at ") as caught:
            daemon.status()
        return str(caught.value)

    wait_until(lambda: "start the daemon" in refusal(), "the end of the connection to be seen")
    daemon.timeout_s = PATIENCE_S
    with FakeControl({"tare": {"scans": 2}}, control.address):
        assert daemon.tare().scans == 2
    daemon.close()
    daemon.close()


def test_an_answer_of_another_shape_is_named() -> None:
    answers: dict[str, Any] = {
        "tare": {"scans": "many"},
        "record_stop": {"path": "/a"},
        "status": {"ports": 3},
    }
    with FakeControl(answers) as control, Daemon(control.address, timeout_s=PATIENCE_S) as daemon:
        with pytest.raises(MessageError, match="field 'scans' is a str"):
            daemon.tare()
        with pytest.raises(MessageError, match="field 'bytes' is missing"):
            daemon.record_stop()
        with pytest.raises(MessageError, match="field 'ports' is a int"):
            daemon.status()

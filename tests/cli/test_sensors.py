"""Which sensor a command is for: the only one that runs, or which to say, and how."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from fake_control import FakeControl
from fixture_types import Run
from tactomo.cli.sensors import twin_of
from tactomo.endpoint import free_addresses
from tactomo.running import Running, announced, running
from tactomo_client.fake import FakeSensor
from waiting import PATIENCE_S, repeated

HOLDER = """
import sys, time
from tactomo.running import Running, announced
with announced(Running("daemon", "tcp://127.0.0.1:1", "killed")):
    print("there", flush=True)
    time.sleep(600)
"""


@contextlib.contextmanager
def announcing(*programs: Running) -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        for program in programs:
            stack.enter_context(announced(program))
        yield


@contextlib.contextmanager
def telling(sensor: str, **status: Any) -> Iterator[FakeSensor]:
    """Publish a sensor's status, over and over."""
    said = {"sensor": sensor, "state": "running", **status}
    with FakeSensor(sensor) as fake, repeated(lambda: fake.publish_message("status", said)):
        yield fake


def test_the_only_sensor_is_found(tactomo: Run) -> None:
    with FakeControl({"tare": {"scans": 20}}) as control:
        with announcing(Running("daemon", control.address, "left")):
            tactomo("tare", status=0)
            tactomo("tare", "--sensor", "left", status=0)
        assert running("daemon") == []
    assert [command for command, _ in control.requests] == ["status", "tare"] * 2


def test_several_are_listed_and_one_is_asked_for(tactomo: Run, monkeypatch: Any) -> None:
    with FakeControl({"tare": {"scans": 20}}) as left, FakeControl() as right:
        each = [
            Running("daemon", left.address, "left", "tcp://127.0.0.1:1", ("/dev/ttyACM0",)),
            Running("daemon", right.address, "right", "tcp://127.0.0.1:2"),
        ]
        with announcing(*each):
            told = tactomo("tare", status=1)
            assert "left at tcp://127.0.0.1:1, of /dev/ttyACM0\n" in told.stderr
            assert "2 run on this computer; choose one by --sensor NAME:\n" in told.stderr
            monkeypatch.setenv("TACTOMO_SENSOR", "left")
            tactomo("tare", status=0)
    assert right.requests == []


def test_two_of_a_name_are_told_by_their_addresses(tactomo: Run) -> None:
    each = [Running("daemon", "", "skin", f"tcp://127.0.0.1:{port}") for port in (1, 2)]
    with announcing(*each):
        told = tactomo("watch", "--sensor", "skin")
    assert told.returncode == 1
    assert "choose one by --address ADDRESS" in told.stderr


@pytest.mark.parametrize(
    "command", [("status",), ("watch",), ("tare",), ("doctor",), ("foxglove",)]
)
def test_where_none_runs_it_says_how_to_start_one(tactomo: Run, command: tuple[str]) -> None:
    told = tactomo(*command, status=1)
    assert "no sensor runs on this computer; start one by `tactomo daemon`" in told.stderr


def test_a_command_goes_to_the_daemon_whose_stream_is_given(tactomo: Run, monkeypatch: Any) -> None:
    answers: dict[str, Any] = {"status": {"sensor": "palm"}, "tare": {"scans": 20}}
    with FakeControl(answers) as control, telling("palm", control=control.address) as fake:
        monkeypatch.setenv("TACTOMO_ADDRESS", fake.address)
        tactomo("tare", status=0)
        control.answers["status"] = {"sensor": "sole"}
        told = tactomo("tare")
    assert told.returncode == 1
    assert f"{control.address} is the control socket of sole, not of palm" in told.stderr


def test_what_a_killed_daemon_leaves_counts_for_nothing() -> None:
    command = [sys.executable, "-c", HOLDER]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert [each.sensor for each in running("daemon")] == ["killed"]
        process.kill()
        process.wait(PATIENCE_S)
    assert running("daemon") == []


def test_the_twin_of_a_skin_is_the_one_that_has_its_ports() -> None:
    twin = Running("twin", "tcp://127.0.0.1:3", ports=("/tmp/a", "/tmp/b"))
    with announcing(twin):
        assert twin_of(Running("daemon", "", "skin", ports=("/tmp/b",))) == twin.control
        assert twin_of(Running("daemon", "", "skin", ports=("/dev/ttyACM0",))) is None


def test_addresses_that_are_taken_are_passed_over_together() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        free = free_addresses(f"tcp://127.0.0.1:{port - 1}", f"tcp://127.0.0.1:{port}")
    assert free == [f"tcp://127.0.0.1:{port + 19}", f"tcp://127.0.0.1:{port + 20}"]

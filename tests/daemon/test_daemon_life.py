"""Starting, stopping and being killed: nothing is left behind, nothing recorded is lost."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tactomo.config import load_config
from tactomo.daemon import Daemon
from tactomo.errors import TactomoError
from tactomo.recording import open_recording
from tactomo_client import request
from tactomo_models import Tier

Start = Callable[..., Any]

PYTHONPATH = os.environ.get("PYTHONPATH", "")

# What `tactomo daemon` does, with a reconstructor that needs no artifact.
PROGRAM = """
import sys
from tactomo.config import load_config
from tactomo.daemon import Daemon
from tactomo.errors import TactomoError
from tactomo.log import configure_logging
from conftest import Memory

configure_logging("info", "json")
try:
    sys.exit(Daemon(load_config(sys.argv[1]), reconstructor=Memory()).run())
except TactomoError as error:
    sys.exit(f"{error.cause}; {error.next_step}")
"""


def toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {toml(each)}" for key, each in value.items()) + "}"
    return json.dumps(value)


class Process:
    """A daemon in a process of its own, on a skin of this one."""

    def __init__(self, folder: Path, skin: Any, **config: Any) -> None:
        settings = {
            "name": "left",
            "ports": [str(line.path) for line in skin.lines],
            "stream": "tcp://127.0.0.1:0",
            "control": "tcp://127.0.0.1:0",
            "tare_scans": 3,
            "baseline": {"track": False},
            **config,
        }
        path = folder / "daemon.toml"
        path.write_text("".join(f"{key} = {toml(value)}\n" for key, value in settings.items()))
        self.popen = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(path)],
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": f"{Path(__file__).parent}:{PYTHONPATH}"},
        )
        assert self.popen.stderr is not None
        self.ready: dict[str, Any] = {}
        for line in self.popen.stderr:
            event = json.loads(line)
            if event["event"] == "ready":
                self.ready = event
                break


@pytest.fixture
def spawn(tmp_path: Path, make_skin: Callable[..., Any]) -> Iterator[Callable[..., Any]]:
    processes: list[Process] = []

    def start(**config: Any) -> tuple[Process, Any]:
        skin = make_skin(tmp_path, 1)
        process = Process(tmp_path, skin, **config)
        processes.append(process)
        return process, skin

    yield start
    for process in processes:
        process.popen.kill()
        process.popen.communicate()


def test_nothing_is_left_after_a_stop(bench: Start, tmp_path: Path) -> None:
    bench().daemon.stop()  # what the libraries keep for good is there now
    threads = set(threading.enumerate())
    before = len(os.listdir("/proc/self/fd"))
    b = bench(ports=2, record=tmp_path / "skin.mcap")
    b.tare()
    begin_s = time.monotonic()
    b.daemon.stop()
    assert time.monotonic() - begin_s < 10.0  # a third of a second, on a machine with time to spare
    b.daemon.stop()  # again is fine
    b.listener.socket.close()
    b.skin.close()
    b.until(lambda: len(os.listdir("/proc/self/fd")) <= before)
    assert set(threading.enumerate()) <= threads


def test_nothing_is_left_after_a_start_that_failed(bench: Start, tmp_path: Path) -> None:
    b = bench()
    free = os.openpty()
    good, bad = os.ttyname(free[1]), str(tmp_path / "absent")
    threads = set(threading.enumerate())
    before = len(os.listdir("/proc/self/fd"))
    memory: Any = SimpleNamespace(tier=Tier.AUTO, budget_s=None)
    off = {"track": False}
    local = {"stream": "tcp://127.0.0.1:0", "control": "tcp://127.0.0.1:0"}
    for settings in (
        {"ports": [good, bad], **local},
        {"ports": [good], "stream": "tcp://127.0.0.1:0", "control": b.daemon.control_address},
        {"ports": [good], "record": Path("/proc/none/skin.mcap"), **local},
    ):
        with pytest.raises(TactomoError):
            Daemon(load_config(baseline=off, **settings), reconstructor=memory).start()
    b.until(lambda: len(os.listdir("/proc/self/fd")) <= before)
    assert set(threading.enumerate()) <= threads
    for descriptor in free:
        os.close(descriptor)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_it_within_a_second(spawn: Start, tmp_path: Path, number: int) -> None:
    process, _ = spawn(recording={"file": str(tmp_path / "skin.mcap")})
    begin_s = time.monotonic()
    process.popen.send_signal(number)
    assert process.popen.wait(30) == 0
    assert time.monotonic() - begin_s < 10.0  # a busy machine and the interpreter's end included
    assert open_recording(tmp_path / "skin.mcap").summary.is_complete


def scans_in(path: Path) -> int:
    return sum(open_recording(path).summary.scans.values())


def test_a_killed_daemons_recording_opens_up_to_its_last_flush(
    spawn: Start, replay: Start, tmp_path: Path
) -> None:
    path = tmp_path / "skin.mcap"
    process, skin = spawn(recording={"file": str(path)})
    skin.introduce()
    for _ in range(10):
        skin.scan()

    skin.wait_until(lambda: scans_in(path) == 20)  # it flushes by itself
    process.popen.kill()
    process.popen.wait()
    summary = open_recording(path).summary
    assert not summary.is_complete
    assert scans_in(path) == 20
    assert summary.frames == len(replay(path).of("map")) > 0


def test_a_full_disk_ends_the_recording_and_nothing_else(spawn: Start, tmp_path: Path) -> None:
    path = tmp_path / "skin.mcap"
    process, skin = spawn()
    control = process.ready["control"]
    skin.introduce()
    for _ in range(4):
        skin.scan()
    request("record_start", control, path=str(path))
    size = path.stat().st_size
    skin.scan()
    skin.wait_until(lambda: path.stat().st_size > size)
    # As good as a full disk: no file of that process may grow much further.
    limit = path.stat().st_size + 4000
    resource.prlimit(process.popen.pid, resource.RLIMIT_FSIZE, (limit, limit))
    skin.wait_until(lambda: [skin.scan(), request("status", control)["recording"]][1] is None)
    lines = iter(process.popen.stderr.readline, "")
    failed = next(json.loads(line) for line in lines if "recording_failed" in line)
    assert failed["level"] == "error"
    assert "too large" in failed["detail"]
    assert request("status", control)["state"] == "running"
    assert open_recording(path).summary.frames > 0


def test_a_thread_that_dies_takes_the_daemon_down(bench: Start) -> None:
    b = bench()

    def fail(*_: Any) -> None:
        raise ZeroDivisionError("a mistake")

    b.daemon._imaging.check_tare = fail
    hook, threading.excepthook = threading.excepthook, lambda _: None
    try:
        assert b.daemon.wait() == 1
    finally:
        threading.excepthook = hook

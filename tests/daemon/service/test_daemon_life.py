"""Starting, stopping and being killed: nothing is left behind, nothing recorded is lost."""

from __future__ import annotations

import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from daemon_bench import LOCAL, UNUSED
from daemon_process import DaemonProcess
from fixture_types import Start
from tactomo.config import load_config
from tactomo.errors import ConfigError, TactomoError
from tactomo.imaging.pipeline import QUEUED_DELIVERIES
from tactomo.recordings.recording import open_recording
from tactomo.scans import PortRead
from tactomo.service.daemon import Daemon
from waiting import PATIENCE_S, wait_until

# What `tactomo daemon` does, with a reconstructor that needs no artifact.
PROGRAM = """
import sys
from tactomo.config import load_config
from tactomo.service.daemon import Daemon
from tactomo.errors import ConfigError, TactomoError
from tactomo.log import configure_logging
from daemon_bench import Memory

configure_logging("info", "json")
try:
    sys.exit(Daemon(load_config(sys.argv[1]), reconstructor=Memory()).run())
except TactomoError as error:
    sys.exit(f"{error.cause}; {error.next_step}")
"""


@pytest.fixture
def spawn(tmp_path: Path, make_skin: Callable[..., Any]) -> Iterator[Callable[..., Any]]:
    """Start a daemon in a process of its own, on a skin of this one: ``spawn(**config)``."""
    processes: list[DaemonProcess] = []

    def start(**config: Any) -> tuple[DaemonProcess, Any]:
        skin = make_skin(tmp_path, 1)
        settings: dict[str, Any] = {
            "tare_scans": 3,
            "sync_wait_ms": 500,
            "baseline": {"track": False},
        }
        ports = [str(line.path) for line in skin.lines]
        process = DaemonProcess(tmp_path, ports, program=PROGRAM, **settings, **config)
        processes.append(process)
        return process, skin

    yield start
    for process in processes:
        process.kill()


@pytest.mark.slow
def test_nothing_is_left_after_a_stop(bench: Start, tmp_path: Path) -> None:
    bench().daemon.stop()  # what the libraries keep for good is there now
    threads = set(threading.enumerate())
    before = len(os.listdir("/proc/self/fd"))
    b = bench(ports=2, recording={"file": tmp_path / "skin.mcap"}).tare()
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
    good, bad = os.ttyname(free[1]), str(tmp_path / "no_port")
    Path(bad).touch()
    threads = set(threading.enumerate())
    before = len(os.listdir("/proc/self/fd"))
    off = {"track": False}
    taken = b.daemon.control_address
    for settings, says in (
        ({"ports": [good, bad]}, bad),
        ({"ports": [good], "control": taken}, taken),
        ({"ports": [good], "recording": {"file": "/proc/none/s.mcap"}}, "/proc/none"),
    ):
        config = load_config(baseline=off, **LOCAL | settings)
        with pytest.raises(TactomoError, match=re.escape(says)):
            Daemon(config, reconstructor=UNUSED).start()
    b.until(lambda: len(os.listdir("/proc/self/fd")) <= before)
    assert set(threading.enumerate()) <= threads
    for descriptor in free:
        os.close(descriptor)


def test_a_sensor_of_one_channel_has_one_port() -> None:
    config = load_config(ports=("/dev/null", "/dev/zero"), description="graded_square")
    with pytest.raises(ConfigError, match="give one port"):
        Daemon(config)


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGTERM,
        *(
            pytest.param(number, marks=pytest.mark.slow)
            for number in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGUSR1)
        ),
    ],
)
def test_a_signal_stops_it_within_a_second(spawn: Start, tmp_path: Path, number: int) -> None:
    before = signal.signal(number, signal.SIG_DFL)  # whoever runs the tests may have it ignored
    try:
        process, _ = spawn(recording={"file": str(tmp_path / "skin.mcap")})
    finally:
        signal.signal(number, before)
    begin_s = time.monotonic()
    process.signal(number)
    assert process.popen.wait(PATIENCE_S) == 0
    assert time.monotonic() - begin_s < 10.0  # a busy machine and the interpreter's end included
    assert open_recording(tmp_path / "skin.mcap").summary.is_complete


@pytest.mark.slow
def test_a_killed_daemons_recording_opens_up_to_its_last_flush(
    spawn: Start, replay: Start, tmp_path: Path
) -> None:
    path = tmp_path / "skin.mcap"
    process, skin = spawn(recording={"file": str(path)})
    skin.introduce()
    for _ in range(10):
        skin.scan()

    def flushed() -> tuple[int, int]:
        summary = open_recording(path).summary
        return sum(summary.scans.values()), summary.frames

    wait_until(lambda: flushed() >= (20, 1), "a flush of its own accord")
    process.kill()
    assert not open_recording(path).summary.is_complete
    scans, frames = flushed()
    assert scans == 20
    assert frames == len(replay(path).of("map"))


def test_a_thread_that_dies_takes_the_daemon_down(bench: Start) -> None:
    b = bench()

    def fail(*_: Any) -> None:
        raise ZeroDivisionError("a mistake")

    b.daemon._imaging.taring.check = fail
    hook, threading.excepthook = threading.excepthook, lambda _: None
    try:
        assert b.daemon.wait() == 1
    finally:
        threading.excepthook = hook


def test_a_port_that_may_lose_nothing_does_not_wait_for_a_thread_that_died(bench: Start) -> None:
    """The daemon hung then, whatever signal came."""
    pipeline = bench(lossless=True).daemon._pipeline
    pipeline.stop()
    pipeline._stopping.clear()  # as of a thread that died by itself

    def deliver() -> None:
        for _ in range(QUEUED_DELIVERIES + 1):
            pipeline.deliver(PortRead(0, 0, ()))

    port = threading.Thread(target=deliver, daemon=True)
    port.start()
    port.join(PATIENCE_S)
    assert not port.is_alive()

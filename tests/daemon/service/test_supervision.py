"""What the service manager is told, by a real daemon process: ready, alive, how it is, stopping."""

from __future__ import annotations

import signal
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from daemon_process import DaemonProcess
from waiting import PATIENCE_S

WATCHDOG_S = 2.0

# What `tactomo daemon` does, with a reconstructor that needs no artifact. One that `hangs` stays
# for ever in the first frame of a loaded skin; control hangs once it is asked for the status.
PROGRAM = """
import sys, threading
from tactomo.config import load_config
from tactomo.service.daemon import Daemon
from tactomo.log import configure_logging
from daemon_bench import REST, Memory

class Hanging(Memory):
    def compare(self, magnitude, structure, **details):
        if magnitude.mean() > 1.2 * REST.mean():
            threading.Event().wait()
        return super().compare(magnitude, structure, **details)

class Asked(Daemon):
    def status(self):
        threading.Event().wait()

configure_logging("info", "json")
sys.exit(Asked(load_config(sys.argv[1]), reconstructor=Hanging()).run())
"""


class ServiceManager:
    """The other end of $NOTIFY_SOCKET."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._socket.settimeout(0.1)
        self.path = path
        self.told: list[tuple[float, str]] = []

    def listen(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            try:
                data = self._socket.recv(4096)
            except TimeoutError:
                continue
            self.told += [(time.monotonic(), line) for line in data.decode().splitlines()]

    def times_s(self, start: str) -> list[float]:
        return [at_s for at_s, line in self.told if line.startswith(start)]

    def wait(self, start: str, since_s: float = 0.0) -> float:
        """Wait for a line that starts so; returns when it came."""
        end_s = time.monotonic() + PATIENCE_S
        while not (found := [at_s for at_s in self.times_s(start) if at_s > since_s]):
            assert time.monotonic() < end_s, f"no {start} in {self.told}"
            self.listen(0.1)
        return found[0]

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[ServiceManager]:
    manager = ServiceManager(tmp_path / "notify")
    yield manager
    manager.close()


@pytest.fixture
def supervised(
    tmp_path: Path, make_skin: Callable[..., Any], manager: ServiceManager
) -> Iterator[tuple[DaemonProcess, Any]]:
    """A daemon under a watchdog, and its skin."""
    skin = make_skin(tmp_path, 1)
    process = DaemonProcess(
        tmp_path,
        [str(line.path) for line in skin.lines],
        program=PROGRAM,
        environment={
            "NOTIFY_SOCKET": str(manager.path),
            "WATCHDOG_USEC": str(round(WATCHDOG_S * 1e6)),
        },
        tare_scans=3,
        baseline={"track": False},
    )
    yield process, skin
    process.kill()


@pytest.mark.slow
def test_a_daemon_without_data_is_ready_alive_and_says_when_it_stops(
    supervised: tuple[DaemonProcess, Any], manager: ServiceManager
) -> None:
    process, skin = supervised
    fed_s = manager.wait("READY=1")
    assert manager.times_s("STATUS=waiting for data: 0 frames/s, 0 subscriptions")
    for _ in range(3):
        fed_s = manager.wait("WATCHDOG=1", fed_s)
    skin.lines[0].unplug()
    manager.wait("STATUS=waiting for port, ")
    manager.wait("WATCHDOG=1", manager.wait("WATCHDOG=1", time.monotonic()))  # without a device
    process.signal(signal.SIGTERM)
    manager.wait("STOPPING=1")
    assert process.popen.wait(PATIENCE_S) == 0


@pytest.mark.slow
def test_a_pipeline_that_hangs_is_not_hidden_by_the_threads_that_do_not(
    supervised: tuple[DaemonProcess, Any], manager: ServiceManager
) -> None:
    process, skin = supervised
    manager.wait("READY=1")
    skin.introduce()
    begin_s = time.monotonic()
    for load in (0, 0, 0, 0, 0.5):
        skin.scan(load)
    hangs_s = manager.wait("STATUS=hangs: pipeline", begin_s)
    manager.listen(1.5 * WATCHDOG_S)
    assert not [at_s for at_s in manager.times_s("WATCHDOG=1") if at_s > hangs_s]
    process.signal(signal.SIGABRT)  # as systemd does
    assert process.popen.wait(PATIENCE_S) == -signal.SIGABRT
    log = process.log_path.read_text()
    assert '"threads": ["pipeline"' in log  # and whoever else a busy computer held up
    assert "in compare" in log, "where it hangs is in the log"


@pytest.mark.slow
def test_control_does_not_feed_the_watchdog(
    supervised: tuple[DaemonProcess, Any], manager: ServiceManager
) -> None:
    process, _ = supervised
    manager.wait("READY=1")
    assert not process.answers(1.0), "control hangs"
    fed_s = time.monotonic()
    for _ in range(2):  # before the first of them, control may have got on
        fed_s = manager.wait("WATCHDOG=1", fed_s)


@pytest.mark.long
def test_a_stopped_process_feeds_no_watchdog(
    supervised: tuple[DaemonProcess, Any], manager: ServiceManager
) -> None:
    process, _ = supervised
    manager.wait("WATCHDOG=1", manager.wait("READY=1"))
    process.signal(signal.SIGSTOP)
    stopped_s = time.monotonic()
    manager.listen(1.5 * WATCHDOG_S)
    assert not [at_s for at_s in manager.times_s("WATCHDOG=1") if at_s > stopped_s + 0.2]
    process.signal(signal.SIGCONT)
    manager.wait("WATCHDOG=1", stopped_s + WATCHDOG_S)

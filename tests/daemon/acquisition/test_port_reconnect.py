"""A port that goes away and comes back, as itself or as something else, and one that never was."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import serial
from fixture_types import Start
from tactomo.acquisition.adapters import holders
from tactomo.acquisition.connection import Connection
from tactomo.acquisition.liveness import PATIENCE_S
from tactomo.acquisition.open_serial import DEVICE_GONE, open_serial
from tactomo.errors import PortBusyError
from tactomo.events import EventBook
from tactomo.timing import LATE_PERIODS
from tactomo_models import load_description
from tactomo_protocol import CommandCode
from waiting import wait_until

Connect = Callable[[object], Connection]
Hold = Callable[..., subprocess.Popen[bytes]]


@pytest.fixture
def told() -> list[tuple[str, str]]:
    return []


@pytest.fixture
def connect(told: list[tuple[str, str]]) -> Iterator[Connect]:
    """Open a connection whose events are in `told`; it is closed later."""
    made: list[Connection] = []

    book = EventBook()

    def on_event(
        name: str, detail: str, next_step: str = "", about: str = "", reason: str = ""
    ) -> None:
        if not book.is_due(name, about, reason):
            return
        told.append((name, f"{detail}; {next_step}"))

    def open_connection(url: object) -> Connection:
        made.append(Connection(str(url), 921_600, on_event))
        return made[-1]

    yield open_connection
    for connection in made:
        connection.close()


@pytest.fixture
def hold() -> Iterator[Hold]:
    """Start a process that has a port open; it is stopped later."""
    started: list[subprocess.Popen[bytes]] = []

    def start(path: Path, *command: str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen([*command, str(path)], stdout=subprocess.DEVNULL)
        started.append(process)
        wait_until(lambda: any(holder.pid == process.pid for holder in holders(str(path))))
        return process

    yield start
    for process in started:
        stop(process)


def stop(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


# Going away


ACTIONS: dict[str, Callable[[serial.Serial], Any]] = {
    "read": lambda port: port.read(1),
    "read many": lambda port: port.read(100),
    "in_waiting": lambda port: port.in_waiting,
    "write": lambda port: port.write(b"x"),
    "flush": lambda port: port.reset_input_buffer(),
}


@pytest.mark.parametrize("how", ["hung up", "closed", "descriptor lost"])
@pytest.mark.parametrize("action", ACTIONS)
def test_whatever_pyserial_raises_on_unplugging_is_known(line: Any, action: str, how: str) -> None:
    port: Any = open_serial(str(line.path), 921_600)
    if how == "hung up":
        line.unplug()
    elif how == "closed":
        port.close()
    else:  # what a close by another thread leaves in the middle of a call
        os.close(port.fd)
        port.fd = None
    with pytest.raises(DEVICE_GONE):
        ACTIONS[action](port)
    if how == "descriptor lost":
        port.fd = os.open(os.devnull, os.O_RDWR)  # so that there is something to close
    port.close()


@pytest.mark.parametrize("call", ["read", "write"])
def test_a_device_may_go_in_the_middle_of_a_call(
    line: Any,
    call: str,
    connect: Connect,
    monkeypatch: pytest.MonkeyPatch,
    told: list[tuple[str, str]],
) -> None:
    monkeypatch.setattr("tactomo.acquisition.open_serial.READ_TIMEOUT_S", 60)
    monkeypatch.setattr("tactomo.acquisition.open_serial.WRITE_TIMEOUT_S", 60)
    connection = connect(line.path)
    connection.open()
    pulled = threading.Timer(0.2, line.unplug)
    pulled.start()
    if call == "read":
        assert connection.read() == b""
    else:
        assert not connection.write(bytes(1_000_000))  # far more than the line takes unread
    pulled.join()
    assert not connection.is_open
    assert connection.problem
    assert [name for name, _ in told] == ["port_lost"]


# Coming back


@pytest.mark.slow
def test_what_stands_in_the_way_is_told_and_waited_out(
    bench: Start, tmp_path: Path, hold: Hold
) -> None:
    b = bench().tare()
    line = b.skin.lines[0]

    def lost_because(words: str) -> None:
        b.listener.wait("event", lambda e: e["name"] == "port_lost" and words in e["detail"])
        b.listener.wait("status", lambda s: words in (s["ports"][0]["problem"] or ""))

    line.unplug()
    b.listener.event("port_lost")
    line.path.write_text("a file where the port was")
    lost_because("is not a serial device")
    line.path.unlink()
    where, line.path = line.path, tmp_path / "aside"  # or the daemon might come first
    line.plug()
    other = hold(line.path, "cat")
    line.path = line.path.rename(where)
    lost_because(f"pid {other.pid}: cat")
    stop(other)
    b.listener.event("port_back")
    line.introduce()
    assert b.step()["flags"] == []
    assert b.ask("status")["ports"][0]["problem"] is None


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open everything")
def test_a_permission_that_udev_gives_later_is_waited_for(
    line: Any, connect: Connect, told: list[tuple[str, str]]
) -> None:
    line.path.chmod(0)
    connection = connect(line.path)
    assert not connection.try_open()
    assert "may not be opened by this user; " in told[0][1]
    line.path.chmod(0o620)
    assert connection.try_open()


@pytest.mark.slow
def test_scans_of_a_newcomer_wait_for_its_hello(bench: Start) -> None:
    b = bench().tare()
    line = b.skin.lines[0]
    line.unplug()
    b.listener.event("port_lost")
    line.plug()
    wait_until(line.heard)
    before = b.ask("status")["ports"][0]["unused_scans"]
    b.skin.scan()
    b.listener.wait("status", lambda s: s["ports"][0]["unused_scans"] == before + 2)
    line.say(line.hello)
    assert b.step()["flags"] == []


# Never there


def test_a_daemon_may_wait_for_a_port_that_is_not_there_yet(bench: Start) -> None:
    b = bench(is_plugged=False, wait_for_ports=True)
    status = b.ask("status")
    assert status["state"] == "waiting_for_port"
    assert status["ports"][0]["state"] == "closed"
    assert "does not exist" in status["ports"][0]["problem"]
    b.skin.lines[0].plug()
    b.listener.event("port_back")
    b.tare()
    b.until(lambda: b.step() and b.ask("status")["state"] == "running")


# Others who hold it


def test_one_who_came_first_is_named(line: Any, hold: Hold) -> None:
    other = hold(line.path, "cat")
    with pytest.raises(PortBusyError) as caught:
        open_serial(str(line.path), 921_600)
    stop(other)
    assert f"pid {other.pid}: cat /" in caught.value.cause
    open_serial(str(line.path), 921_600).close()


# Not `cat`: on a port that the daemon has set up, it reads nothing and takes that for the end.
THIEF = """
import os, select, sys
port = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
while select.select([port], [], []):
    os.read(port, 4096)
"""


@pytest.mark.slow
def test_one_who_came_later_is_named(bench: Start, hold: Hold) -> None:
    b = bench().tare()
    line = b.skin.lines[0]
    other = hold(line.path, sys.executable, "-c", THIEF)  # root may, whatever the lock
    named = f"pid {other.pid}: "

    def is_named() -> bool:
        b.skin.scan()
        return any(named in e["detail"] for e in b.listener.of("event"))

    wait_until(is_named)
    stop(other)
    wait_until(lambda: b.ask("status")["ports"][0]["connected"])


# Those that are there and do not speak


@pytest.fixture
def _short_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tactomo.acquisition.liveness.PATIENCE_S", PATIENCE_S / 10)
    monkeypatch.setattr("tactomo.acquisition.liveness.REOPEN_S", 0.6)


@pytest.mark.usefixtures("_short_patience")
def test_a_silent_device_is_told_and_its_port_opened_anew(bench: Start) -> None:
    b = bench()
    assert "nothing came" in b.listener.event("device_silent")["detail"]

    def is_open_anew() -> bool:  # false while it is being opened once more
        (port,) = b.ask("status")["ports"]
        return bool(port["reopened"] and port["connected"] and port["state"] == "silent")

    wait_until(is_open_anew)

    def speak() -> bool:
        b.skin.lines[0].say(b.skin.lines[0].hello)
        b.skin.scan()
        return any(e["name"] == "device_speaks" for e in b.listener.of("event"))

    wait_until(speak)
    assert "port_lost" not in [e["name"] for e in b.listener.of("event")]


@pytest.mark.usefixtures("_short_patience")
def test_a_device_that_only_babbles_may_have_another_baud_rate(bench: Start) -> None:
    b = bench()

    def babble() -> bool:
        b.skin.lines[0].say(b"\xf8\x00\x7f\x06")
        return any(e["name"] == "device_garbled" for e in b.listener.of("event"))

    wait_until(babble)
    event = b.listener.event("device_garbled")
    assert "no packet of protocol tactomo at 921600 baud" in event["detail"]
    assert "baud" in event["next_step"]


@pytest.mark.slow
@pytest.mark.usefixtures("_short_patience")
def test_a_device_that_says_hello_and_nothing_else_is_asked_to_start(bench: Start) -> None:
    b = bench()
    codes: list[int] = []
    spoke_s: list[float] = []

    def greet() -> bool:
        spoke_s.append(time.monotonic())
        b.skin.lines[0].say(b.skin.lines[0].hello)
        codes.extend(command.code for command in b.skin.lines[0].heard())
        return any(e["name"] == "device_idle" for e in b.listener.of("event"))

    wait_until(greet)
    wait_until(lambda: greet() and codes.count(CommandCode.START) >= 2)

    def idle_port() -> Any:  # it speaks on: a pause would be silence
        greet()
        (port,) = b.ask("status")["ports"]
        return port if port["state"] == "idle" else None

    port = wait_until(idle_port)
    pauses_s = [later - earlier for earlier, later in pairwise(spoke_s)]
    assert port["reopened"] == 0 or max(pauses_s) >= PATIENCE_S / 10  # a computer that stopped
    assert port["problem"] == "the device speaks, but sends no scans"


@pytest.mark.slow
@pytest.mark.usefixtures("_short_patience")
def test_a_slow_board_runs_between_its_frames_until_it_stops(bench: Start) -> None:
    """Its protocol gives the first frame 4 s; then its own pace counts, here one frame a second."""
    count = load_description("matrix_square").measurements
    line = b",".join(b"%d" % (1000 + number) for number in range(count)) + b"\n"
    b = bench(protocol="matrix", description="matrix_square")
    b.skin.lines[0].say(b"the rest of a line\n")

    def a_second_later() -> None:
        end_s = time.monotonic() + 1.0
        wait_until(lambda: time.monotonic() >= end_s)

    def frames_of(sent: int) -> bool:
        return bool(b.ask("status")["frames"] >= sent)

    said_s, longest_s = [], 0.0
    for sent in range(1, 5):
        a_second_later()
        said_s.append(time.monotonic())
        b.skin.lines[0].say(line)
        wait_until(partial(frames_of, sent))
        longest_s = max(longest_s, time.monotonic() - said_s[-2:][0])
    a_second_later()  # longer than others are given
    status = b.ask("status")
    assert (status["state"], status["ports"][0]["state"]) == ("running", "running")
    assert status["rates"]["frames_hz"] > 0.0
    assert [e["name"] for e in b.listener.of("event")] == ["tared"]
    told = re.search(r"nothing came for (\S+) s or", b.listener.event("device_silent")["detail"])
    assert told
    assert 2.99 < float(told[1]) < LATE_PERIODS * longest_s + 0.01
    assert b.ask("status")["ports"][0]["state"] == "silent"


# Noise


def test_a_device_that_does_not_listen_is_heard_all_the_same(line: Any, connect: Connect) -> None:
    connection = connect(line.path)
    connection.open()
    wait_until(lambda: not connection.write(bytes(1000)))  # what it does not read fills the line
    assert connection.is_open
    line.say(b"still here")
    assert connection.read() == b"still here"

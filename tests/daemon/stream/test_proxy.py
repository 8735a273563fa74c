"""The proxy of `tactomo daemon robot.toml`: the streams of several daemons at one address."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hostile_page import SUBSCRIBE, post
from logged_process import LoggedProcess, next_of
from tactomo_client.fake import FakeSensor
from tactomo_client.messages import decode_message, topic
from waiting import PATIENCE_S, wait_until

PROGRAM = """
import sys
from tactomo.log import configure_logging
from tactomo.stream.proxy import Proxy, serve
configure_logging("info", "json")
serve(Proxy(sys.argv[1:], "tcp://127.0.0.1:0"))
"""


@pytest.fixture
def proxy() -> Iterator[Callable[..., LoggedProcess]]:
    started: list[LoggedProcess] = []

    def start(*sensors: FakeSensor) -> LoggedProcess:
        started.append(LoggedProcess("-c", PROGRAM, *(each.address for each in sensors)))
        return started[-1]

    yield start
    for running in started:
        running.end()


def test_all_sensors_are_at_one_address(
    left: FakeSensor, right: FakeSensor, proxy: Callable[..., LoggedProcess], reader: Any
) -> None:
    address = proxy(left, right).address
    every = reader(address, b"")
    one = reader(address, topic("right", "contacts"))
    seen: set[tuple[str, str]] = set()
    while seen != {("left", "map"), ("left", "contacts"), ("right", "map"), ("right", "contacts")}:
        left.publish()
        right.publish()
        while every.poll(20):
            message = decode_message(every.recv())
            seen.add((message.sensor, message.kind))
    message = next_of(one, right.publish)
    assert (message.sensor, message.kind) == ("right", "contacts")
    while one.poll(0):
        assert decode_message(one.recv()).sensor == "right"


def test_a_daemon_is_asked_for_what_somebody_wants_and_no_longer(
    left: FakeSensor, proxy: Callable[..., LoggedProcess], reader: Any
) -> None:
    address = proxy(left).address
    wanted = topic("left", "contacts")
    first, second = reader(address, wanted), reader(address, wanted)
    assert left.wait_for_subscriber(PATIENCE_S) == wanted
    next_of(first, left.publish)
    next_of(second, left.publish)
    first.close()
    second.close()
    assert left._socket.poll(int(PATIENCE_S * 1000))
    assert left._socket.recv() == b"\0" + wanted  # asked once, and given back once
    assert not left._socket.poll(100)


def test_late_joiners_get_the_last_status_at_once(
    left: FakeSensor, proxy: Callable[..., LoggedProcess], reader: Any
) -> None:
    address = proxy(left).address
    status = topic("left", "status")
    first = reader(address, status)
    left.wait_for_subscriber(PATIENCE_S)

    def repeated() -> int:
        left.publish_message("status", {"state": "running"})
        sequence: int = next_of(first).fields["sequence"]
        late = reader(address, status)
        # It is repeated for 3 s; a joiner whom a busy computer holds up for longer gets none.
        if not late.poll(2000):
            return 0
        assert decode_message(late.recv()).fields["sequence"] == sequence
        return sequence

    sequence = wait_until(repeated, "a status at once")
    everything = reader(address, b"")  # a new prefix: the daemon itself is asked
    assert left.wait_for_subscriber(PATIENCE_S) == b""
    left.publish_message("status", {"state": "running"})
    assert next_of(everything).fields["sequence"] in (sequence, sequence + 1)


@pytest.mark.slow
def test_a_status_of_a_daemon_that_is_gone_is_not_repeated(
    left: FakeSensor, proxy: Callable[..., LoggedProcess], reader: Any
) -> None:
    address = proxy(left).address
    first = reader(address, topic("left", "status"))
    left.wait_for_subscriber(PATIENCE_S)
    left.publish_message("status", {"state": "running"})
    next_of(first)

    def is_silent() -> bool:
        with reader(address, topic("left", "status")) as late:
            return not late.poll(500)

    wait_until(is_silent, "a status too old to be repeated")


def test_a_daemon_may_come_and_go(
    tmp_path: Path, proxy: Callable[..., LoggedProcess], reader: Any
) -> None:
    with FakeSensor("left", f"ipc://{tmp_path}/left") as left:  # a port may be another's meanwhile
        socket = reader(proxy(left).address, topic("left", "contacts"))
        first = next_of(socket, left.publish).fields["session"]
    with FakeSensor("left", left.address) as again:
        while next_of(socket, again.publish).fields["session"] == first:
            pass


@pytest.mark.slow
def test_a_source_that_never_answered_is_missed_once(
    tmp_path: Path, proxy: Callable[..., LoggedProcess]
) -> None:
    with FakeSensor("left", f"ipc://{tmp_path}/left") as left:  # a port may be another's meanwhile
        pass
    running = proxy(left)
    warning = running.said("source_silent")
    assert f"nothing from {left.address}" in warning["detail"]
    assert "start its daemon" in warning["next_step"]
    with FakeSensor("left", left.address):
        assert left.address in running.said("source_came")["detail"]


@pytest.mark.slow
def test_a_slow_subscriber_slows_nobody(
    left: FakeSensor, proxy: Callable[..., LoggedProcess], reader: Any
) -> None:
    running = proxy(left)
    stalled = reader(running.address, topic("left", "map"))
    next_of(stalled, left.publish)  # and reads no more
    import numpy as np

    image = np.zeros((400, 400), np.float32)
    healthy = reader(running.address, topic("left", "map"))
    next_of(healthy, left.publish)
    for _ in range(600):  # 384 MB: more than any buffer holds
        left.publish(map=image)
        newest = next_of(healthy).fields["sequence"]
    assert newest >= 600
    resident = Path(f"/proc/{running.process.pid}/statm").read_text().split()[1]
    assert int(resident) * os.sysconf("SC_PAGE_SIZE") < 400e6


def test_two_daemons_of_one_name_are_warned_of(
    left: FakeSensor, proxy: Callable[..., LoggedProcess], reader: Any
) -> None:
    with FakeSensor("left") as other:
        running = proxy(left, other)
        socket = reader(running.address, b"")
        next_of(socket, left.publish)
        next_of(socket, other.publish)
        for _ in range(50):
            left.publish()
            other.publish()
            next_of(socket)
        warning = running.said("same_sensor_twice")
        assert left.address in warning["detail"]
        assert other.address in warning["detail"]
        assert "another name" in warning["next_step"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it(
    left: FakeSensor, proxy: Callable[..., LoggedProcess], number: signal.Signals
) -> None:
    running = proxy(left)
    running.process.send_signal(number)
    assert running.process.wait(PATIENCE_S) == 0
    assert running.process.stderr is not None
    assert "Traceback" not in running.process.stderr.read()


def test_a_web_pages_subscription_gets_nothing(
    proxy: Callable[..., LoggedProcess], reader: Callable[..., Any], left: FakeSensor
) -> None:
    running = proxy(left)
    socket = reader(running.address, b"left/")
    wait_until(
        lambda: socket.poll(0),
        meanwhile=lambda: left.publish_message("status", {"state": "running"}),
    )
    assert b"left" not in post(running.address, [SUBSCRIBE + b"left/"])

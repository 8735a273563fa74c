"""Messages of too many parts, messages without an end, floods: nobody waits, memory is bounded."""

from __future__ import annotations

import os
import pty
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
import zmq
from daemon_process import DaemonProcess
from ears import Ears
from tactomo_client.messages import encode_request
from waiting import PATIENCE_S, wait_until

PART, LAST = b"\x01\x01x", b"\x00\x01x"
PARTS = 1_000_000
MAX_GROWN_MB = 500.0
"""What one connection can send until it is looked at on a busy computer; alone, 50 to 250 MB."""
MAX_KEPT_MB = 100.0


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DaemonProcess]:
    """One for all who are cut: it is to outlive them."""
    device, host = pty.openpty()
    process = DaemonProcess(tmp_path_factory.mktemp("daemon"), [os.ttyname(host)])
    yield process
    process.kill()
    for descriptor in (device, host):
        os.close(descriptor)


@contextmanager
def peer(address: str, kind: bytes) -> Iterator[socket.socket]:
    """Connect as a ZeroMQ socket of some kind does, and send what one likes."""
    where = urlsplit(address)
    name = b"\x0bSocket-Type" + struct.pack(">I", len(kind)) + kind
    with socket.create_connection((where.hostname, where.port or 0)) as line:
        line.sendall(b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32))
        line.sendall(bytes([4, 6 + len(name)]) + b"\5READY" + name)
        greeted = b""
        while b"READY" not in greeted:
            greeted += line.recv(4096)
        yield line


@pytest.mark.slow
@pytest.mark.parametrize("parts", [PARTS, 4 * PARTS])
def test_a_message_of_a_million_parts_holds_up_nobody(daemon: DaemonProcess, parts: int) -> None:
    most_s = 0.0
    with peer(daemon.control, b"DEALER") as line:
        with suppress(ConnectionError):
            line.sendall(PART * (parts - 1) + LAST)
        end_s = time.monotonic() + 3.0
        while time.monotonic() < end_s:
            begin_s = daemon.cpu_s
            daemon.status()
            most_s = max(most_s, daemon.cpu_s - begin_s)
    # Of the processor, where its parts are in before it is cut; uncut, without end.
    assert most_s < 5.0


@pytest.mark.parametrize(("socket_name", "kind"), [("control", b"DEALER"), ("stream", b"SUB")])
@pytest.mark.parametrize("size", [1, pytest.param(1000, marks=pytest.mark.slow)])
def test_a_message_without_an_end_is_cut(
    daemon: DaemonProcess, socket_name: str, kind: bytes, size: int
) -> None:
    before_mb, highest_mb = daemon.rss_mb, 0.0
    part = PART if size == 1 else struct.pack(">BQ", 3, size) + bytes(size)
    portion = part * (60_000 // len(part))
    with peer(getattr(daemon, socket_name), kind) as line:
        line.settimeout(PATIENCE_S)
        with suppress(ConnectionError):
            for _ in range(1000):  # 60 MB, which would take 1.2 GB
                line.sendall(portion)
                highest_mb = max(highest_mb, daemon.rss_mb)
            while line.recv(4096):
                pass
    assert "connection_cut" in daemon.status()["events"]["counts"]
    wait_until(lambda: daemon.rss_mb - before_mb < MAX_KEPT_MB, "memory to be given back")
    assert highest_mb - before_mb < MAX_GROWN_MB


def test_who_asks_a_lot_and_reads_the_answers_is_not_cut(daemon: DaemonProcess) -> None:
    dealer: Any = zmq.Context.instance().socket(zmq.DEALER)
    cut = dealer.get_monitor_socket(zmq.EVENT_DISCONNECTED)
    dealer.setsockopt(zmq.LINGER, 0)
    dealer.connect(daemon.control)
    padding = "x" * 50_000
    for _ in range(200):  # 10 MB
        dealer.send_multipart([b"", encode_request("status", {})])
        dealer.send_multipart([b"", encode_request(padding, {})])
        for _ in range(2):
            assert dealer.poll(30_000)
            dealer.recv_multipart()
    assert not cut.poll(0)
    dealer.disable_monitor()
    cut.close()
    dealer.close()


@pytest.mark.slow
def test_a_flood_of_subscriptions_is_cut_and_the_stream_goes_on(bench: Callable[..., Any]) -> None:
    b = bench().tare()
    flood: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.XSUB)
    with flood:
        flood.setsockopt(zmq.LINGER, 0)
        flood.connect(b.daemon.stream_address)
        for number in range(60_000):
            flood.send(b"\1" + b"%090d" % number)

    def status() -> dict[str, Any]:
        b.listener.receive()  # ZeroMQ renews subscriptions in the subscriber's own calls alone
        now: dict[str, Any] = b.ask("status")
        assert now["subscribers"] < 60_000  # never all of it
        return now

    # Counted, for who listens may be away when it is told.
    b.until(lambda: "subscribers_cut" in status()["events"]["counts"])
    b.until(lambda: status()["subscribers"] == 5)
    assert b.step(0.1)["map"] is not None


@pytest.mark.long
def test_a_flood_of_connections_leaves_the_daemon_running(tmp_path: Path) -> None:
    """With no descriptor left for anything else: 300 that say nothing, of 128 that there may be.

    Not over ``ipc://``, where libzmq 4.3.5 itself aborts when there is none left.
    """
    device, host = pty.openpty()
    daemon = DaemonProcess(tmp_path, [os.ttyname(host)], under=("prlimit", "--nofile=128:128"))
    address = urlsplit(daemon.stream)
    silent = [socket.socket() for _ in range(300)]
    try:
        with Ears(daemon.stream, kinds=("status",)) as ears:
            ears.wait(lambda _: True, "a status")
            for each in silent:
                each.setblocking(False)
                each.connect_ex((address.hostname, address.port))
            wait_until(lambda: daemon.descriptors == 128, "no descriptor to be left", step_s=0.001)
            ears.wait(lambda _: True, "a later status", since=len(ears.heard))
        assert daemon.is_running
        for each in silent:
            each.close()
        wait_until(daemon.answers, "an answer")
        daemon.stop()
    finally:
        daemon.kill()
        for descriptor in (device, host):
            os.close(descriptor)

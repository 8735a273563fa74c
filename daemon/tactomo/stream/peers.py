"""Bounds on what the peers of a bound socket may send: parts of a message, and bytes without one.

ZeroMQ bounds a part and counts messages, but takes in a message's parts without end, each at twenty
times its size. So a message of many parts is thrown away in small portions, and a connection that
sends more bytes than whole messages can account for is cut. That goes by what the kernel says of
TCP connections; who may open an ``ipc://`` file is trusted so far.
"""

from __future__ import annotations

import contextlib
import os
import socket as posix
import struct
import time
from typing import Final, NamedTuple

import zmq
from zmq.utils.monitor import parse_monitor_message

from tactomo.endpoint import bind, remove_file
from tactomo.errors import AddressError
from tactomo.events import OnEvent

MAX_PARTS: Final = 8  # of a request: identity, empty part, body; and what a few proxies add
DISCARDED_AT_ONCE: Final = 10_000  # parts: some 10 ms
CHECK_MS: Final = 50  # how often connections are looked at: what comes of one meanwhile is memory
MAX_UNREAD_BYTES: Final = 2 << 20
HEARTBEAT_BYTES_S: Final = 100.0
"""What a connection sends that says nothing: heartbeats each second, under CURVE."""
TCP_INFO_BYTES: Final = 136
RECEIVED_AT: Final = 128  # of `tcpi_bytes_received` in Linux's `struct tcp_info`


class _Connection(NamedTuple):
    read_bytes: int
    read_s: float


class Peers:
    """The connections of a socket, which it binds; for the socket's thread.

    Arguments and errors are those of `tactomo.endpoint.bind`; `on_event` is told of who was cut.
    """

    def __init__(
        self,
        socket: zmq.Socket[bytes],
        endpoint: str,
        purpose: str,
        on_event: OnEvent,
        secret: bytes | None = None,
        option: str = "",
    ) -> None:
        self._socket = socket
        self._purpose = purpose
        self._on_event = on_event
        # readable when a connection comes or goes
        self.monitor = socket.get_monitor_socket(zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED)
        self._connections: dict[int, _Connection] = {}  # by descriptor
        self._is_discarding = False
        try:
            self.address = bind(socket, endpoint, purpose, secret=secret, option=option)
        except AddressError:
            self.monitor.close(0)
            raise

    def receive(self) -> list[bytes] | None:
        """Return a message that is there; None for one of too many parts, or a part of it."""
        if self._is_discarding:
            self._discard()
            return None
        first = self._socket.recv(copy=False)
        try:
            descriptor = first.get(zmq.SRCFD)
        except zmq.ZMQError:  # libzmq knows none of a peer of ZMTP 1.0
            descriptor = None
        if descriptor in self._connections:
            self._connections[descriptor] = _state(_received(descriptor) or 0)
        parts = [first.bytes]
        while self._socket.rcvmore and len(parts) < MAX_PARTS:
            parts.append(self._socket.recv())
        self._is_discarding = bool(self._socket.rcvmore)
        return None if self._is_discarding else parts

    def wait_ms(self, longest_ms: int) -> int:
        """Return how long to wait at most before `check`, unless `monitor` is readable earlier."""
        return min(CHECK_MS, longest_ms) if self._connections else longest_ms

    def check(self) -> None:
        """Cut who sends on and on without a message; to be called several times a second."""
        while self.monitor.poll(0):
            event = parse_monitor_message(self.monitor.recv_multipart())
            self._connections.pop(event["value"], None)
            if event["event"] == zmq.EVENT_ACCEPTED:
                self._connections[event["value"]] = _state(0)
        for descriptor, (read_bytes, read_s) in list(self._connections.items()):
            received = _received(descriptor)
            allowed = MAX_UNREAD_BYTES + HEARTBEAT_BYTES_S * (time.monotonic() - read_s)
            if received is None:
                del self._connections[descriptor]
            elif received - read_bytes > allowed:
                del self._connections[descriptor]
                self._cut(descriptor, received - read_bytes)

    def close(self) -> None:
        """Watch no more, and remove the file of an ``ipc://`` address; before the socket closes."""
        remove_file(self.address)
        self._socket.disable_monitor()
        self.monitor.close(0)

    def _discard(self) -> None:
        for _ in range(DISCARDED_AT_ONCE):
            # Frames know whether more follow; to ask the socket takes twice as long again.
            if not self._socket.recv(copy=False, track=False).more:
                self._is_discarding = False
                return

    def _cut(self, descriptor: int, unread: int) -> None:
        with contextlib.suppress(OSError), _borrowed(descriptor) as connection:
            peer = connection.getpeername()
            # ZeroMQ sees its end, throws away what it has of it, and closes it: with a reset.
            connection.setsockopt(posix.SOL_SOCKET, posix.SO_LINGER, struct.pack("ii", 1, 0))
            connection.shutdown(posix.SHUT_RDWR)
            self._on_event(
                "connection_cut",
                f"{peer[0]} port {peer[1]} sent {unread * 1e-6:.1f} MB to the {self._purpose} "
                "that made no message",
                "find the program that does this",
            )


def _state(received: int) -> _Connection:
    return _Connection(received, time.monotonic())


def _received(descriptor: int) -> int | None:
    """Return the bytes that the kernel has received on a TCP connection; None for no such one."""
    try:
        with _borrowed(descriptor) as connection:
            info = connection.getsockopt(posix.IPPROTO_TCP, posix.TCP_INFO, TCP_INFO_BYTES)
    except OSError:  # closed meanwhile, or not TCP
        return None
    return (
        None if len(info) < TCP_INFO_BYTES else int(struct.unpack_from("=Q", info, RECEIVED_AT)[0])
    )


def _borrowed(descriptor: int) -> posix.socket:
    """Return a socket of ours on ZeroMQ's descriptor."""
    return posix.socket(fileno=os.dup(descriptor))

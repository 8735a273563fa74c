"""Bounds on what the peers of a bound socket may send: parts, bytes and subscriptions.

ZeroMQ bounds a part and counts messages, but takes in a message's parts without end, each at twenty
times its size. So a message of many parts is thrown away in small portions, and a connection that
sends more bytes than whole messages can account for is cut. That goes by what the kernel says of
TCP connections; who may open an ``ipc://`` file is trusted so far.

ZeroMQ takes as many subscriptions as anybody sends, too, and cannot drop one peer. So they are read
a few at a time, between messages, and beyond the bound every connection is cut: sane subscribers
come back by themselves and send theirs again, a flood begins at nothing.
"""

from __future__ import annotations

import contextlib
import os
import socket as posix
import struct
import time
from collections import Counter
from collections.abc import Iterator
from typing import Final, NamedTuple

import zmq
from zmq.utils.monitor import parse_monitor_message

from tactomo.endpoint import bind, rebind, remove_file
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


MAX_PREFIX_BYTES: Final = 1024
MAX_BYTES: Final = 1 << 20
"""Of all subscriptions, each counted with its length and OVERHEAD_BYTES: some 10,000 of them."""
OVERHEAD_BYTES: Final = 64
MAX_READ_AT_ONCE: Final = 2000
MAX_WAITING: Final = 10 * MAX_READ_AT_ONCE
CUT_PERIOD_S: Final = 0.25  # time for the ends of all subscriptions to be read
SUBSCRIBERS_CUT: Final = (
    "too many subscriptions: every connection was cut",
    "find the client that subscribes so often; other clients reconnect by themselves",
)


class Subscribers:
    """A bound XPUB socket's subscribers. Belongs to the socket's thread."""

    def __init__(
        self,
        socket: zmq.Socket[bytes],
        endpoint: str,
        purpose: str,
        on_event: OnEvent,
        secret: bytes | None = None,
        option: str = "",
    ) -> None:
        # Every subscription and its end is reported, not only the first and the last of many.
        socket.setsockopt(zmq.XPUB_VERBOSER, 1)
        # ZeroMQ takes in at one go all that is there: few of each peer, or a flood has no end. (Of
        # 1, libzmq 4.3.5 makes a peer that is never heard after a CURVE handshake.)
        socket.setsockopt(zmq.RCVHWM, 16)
        socket.setsockopt(zmq.MAXMSGSIZE, MAX_PREFIX_BYTES)
        self.peers = Peers(socket, endpoint, purpose, on_event, secret, option)  # the connections
        self.prefixes: Counter[bytes] = Counter()  # how many ask for each prefix
        self.cuts = 0  # how often all of them were cut off because there were too many
        self._socket = socket
        self._bytes = 0
        self._passes = 0  # that found no end, one after the other
        self._cut_at_s = 0.0

    def changes(self) -> Iterator[tuple[bool, bytes]]:
        """Yield what came since the last call, a bounded number: (joins or leaves, prefix)."""
        for _ in range(MAX_READ_AT_ONCE):
            if not self._socket.poll(0):
                self._passes = 0
                break
            message = self._socket.recv()
            if message[:1] in (b"\0", b"\1"):
                yield self._count(message[:1] == b"\1", message[1:])
        else:
            self._passes += 1
        is_flood = self._bytes > MAX_BYTES or self._passes * MAX_READ_AT_ONCE > MAX_WAITING
        if is_flood and time.monotonic() >= self._cut_at_s:
            self._passes = 0
            self._cut_at_s = time.monotonic() + CUT_PERIOD_S
            self.cuts += 1
            self.cut()

    def cut(self) -> None:
        """End every connection; those who may come back do so by themselves."""
        rebind(self._socket, self.peers.address)

    def _count(self, joins: bool, prefix: bytes) -> tuple[bool, bytes]:
        change = 1 if joins else -1
        self._bytes += change * (len(prefix) + OVERHEAD_BYTES)
        self.prefixes[prefix] += change
        if self.prefixes[prefix] <= 0:
            del self.prefixes[prefix]
        return joins, prefix

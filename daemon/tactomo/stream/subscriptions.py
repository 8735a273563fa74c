"""What the subscribers of an XPUB socket ask for, within bounds.

ZeroMQ takes as many subscriptions as anybody sends, keeps each in memory, and cannot drop one peer.
So they are read a few at a time, between messages, and beyond the bound every connection is cut:
sane subscribers come back by themselves and send theirs again, a flood begins at nothing.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from typing import Final

import zmq

from tactomo.endpoint import rebind
from tactomo.events import OnEvent
from tactomo.stream.peers import Peers

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

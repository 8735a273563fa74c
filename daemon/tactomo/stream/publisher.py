"""The publisher thread: the only one that touches the stream's socket.

Whoever publishes encodes the message, has it recorded, and hands its bytes over by a queue; a pipe
wakes the thread, so that it can wait for them and for subscriptions at once. It never waits for a
subscriber: what does not fit into a slow one's queue is lost to that one alone.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import zmq
from tactomo_client import MessageError
from tactomo_client.messages import CONTACTS, EVENT, STATUS, clock_id, encode_message, topic
from tactomo_client.schema import Envelope, wire_fields

from tactomo.events import OnEvent
from tactomo.stream.access_control import STREAM
from tactomo.stream.peers import SUBSCRIBERS_CUT, Subscribers
from tactomo.timing import Durations
from tactomo.worker import Wakeup, Worker

STATUS_PERIOD_S: Final = 1.0
LINGER_MS: Final = 200  # how long messages that were sent may take to leave when the daemon stops
QUEUED_PER_SUBSCRIBER: Final = 64
MAX_QUEUED: Final = 1024


NO_FRAME_YET: Final[dict[str, Any]] = {
    **dict.fromkeys(wire_fields(Envelope)[2:]),  # after session and sequence
    "flags": [],
}


@dataclass(eq=False)
class Publisher(Worker):
    """Numbers, stamps and sends messages; publishes the status every second, or when asked to.

    Scans and frames are published by one thread, the pipeline's.

    `open` it, `start` its thread, `stop` it.
    """

    _sensor: str  # the name in every topic
    _session: str  # identity of this run of the daemon
    # returns the current fields of a `status` message with that header; called by the thread
    _status: Callable[[Mapping[str, Any]], Mapping[str, Any]]
    # called with kind and bytes of each frame's message, before it is sent: whatever was seen is in
    # the recording
    _on_frame: Callable[[str, bytes], None]
    _on_event: OnEvent  # told of a flood of subscriptions, and of messages that cannot be sent

    def __post_init__(self) -> None:
        super().__init__("publisher")
        self.address = ""  # where it is bound, once open
        self.subscribers = 0  # subscriptions in force
        # that of the newest frame that could be sent; it goes with status and events, too. This
        # and `latency` are written by the thread that publishes frames
        self.header: Mapping[str, Any] = NO_FRAME_YET
        # from the last byte of a dual scan until its contacts are handed over
        self.latency = Durations()
        self._sequence: Counter[str] = Counter()  # the last one of each kind, under _lock
        self._lock = threading.Lock()
        self._readers: Subscribers  # this thread's own, as are _socket and _cuts_*
        self._cuts_seen = self._cuts_told = 0
        self._prefixes: frozenset[bytes] = frozenset()  # a copy for the other threads
        self._last_status = b""
        self._queue: deque[bytes] = deque(maxlen=MAX_QUEUED)
        self._cut = threading.Event()
        self._status_asked = threading.Event()
        self._socket: zmq.Socket[bytes]
        self._wakeup: Wakeup | None = None  # until it is open

    def open(
        self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str, secret: bytes | None = None
    ) -> None:
        """Bind the stream's socket; raise AddressError where the address cannot be had."""
        self._socket = context.socket(zmq.XPUB)
        self._socket.setsockopt(zmq.SNDHWM, QUEUED_PER_SUBSCRIBER)
        self._readers = Subscribers(self._socket, endpoint, STREAM, self._on_event, secret)
        self.address = self._readers.peers.address
        self._wakeup = Wakeup()

    def _close(self) -> None:
        self._readers.peers.close()
        self._socket.close(LINGER_MS)
        if self._wakeup is not None:
            self._wakeup.close()

    def cut_connections(self) -> None:
        """Have every subscriber connect anew, those who still may; for any thread."""
        self._cut.set()
        self._wake()

    def tell_status(self) -> None:
        """Have the status published now, after what was handed over before; for any thread."""
        self._status_asked.set()
        self._wake()

    def wants(self, kind: str) -> bool:
        """Whether anybody subscribes to this kind of message; for any thread."""
        name = topic(self._sensor, kind)
        return any(name.startswith(prefix) for prefix in self._prefixes)

    def publish(
        self,
        kind: str,  # one of the stream's kinds
        fields: Mapping[str, Any],  # the kind's own
        # acquisition, tier, flags and misfit; by default the newest frame's
        header: Mapping[str, Any] | None = None,
    ) -> None:
        """Hand over a message; for any thread, and never waits."""
        self._hand_over(kind, fields, self.header if header is None else header)
        if not self._stopping.is_set():
            self._wake()

    def lift(self, flag: str) -> None:
        """Leave out a flag of the newest frame's from now on; for the thread of the frames."""
        left = [each for each in self.header["flags"] if each != flag]
        self.header = {**self.header, "flags": left}

    def envelope(self, kind: str) -> dict[str, Any]:
        """Return the envelope of the last message of a kind as of now; for any thread."""
        return self._stamp(self._sequence[kind], self.header)

    def _hand_over(self, kind: str, fields: Mapping[str, Any], header: Mapping[str, Any]) -> bytes:
        """Encode a message into the queue and return it; empty for one that breaks STREAM.md.

        Its sequence number tells that it was left out, or lost to a queue that is full.
        """
        try:
            with self._lock:  # messages of a kind are queued in the order of their numbers
                self._sequence[kind] += 1
                envelope = self._stamp(self._sequence[kind], header)
                data = encode_message(self._sensor, kind, {**envelope, **fields})
                if kind not in (STATUS, EVENT):
                    self._on_frame(kind, data)
                self._queue.append(data)
        except MessageError as error:
            self._on_event(
                "message_unsent",
                f"a {kind} message was left out: {error}",
                "this is a mistake in tactomo: please report it with a recording",
            )
            return b""
        if kind == CONTACTS:
            self.header = header
            if envelope["age_ns"] is not None:
                self.latency.add((envelope["age_ns"] - envelope["delay_ns"]) * 1e-9)
        return data

    def _stamp(self, sequence: int, header: Mapping[str, Any]) -> dict[str, Any]:
        acquired_ns = header["acquired_monotonic_ns"]
        return {
            "session": self._session,
            "sequence": sequence,
            **header,
            "clock_id": clock_id(),
            "age_ns": None if acquired_ns is None else time.monotonic_ns() - acquired_ns,
        }

    def _run(self) -> None:
        poller = zmq.Poller()
        poller.register(self._socket, zmq.POLLIN)
        assert self._wakeup is not None
        poller.register(self._wakeup.reader, zmq.POLLIN)
        poller.register(self._readers.peers.monitor, zmq.POLLIN)
        status_at_s = time.monotonic()
        while not self._stopping.is_set():
            status_in_ms = math.ceil(max(0.0, status_at_s - time.monotonic()) * 1e3)
            self._readers.peers.check()
            for ready, _ in poller.poll(self._readers.peers.wait_ms(status_in_ms)):
                if ready is self._socket:
                    self._read_subscriptions()
                elif ready == self._wakeup.reader.fileno():
                    self._wakeup.drain()
            self._send_queued()
            if self._cut.is_set():
                self._cut.clear()
                self._readers.cut()
            if self._status_asked.is_set():
                self._status_asked.clear()
                self._send_status()
            if time.monotonic() >= status_at_s:
                status_at_s += STATUS_PERIOD_S
                self._send_status()
                self._tell_cuts()
                self.turns += 1
        self._send_queued()

    def _send_queued(self) -> None:
        while self._queue:
            self._socket.send(self._queue.popleft(), zmq.DONTWAIT)

    def _send_status(self) -> None:
        header = self.header
        self._last_status = self._hand_over(STATUS, self._status(header), header)
        self._send_queued()

    def _tell_cuts(self) -> None:
        """Tell that subscribers were cut off, a second later: then they are back to hear it."""
        if self._cuts_seen > self._cuts_told:
            self._cuts_told = self._cuts_seen
            self._on_event("subscribers_cut", *SUBSCRIBERS_CUT)
        self._cuts_seen = self._readers.cuts

    def _read_subscriptions(self) -> None:
        """Take note of who comes and goes; a newcomer to the status gets the last one at once."""
        status, repeat = topic(self._sensor, STATUS), False
        for joins, prefix in self._readers.changes():
            repeat = repeat or (joins and status.startswith(prefix))
        self._prefixes = frozenset(self._readers.prefixes)
        self.subscribers = self._readers.prefixes.total()
        if repeat and self._last_status:
            self._socket.send(self._last_status, zmq.DONTWAIT)

    def _wake(self) -> None:
        if self._wakeup is not None:
            self._wakeup.set()

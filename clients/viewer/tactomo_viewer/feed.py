"""What the daemon said last: the newest frame, the newest status and the recent events."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zmq
import zmq.asyncio
from tactomo_client import Frame, Keys, MessageError
from tactomo_client.frame import frame_from_message
from tactomo_client.messages import EVENT, MAP, STATUS, decode_message, topic
from tactomo_client.subscription import connect_subscriber, reconnect

STALE_AFTER_S = 0.5
EVENTS_KEPT = 100
SILENCE_MS = 5000
"""After such a silence (a status comes every second) the connection is made anew."""


@dataclass(frozen=True)
class Status:
    """One `status` message; `age_s` counts from its arrival."""

    fields: dict[str, Any]
    received_ns: int

    @property
    def age_s(self) -> float:
        """Seconds since it arrived."""
        return (time.monotonic_ns() - self.received_ns) * 1e-9


@dataclass(frozen=True)
class Event:
    """One `event` message, numbered as it came."""

    number: int
    fields: dict[str, Any]


class Feed:
    """Reads one sensor's stream. `on_change` is called after each message that was taken in.

    Attributes:
        frame: the newest frame, or None before the first.
        status: the newest status, or None before the first.
        events: the recent events, oldest first.
        malformed: messages that were skipped because they broke the rules.

    Raises:
        MessageError: `sensor` cannot be a sensor's name.
        ControlError: `address` is not an address.

    """

    def __init__(
        self, sensor: str, address: str, keys: Keys | None, on_change: Callable[[], None]
    ) -> None:
        self.frame: Frame | None = None
        self.status: Status | None = None
        self.events: deque[Event] = deque(maxlen=EVENTS_KEPT)
        self.malformed = 0
        self._events_seen = 0
        self._on_change = on_change
        topics = [topic(sensor, kind) for kind in (MAP, STATUS, EVENT)]
        self._socket = zmq.asyncio.Context.instance().socket(zmq.SUB)
        self._address = address
        connect_subscriber(self._socket, address, topics, keys=keys)

    async def run(self) -> None:
        """Read until cancelled, then close the socket."""
        with self._socket:
            while True:
                if await self._socket.poll(SILENCE_MS):
                    self._take(await self._socket.recv(), time.monotonic_ns())
                else:  # ZeroMQ does not knock again where a key was refused
                    reconnect(self._socket, self._address)

    def _take(self, data: bytes, received_ns: int) -> None:
        try:
            message = decode_message(data)
            if message.kind == MAP:
                self.frame = frame_from_message(message, received_ns, STALE_AFTER_S)
            elif message.kind == STATUS:
                self.status = Status(message.fields, received_ns)
            else:
                self._events_seen += 1
                self.events.append(Event(self._events_seen, message.fields))
        except MessageError:
            self.malformed += 1
            return
        self._on_change()

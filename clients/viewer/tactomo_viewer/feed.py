"""What the daemon said last: the newest frame, the newest status and the recent events."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from tactomo_client import Event, Frame, Keys, KeysError, Status, aio

EVENTS_KEPT = 100


class Heard(NamedTuple):
    """An event as it came."""

    number: int  # from 1
    heard_s: float  # monotonic: its envelope has the time of the newest dual scan
    event: Event


class Feed:
    """Reads one sensor's stream. `on_change` is called after each message that was taken in.

    Raises MessageError where `sensor` cannot be a name, ControlError where `address` is none.
    """

    def __init__(
        self, sensor: str, address: str, keys: Keys | None, on_change: Callable[[], None]
    ) -> None:
        self.frame: Frame | None = None  # the newest frame, or None before the first
        self.status: Status | None = None  # the newest status, or None before the first
        self.events: deque[Heard] = deque(maxlen=EVENTS_KEPT)  # the recent ones, oldest first
        self._events_seen = 0
        self._on_change = on_change
        self._news = aio.subscribe(
            sensor, address=address, kind=("map", "status", "event"), keys=keys
        )

    async def run(self) -> None:
        """Read until cancelled, then close the subscription."""
        async with self._news:
            while True:
                try:
                    self._take(await anext(self._news))
                except KeysError:  # it knocks again by itself; the page shows the silence
                    continue

    def _take(self, item: Frame | Status | Event) -> None:
        if isinstance(item, Frame):
            self.frame = item
        elif isinstance(item, Status):
            self.status = item
        else:
            self._events_seen += 1
            self.events.append(Heard(self._events_seen, time.monotonic(), item))
        self._on_change()

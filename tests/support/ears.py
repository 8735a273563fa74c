"""A subscriber that keeps what it hears and when, from a thread of its own."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import zmq
from tactomo_client import Keys
from tactomo_client.keys import secure
from tactomo_client.messages import decode_message, topic
from waiting import PATIENCE_S, InThread, wait_until


@dataclass(frozen=True, slots=True)
class Heard:
    """One message and its arrival."""

    kind: str
    arrived_ns: int
    fields: dict[str, Any]

    @property
    def age_ms(self) -> float:
        """How old the data were when they arrived here."""
        return float((self.arrived_ns - self.fields["acquired_monotonic_ns"]) * 1e-6)

    @property
    def read_age_ms(self) -> float:
        """How long before publication their last byte was read."""
        return float((self.fields["age_ns"] - (self.fields["delay_ns"] or 0)) * 1e-6)

    @property
    def published_age_ms(self) -> float:
        """How old they were when they were published."""
        return float(self.fields["age_ns"] * 1e-6)


def listening(address: str, *topics: bytes, keys: Keys | None = None) -> zmq.Socket[bytes]:
    """Subscribe to topics; no message that comes is thrown away."""
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.SUB)
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.RCVHWM, 0)
    for each in topics:
        socket.setsockopt(zmq.SUBSCRIBE, each)
    secure(socket, address, keys)
    socket.connect(address)
    return socket


class Ears(InThread):
    """Hears `kinds` of one sensor until closed; usable in a `with` block."""

    def __init__(self, address: str, sensor: str = "skin", kinds: tuple[str, ...] = ("contacts",)):
        self.heard: list[Heard] = []
        self._socket = listening(address, *(topic(sensor, kind) for kind in kinds))
        super().__init__()

    def of(self, kind: str) -> list[Heard]:
        """Return what came of one kind so far."""
        return [heard for heard in list(self.heard) if heard.kind == kind]

    def wait(
        self,
        condition: Callable[[Heard], Any],
        what: str,
        since: int = 0,
        patience_s: float = PATIENCE_S,
    ) -> Heard:
        """Wait for a message from number `since` on that satisfies the condition."""

        def found() -> list[Heard]:
            nonlocal since
            while since < len(self.heard):
                since += 1
                if condition(self.heard[since - 1]):
                    return [self.heard[since - 1]]
            return []

        return wait_until(found, what, patience_s, step_s=0.002)[0]

    def _run(self) -> None:
        with self._socket as socket:
            while not self._closing.is_set():
                if socket.poll(50):
                    data = socket.recv()
                    arrived_ns = time.monotonic_ns()
                    message = decode_message(data)
                    self.heard.append(Heard(message.kind, arrived_ns, message.fields))


def percentiles(values: list[float]) -> str:
    """Say p50, p99 and p99.9 of some milliseconds, those that ten values exceed, and the worst."""
    shares = [share for share in (50, 99, 99.9) if len(values) * (100 - share) >= 1000]
    found = zip(shares, np.percentile(values, shares), strict=True)
    told = "".join(f"p{share:g} {value:.2f}, " for share, value in found)
    return f"{told}worst {max(values):.2f} ms"

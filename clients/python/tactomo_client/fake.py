"""A sensor for tests: a real socket that says what a test tells it to.

A controller is tested against it without a skin, a twin or a daemon::

    with FakeSensor("left_forearm") as sensor:
        frames = subscribe("left_forearm", address=sensor.address)
        sensor.wait_for_subscriber()
        sensor.publish([Contact(1, x_mm=10, y_mm=0, area_mm2=700, magnitude=0.1,
                                magnitude_sigma=0.01, pressure_kpa=170)])
        assert next(frames).contacts[0].x_mm == 10

To have something live to look at instead, run `tactomo demo`.
"""

from __future__ import annotations

import dataclasses
import time
import uuid
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Self

import zmq
from numpy.typing import NDArray

from tactomo_client.errors import checked_seconds
from tactomo_client.messages import CONTACTS, MAP, clock_id, encode_message
from tactomo_client.schema import Contact


class FakeSensor:
    """The stream of one sensor at `address`, an ephemeral port unless one is given."""

    def __init__(self, sensor: str, address: str = "tcp://127.0.0.1:*") -> None:
        self.sensor = sensor
        self.session = uuid.uuid4().hex
        self._sequences: Counter[str] = Counter()
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.XPUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.XPUB_VERBOSER, 1)
        self.address = bind_when_free(self._socket, address)

    def wait_for_subscriber(self, timeout_s: float = 10.0) -> bytes:
        """Wait until somebody subscribes and return the topic; raise TimeoutError otherwise.

        What is published before a subscriber is there is lost, as with every publisher.
        """
        deadline = time.monotonic() + checked_seconds("timeout_s", timeout_s, endless=False)
        while self._socket.poll(max(0, int((deadline - time.monotonic()) * 1000))):
            message = self._socket.recv()
            if message[:1] == b"\1":
                return message[1:]
        raise TimeoutError(f"nobody subscribed at {self.address} within {timeout_s:g} s")

    def publish(
        self,
        contacts: Sequence[Contact] = (),
        *,
        map: NDArray[Any] | None = None,
        pressure_kpa: NDArray[Any] | None = None,
        structure: NDArray[Any] | None = None,
        x_mm: tuple[float, float] = (-75.0, 75.0),
        y_mm: tuple[float, float] = (-75.0, 75.0),
        **changes: Any,
    ) -> None:
        """Publish one frame, as `map` and as `contacts`.

        Args:
            contacts: what is pressed.
            map: float32 image (ny, nx), as are `pressure_kpa` and `structure`.
            pressure_kpa: see `map`.
            structure: see `map`.
            x_mm: positions of the images' first and last column.
            y_mm: positions of the images' first and last row.
            **changes: fields to send otherwise than they would be, for example
                ``flags=["magnitude_missing"]`` or an old ``acquired_monotonic_ns``.
        """
        wire = [dataclasses.asdict(contact) for contact in contacts]
        images = {"map": map, "pressure_kpa": pressure_kpa, "structure": structure}
        extent = {"x_mm": x_mm, "y_mm": y_mm, "magnitude_max": 0.25}
        counter = {"scan_counter": self._sequences[MAP] + 1, "contacts": wire}
        self.publish_message(MAP, counter | images | extent | changes)
        self.publish_message(CONTACTS, counter | changes)

    def publish_message(self, kind: str, fields: Mapping[str, Any]) -> None:
        """Publish a message of any kind, `status` for example, with these fields and a header."""
        self._sequences[kind] += 1
        header = {
            "session": self.session,
            "sequence": self._sequences[kind],
            "acquired_realtime_ns": time.time_ns(),
            "acquired_monotonic_ns": time.monotonic_ns(),
            "clock_id": clock_id(),
            "device_us": time.monotonic_ns() // 1000,
            "age_ns": 0,
            "tier": "levelset",
            "tier_reason": "a fake sensor",
            "flags": [],
            "misfit": 1.0,
        }
        self.send(encode_message(self.sensor, kind, header | dict(fields)))

    def send(self, message: bytes) -> None:
        """Send bytes as they are, for example a malformed message."""
        self._socket.send(message)

    def close(self) -> None:
        """Stop publishing; the port becomes free in the background."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def bind_when_free(socket: zmq.Socket[bytes], address: str) -> str:
    """Bind and return where; waits up to 10 s for a port that a closed socket still gives back."""
    deadline = time.monotonic() + 10.0
    while True:
        try:
            socket.bind(address)
        except zmq.ZMQError:
            if time.monotonic() > deadline:
                socket.close()
                raise
            time.sleep(0.01)
        else:
            return socket.getsockopt_string(zmq.LAST_ENDPOINT).rstrip("\0")

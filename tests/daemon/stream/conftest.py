"""Subscribers of ZeroMQ, and two sensors that send what they are told to."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import zmq
from tactomo_client.fake import FakeSensor


@pytest.fixture
def reader() -> Iterator[Callable[..., zmq.Socket[bytes]]]:
    """Make a subscriber: ``reader(address, prefix)``."""
    sockets: list[zmq.Socket[bytes]] = []

    def make(address: str, *prefixes: bytes) -> zmq.Socket[bytes]:
        socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.SUB)
        socket.setsockopt(zmq.LINGER, 0)
        for prefix in prefixes:
            socket.subscribe(prefix)
        socket.connect(address)
        sockets.append(socket)
        return socket

    yield make
    for each in sockets:
        each.close()


@pytest.fixture
def left() -> Iterator[FakeSensor]:
    with FakeSensor("left") as sensor:
        yield sensor


@pytest.fixture
def right() -> Iterator[FakeSensor]:
    with FakeSensor("right") as sensor:
        yield sensor

"""A sensor and a control server on real sockets, for the client's tests."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import pytest
import zmq
from tactomo_client.fake import FakeSensor


@pytest.fixture
def sensor() -> Iterator[FakeSensor]:
    with FakeSensor("left") as sensor:
        yield sensor


@pytest.fixture
def reply_with() -> Iterator[Callable[[bytes], tuple[str, list[bytes]]]]:
    """Start a server that answers one request; return its address and what it was asked."""
    threads: list[threading.Thread] = []

    def serve(reply: bytes) -> tuple[str, list[bytes]]:
        socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REP)
        socket.setsockopt(zmq.LINGER, 1000)
        port = socket.bind_to_random_port("tcp://127.0.0.1")
        asked: list[bytes] = []

        def answer() -> None:
            with socket:
                if socket.poll(10_000):
                    asked.append(socket.recv())
                    socket.send(reply)

        threads.append(threading.Thread(target=answer))
        threads[-1].start()
        return f"tcp://127.0.0.1:{port}", asked

    yield serve
    for thread in threads:
        thread.join()

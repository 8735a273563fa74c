"""The command line as a user runs it: arguments, output and an exit status."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
import zmq
from tactomo.running import Running, announced
from tactomo_client.messages import decode_request, encode_error, encode_reply


class ControlServer:
    """Answers control requests as it is told to and remembers them."""

    def __init__(self) -> None:
        self.answers: dict[str, dict[str, Any] | tuple[str, str, str]] = {}
        self.requests: list[tuple[str, dict[str, Any]]] = []
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REP)
        self._socket.bind("tcp://127.0.0.1:*")
        self.address: str = self._socket.last_endpoint.decode().rstrip("\0")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        while not self._stop.is_set():
            if self._socket.poll(20):
                command, arguments = decode_request(self._socket.recv())
                self.requests.append((command, arguments))
                answer = self.answers.get(command, {})
                self._socket.send(
                    encode_error(*answer) if isinstance(answer, tuple) else encode_reply(answer)
                )

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._socket.close(0)


@pytest.fixture
def control() -> Iterator[ControlServer]:
    """The control socket of the only sensor that runs on this computer."""
    server = ControlServer()
    with announced(Running("daemon", server.address, "left_forearm")):
        yield server
    server.close()

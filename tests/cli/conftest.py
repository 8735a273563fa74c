"""The command line as a user runs it: a process with arguments, output and an exit status."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq
from tactomo_client.messages import decode_request, encode_error, encode_reply

TIMEOUT_S = 90.0

Completed = subprocess.CompletedProcess[str]


@pytest.fixture
def tactomo(tmp_path: Path) -> Callable[..., Completed]:
    """Run `tactomo ARGUMENTS` in an empty folder and return what became of it."""

    def run(*arguments: object, **options: Any) -> Completed:
        command = [sys.executable, "-m", "tactomo.cli", *map(str, arguments)]
        options = {"cwd": tmp_path, "timeout": TIMEOUT_S, "stdin": subprocess.DEVNULL, **options}
        return subprocess.run(command, capture_output=True, text=True, check=False, **options)

    return run


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
                is_error = isinstance(answer, tuple)
                self._socket.send(encode_error(*answer) if is_error else encode_reply(answer))

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._socket.close(0)


@pytest.fixture
def control() -> Iterator[ControlServer]:
    server = ControlServer()
    yield server
    server.close()

"""A program of tactomo's in a process of its own, followed by what it logs."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import zmq
from tactomo_client.messages import decode_message
from waiting import PATIENCE_S


class LoggedProcess:
    """Python with some arguments, which logs JSON; it is ready, at `address`."""

    def __init__(self, *arguments: object) -> None:
        command = [sys.executable, *map(str, arguments)]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        self.address: str = self.said("ready")["stream"]

    def said(self, event: str) -> dict[str, Any]:
        """Return the next such line of its log."""
        assert self.process.stderr is not None
        for line in self.process.stderr:
            entry: dict[str, Any] = json.loads(line)
            if entry["event"] == event:
                return entry
        raise AssertionError(f"it ended with status {self.process.wait()}")

    def end(self) -> None:
        self.process.kill()
        self.process.communicate()


def next_of(socket: zmq.Socket[bytes], send: Callable[[], object] = lambda: None) -> Any:
    """Return the next message; `send` is called until it comes."""
    deadline = time.monotonic() + PATIENCE_S
    while not socket.poll(20):
        assert time.monotonic() < deadline, "no message came"
        send()
    return decode_message(socket.recv())

"""A command in a terminal, as somebody sits before it: what it shows, and keys to press."""

from __future__ import annotations

import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from typing import Self

PATIENCE_S = 60.0
CONTROL = re.compile(r"\x1b\[[0-9;?]*[a-zA-Z]|\x1b[=>]|\r")


class Terminal:
    """Runs `tactomo` with these arguments in a terminal of 120 x 60.

    Attributes:
        shown: all that it has shown, without colours and the like.
    """

    def __init__(self, *arguments: str, environment: Mapping[str, str] | None = None) -> None:
        self.shown = ""
        self._seen = 0
        self._main, side = pty.openpty()
        size = {"COLUMNS": "120", "LINES": "60", "TERM": "xterm-256color"}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tactomo.cli", *arguments],
            stdin=side,
            stdout=side,
            stderr=side,
            env={**os.environ, **size, **(environment or {})},
            start_new_session=True,
        )
        os.close(side)

    def wait_for(self, text: str) -> str:
        """Wait until it shows a text that it has not been waited for yet; returns what came."""
        end_s = time.monotonic() + PATIENCE_S
        while (at := self.shown.find(text, self._seen)) < 0:
            assert self._read() or time.monotonic() < end_s, f"no {text!r} in: {self.shown[-2000:]}"
            assert time.monotonic() < end_s, f"no {text!r} in: {self.shown[-2000:]}"
        came, self._seen = self.shown[self._seen : at + len(text)], at + len(text)
        return came

    def enter(self, text: str) -> None:
        """Type a line, and Enter."""
        os.write(self._main, f"{text}\n".encode())

    def press_ctrl_c(self) -> None:
        """Interrupt it."""
        self._process.send_signal(signal.SIGINT)

    def wait(self) -> int:
        """Wait until it ends; returns the exit status."""
        end_s = time.monotonic() + PATIENCE_S
        while self._process.poll() is None and time.monotonic() < end_s:
            self._read()
        while self._read():
            pass
        return self._process.wait(1)

    def _read(self) -> bool:
        """Take in what it shows, waiting a little; False where there is no more."""
        if not select.select([self._main], [], [], 0.1)[0]:
            return self._process.poll() is None
        try:
            data = os.read(self._main, 65_536)
        except OSError:  # nobody is left on the other side
            return False
        self.shown += CONTROL.sub("", data.decode(errors="replace"))
        return bool(data)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        os.close(self._main)

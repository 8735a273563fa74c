"""The whole system as a user starts it: `tactomo demo`, with its three processes."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from tactomo_client import request

SENSOR = "left_forearm"
PATIENCE_S = 60.0
ANYWHERE = "tcp://127.0.0.1:0"


@dataclass(frozen=True)
class Demo:
    """Addresses of a running demo."""

    process: subprocess.Popen[str]
    stream: str
    control: str
    twin: str
    page: str

    def press(self, x_mm: float, y_mm: float, **more: Any) -> None:
        """Press the virtual skin."""
        request("press", self.twin, x_mm=x_mm, y_mm=y_mm, **more)

    def clear(self) -> None:
        """Lift everything off the virtual skin."""
        request("clear", self.twin)


@contextmanager
def running_demo(*options: str) -> Iterator[Demo]:
    """Start `tactomo demo` on free ports and stop it as Ctrl-C would."""
    command = [
        *(sys.executable, "-m", "tactomo.cli", "demo", "--announce", "--no-browser"),
        *("--sensor", SENSOR, "--port", "0", "--stream", ANYWHERE, "--control", ANYWHERE),
        *("--twin-control", ANYWHERE, *options),
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            for line in process.stdout:
                if line.startswith("{"):
                    break
            else:
                pytest.fail(f"the demo did not start: exit status {process.wait()}")
            said = json.loads(line)
            yield Demo(process, said["stream"], said["control"], said["twin"], said["viewer"])
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(PATIENCE_S)


def wait_for(condition: Callable[[], Any], what: str) -> Any:
    """Wait until the condition gives something and return it."""
    deadline = time.monotonic() + PATIENCE_S
    while not (value := condition()):
        assert time.monotonic() < deadline, f"waited {PATIENCE_S:g} s in vain for {what}"
        time.sleep(0.02)
    return value


def repository() -> Path:
    """Root of this checkout."""
    return Path(__file__).parents[2]

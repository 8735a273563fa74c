"""The whole system as a user starts it: `tactomo demo`, with its three processes."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from daemon_process import DaemonProcess
from tactomo.cli.children import ProcessGroup
from tactomo_client import Frame, request, subscribe
from variants import rewritten
from waiting import PATIENCE_S, wait_until

SENSOR = "left_forearm"
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
        request("press", self.twin, PATIENCE_S, x_mm=x_mm, y_mm=y_mm, **more)

    def clear(self) -> None:
        """Lift everything off the virtual skin."""
        request("clear", self.twin, PATIENCE_S)


@contextmanager
def running_demo(
    *options: str, program: Sequence[str | Path] = (sys.executable, "-m", "tactomo.cli")
) -> Iterator[Demo]:
    """Start `tactomo demo` on free ports and stop it as Ctrl-C would.

    What it records lies in a folder of its own, as long as it runs.
    """
    command = [
        *(*program, "demo", "--announce", "--no-browser"),
        *("--sensor", SENSOR, "--viewer-port", "0", "--stream", ANYWHERE, "--control", ANYWHERE),
        *("--twin-control", ANYWHERE, *options),
    ]
    with (
        tempfile.TemporaryDirectory() as folder,
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder) as process,
    ):
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


def tactomo(*arguments: object) -> str:
    """Run a command, with which all is well, in a process of its own; return what it printed."""
    command = [sys.executable, "-m", "tactomo.cli", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def repository() -> Path:
    """Root of this checkout."""
    return Path(__file__).parents[2]


class WatchedTwin:
    """A twin that is otherwise than the description says, and a daemon that looks at it."""

    def __init__(self, twin: Mapping[str, Any], folder: Path, name: str) -> None:
        self.name = name
        self._control = str(twin["control"])
        self.daemon = DaemonProcess(folder, twin["ports"], name=name)
        wait_until(lambda: self.daemon.status()["state"] == "running", "a reference")

    def press(self, **where: Any) -> int:
        """Press one place; returns the number of the scan that the twin is at."""
        request("press", self._control, PATIENCE_S, **where)
        return int(request("status", self._control, PATIENCE_S)["counter"])

    def clear(self) -> None:
        """Lift everything off."""
        request("clear", self._control, PATIENCE_S)

    def frames(self) -> AbstractContextManager[Iterator[Frame]]:
        """What the daemon publishes."""
        return subscribe(self.name, address=self.daemon.stream, timeout_s=PATIENCE_S)

    def close(self) -> None:
        """Stop the daemon as Ctrl-C would."""
        self.daemon.signal(signal.SIGINT)
        self.daemon.popen.wait(PATIENCE_S)


@contextmanager
def paper_twin(folder: Path, *changes: tuple[str, str]) -> Iterator[dict[str, list[str]]]:
    """Run `tactomo twin` of the paper's sensor with parts of its description in other words."""
    description = rewritten(folder / "otherwise.toml", "paper_square", *changes)
    with twin_of(description, folder / "ports") as said:
        yield said


@contextmanager
def twin_of(description: Path, ports: Path) -> Iterator[dict[str, list[str]]]:
    """Run `tactomo twin` of a description file, its ports in a folder; yields what it announces."""
    with ProcessGroup() as group:
        announced = group.start(
            *("twin", "twin", "--announce", "--twin-control", ANYWHERE),
            *("--description", str(description), "--link", str(ports), "--rate", "10"),
        ).wait_ready()
        yield dict(announced)

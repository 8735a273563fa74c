"""The path from nothing to a picture: the commands of docs/see_and_keep.md, as they stand there."""

from __future__ import annotations

import json
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from foxglove_client import FoxgloveClient
from recorded_grasp import LAST_PRESSED, contacts_of, write_grasp
from tactomo.cli.export_csv import CONTACT_COLUMNS, FRAME_COLUMNS
from tactomo.cli.export_npz import CONTACT_TYPES, FRAME_TYPES, IMAGES
from tactomo_foxglove.topics import FRAME_SCHEMA, HEALTH_SCHEMA
from whole_system import ANYWHERE, PATIENCE_S, repository

PAGE = (repository() / "docs" / "see_and_keep.md").read_text("utf-8")
COMMANDS = [
    shlex.split(line)
    for block in re.findall(r"```sh\n(.*?)```", PAGE, re.S)
    for line in block.splitlines()
]
RUNNING = ("demo", "foxglove")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "deploy").symlink_to(repository() / "deploy")
    return tmp_path


class Terminal:
    """Runs the page's commands; those that keep running until it is closed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._running: list[subprocess.Popen[str]] = []

    def run(self, command: list[str], *addresses: str) -> Any:
        """Run a command with the addresses that are free; what keeps running tells where it is."""
        assert command[0] == "tactomo"
        line = [sys.executable, "-m", "tactomo.cli", *command[1:], *addresses]
        if command[1] not in RUNNING:
            done = subprocess.run(
                line, cwd=self._folder, capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, done.stderr
            return done.stdout
        process = subprocess.Popen(line, cwd=self._folder, stdout=subprocess.PIPE, text=True)
        self._running.append(process)
        assert process.stdout is not None
        return json.loads(next(said for said in process.stdout if said.startswith("{")))

    def close(self) -> None:
        for process in reversed(self._running):
            with process:  # closes its output
                process.send_signal(signal.SIGINT)
                assert process.wait(PATIENCE_S) == 0


@pytest.fixture
def terminal(folder: Path) -> Iterator[Terminal]:
    terminal = Terminal(folder)
    yield terminal
    terminal.close()


def run_the_program(folder: Path) -> float:
    """Run the page's Python there; return the force that it prints, newtons."""
    (program,) = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return float(done.stdout.split()[0])


def test_what_is_done_with_a_recording(terminal: Terminal, folder: Path) -> None:
    write_grasp(folder / "grasp.mcap")
    for command in COMMANDS[4:]:
        terminal.run(command)
    assert run_the_program(folder) == pytest.approx(contacts_of(LAST_PRESSED - 1)[0].force_n, abs=1)


@pytest.mark.slow
def test_the_whole_path(terminal: Terminal, folder: Path) -> None:
    install, demo, foxglove, record, plot, to_foxglove, to_csv, to_npz = COMMANDS
    assert install[:2] == ["pip", "install"]
    free = ("--stream", ANYWHERE, "--control", ANYWHERE, "--twin-control", ANYWHERE)
    served = terminal.run(demo, *free, "--port", "0", "--announce")
    bridge = terminal.run(foxglove, "--stream", served["stream"], "--port", "0", "--announce")
    with FoxgloveClient(bridge["url"]) as client:
        terminal.run(record, "--control", served["control"])
        client.wait("/skin/contacts", lambda scene: scene.entities)
        client.wait("/skin/sheet")
    assert "/skin/grid" in (folder / "skin.json").read_text()
    assert "wrote grasp.png" in terminal.run(plot)
    assert "frames for Foxglove" in terminal.run(to_foxglove)
    terminal.run(to_csv)
    terminal.run(to_npz)
    assert 20 < run_the_program(folder) < 300


def test_every_column_and_array_and_field_is_on_the_page() -> None:
    for name in (*FRAME_COLUMNS, *FRAME_TYPES, *IMAGES, "x_mm", "y_mm", *list(CONTACT_TYPES)[:3]):
        assert f"`{name}`" in PAGE, name
    assert CONTACT_COLUMNS[:2] == ("id", "x_mm")
    for name in FRAME_SCHEMA["properties"]:
        assert f"`{name}`" in PAGE, name
    for name in ("state", "is_stale", "age_s", "rates", "latency_ms", "recording"):
        assert name in HEALTH_SCHEMA["properties"]
        assert f"`{name}`" in PAGE, name

"""Other people's hardware: the commands of docs/other_hardware.md, as they stand there."""

from __future__ import annotations

import json
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from tactomo.cli.app import Protocol
from tactomo.config import load_config
from tactomo.protocols import FOREIGN, PROTOCOLS
from tactomo.twin.sciospec import SciospecSpeaker
from tactomo_client import request
from tactomo_models import Press as Cup
from tactomo_models import SkinSimulator, load_description
from whole_system import ANYWHERE, PATIENCE_S, repository

PAGE = (repository() / "docs" / "other_hardware.md").read_text("utf-8")


def commands(heading: str) -> list[list[str]]:
    """The commands under a heading of the page."""
    text = re.search(rf"^### {heading}\n(.*?)(?=^#)", PAGE, re.S | re.M)
    assert text is not None, heading
    blocks = re.findall(r"```sh\n(.*?)```", text[1], re.S)
    return [shlex.split(line) for block in blocks for line in block.splitlines()]


class Terminal:
    """Runs commands in a folder; what keeps running runs until it is closed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._running: list[subprocess.Popen[str]] = []

    def run(self, command: list[str], *more: str) -> str:
        done = subprocess.run(
            self._line(command, more), cwd=self.folder, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    def start(self, command: list[str], *more: str) -> Iterator[str]:
        """Start what keeps running; yields the lines that it says."""
        process = subprocess.Popen(
            self._line(command, more),
            cwd=self.folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._running.append(process)
        assert process.stdout is not None
        return iter(process.stdout)

    def close(self) -> None:
        for process in reversed(self._running):
            with process:
                process.send_signal(signal.SIGTERM)
                assert process.wait(PATIENCE_S) == 0

    def _line(self, command: list[str], more: tuple[str, ...]) -> list[str]:
        assert command[0] == "tactomo"
        return [sys.executable, "-m", "tactomo.cli", *command[1:], *more]


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[Terminal]:
    terminal = Terminal(tmp_path)
    yield terminal
    terminal.close()


def event(lines: Iterator[str], name: str) -> dict[str, Any]:
    said = (json.loads(line) for line in lines if line.startswith("{"))
    return next(each for each in said if each.get("event") == name)


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_a_researcher_with_a_sciospec_and_no_instrument_yet(terminal: Terminal) -> None:
    twin, daemon, poke, status, record, info, plot = commands("Sciospec, emulated")
    address = f"ipc://{terminal.folder}/twin"
    next(line for line in terminal.start(twin, "--control", address) if "control" in line)
    log = terminal.start(daemon, "--stream", ANYWHERE, "--control", ANYWHERE)
    control = event(log, "ready")["control"]
    event(log, "tared")
    terminal.run(poke, "--control", address)
    assert "sciospec" in terminal.run(status, "--control", control)
    terminal.run(record, "--control", control)
    assert "sciospec, protocol sciospec" in terminal.run(info)
    assert "1 contact(s)" in terminal.run(plot)
    port = request("status", control)["ports"][0]
    assert (port["state"], port["protocol"]) == ("running", "sciospec")


def test_what_is_done_with_an_instrument(terminal: Terminal) -> None:
    ports, copy, build = commands("Sciospec, the instrument")
    terminal.run(ports)
    assert "wrote tank.toml" in terminal.run(copy)
    assert load_description(terminal.folder / "tank.toml") == load_description("sciospec_disc")
    terminal.run(build)


def save_eit_files(folder: Path) -> None:
    """A cup that comes into an empty tank, as Sciospec's program saves it."""
    sensor = load_description("sciospec_disc")
    skin = SkinSimulator(sensor, 8e-3)
    empty, full = (
        skin.voltages(cups)["structure"] for cups in ([], [Cup(0.04, 0.02, 100.0, 0.015)])
    )
    noise = np.random.default_rng(0).normal(scale=1e-3, size=(30, sensor.measurements))
    spread = SciospecSpeaker(sensor, 20.0)
    folder.mkdir()
    for number in range(30):
        volts = (empty if number < 20 else full) * (1 + noise[number])
        potentials = spread.potentials_of(volts)
        lines = ["18", "2", "setup_00001", f"2024.01.31. 12:00:{number / 20:06.3f}", "1e4", "1e4"]
        lines += ["0", "1", "0.001", "20.0", *[""] * 8]
        for (source, sink), row in zip(sensor.drive_pairs + 1, potentials, strict=True):
            lines.append(f"{source} {sink}")
            lines.append("\t".join(f"{value.real:.9E}\t{value.imag:.9E}" for value in row))
        (folder / f"setup_00001_{number:05d}.eit").write_text("\n".join(lines) + "\n")


def test_its_files_become_a_recording(terminal: Terminal) -> None:
    save_eit_files(terminal.folder / "setup_00001")
    into, replay, doctor = commands("Sciospec, its files")
    assert "30 scans" in terminal.run(into)
    terminal.run(replay, "--stream", ANYWHERE, "--control", ANYWHERE)
    assert "reciprocity" in terminal.run(doctor)


@pytest.mark.slow
@pytest.mark.parametrize(("heading", "x_mm", "y_mm"), [("OpenEIT", 30, -20), ("Tables", 25, 10)])
def test_a_researcher_with_a_board_that_prints(
    terminal: Terminal, heading: str, x_mm: float, y_mm: float
) -> None:
    twin, daemon, poke, status = commands(f"{heading}, emulated")
    address = f"ipc://{terminal.folder}/twin"
    next(line for line in terminal.start(twin, "--control", address) if "control" in line)
    log = terminal.start(daemon, "--stream", ANYWHERE, "--control", ANYWHERE)
    ready = event(log, "ready")
    event(log, "tared")
    terminal.run(poke, "--control", address)
    assert "skin: running" in terminal.run(status, "--control", ready["control"])
    (program,) = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    program = program.replace('"skin"', f'"skin", address="{ready["stream"]}"')
    said = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    ).stdout
    place = re.match(r"\((-?[\d.]+), (-?[\d.]+)\) mm", said)
    assert place is not None
    assert [float(mm) for mm in place.groups()] == pytest.approx([x_mm, y_mm], abs=3)


def test_a_board_that_prints_is_described(terminal: Terminal) -> None:
    for command in commands("OpenEIT, the board") + commands("Tables, the board"):
        terminal.run(command)
        name, copied = command[-2:]
        assert load_description(terminal.folder / copied) == load_description(name)


@pytest.mark.parametrize("name", FOREIGN)
def test_each_protocol_has_an_example_of_a_configuration(name: str) -> None:
    config = load_config(repository() / "deploy" / "examples" / f"{name}.toml")
    assert config.protocol == name
    FOREIGN[name](load_description(config.description))


def test_every_protocol_is_on_the_page() -> None:
    assert get_args(Protocol) == PROTOCOLS
    for name in PROTOCOLS:
        assert f"`{name}`" in PAGE
    for description in re.findall(r"`(\w+_(?:disc|square))`", PAGE):
        load_description(description)

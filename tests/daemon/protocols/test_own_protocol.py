"""A device protocol of somebody else's, in a file that no distribution registers."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from daemon_process import DaemonProcess
from page import Page
from tactomo.config import load_config
from tactomo.errors import ConfigError, RecordingError
from tactomo.protocols import (
    ForeignProtocol,
    Reading,
    find_protocol,
    protocol_named,
    recognised,
    registry,
)
from tactomo.recordings.recording import Origin, open_recording
from tactomo.twin import TwinConfig
from tactomo_client import ControlError, request
from tactomo_models import load_description
from tactomo_protocol import CompanionReading, Scan, ScanFlag
from typer.testing import CliRunner
from variants import variant
from waiting import repeated, wait_until

SENSOR = load_description("matrix_disc")
OWN = """

class Mute(FloatBoard):
    name, emulator = "mute", ""


class Broken(FloatBoard):
    name = "broken"

    def parse(self, data):
        yield Reading(volts=None)


class Another:
    pass


class Matrix(FloatBoard):
    name = "matrix"
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the module lies; Python finds it there."""
    page = Page("docs/python.md")
    (tmp_path / "own_board.py").write_text(page.file("float_board.py") + OWN)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(registry, "_named", {})
    return tmp_path


@pytest.fixture
def board() -> Iterator[str]:
    """A board that sends frames of noise around some voltages; yields its port's path."""
    device, host = os.openpty()
    os.set_blocking(device, False)
    rng = np.random.default_rng(1)

    def send() -> None:
        volts = rng.normal(1.0, 1e-4, SENSOR.measurements).astype("<f4")
        with contextlib.suppress(BlockingIOError):  # nobody reads yet
            os.write(device, b"EIT\n" + volts.tobytes())

    with repeated(send, 0.02):
        yield os.ttyname(host)
    os.close(device)
    os.close(host)


@pytest.mark.slow
def test_the_daemon_reads_a_board_by_a_protocol_that_is_named(folder: Path, board: str) -> None:
    daemon = DaemonProcess(
        folder,
        [board],
        environment={"PYTHONPATH": str(folder)},
        protocol="own_board:FloatBoard",
        description="matrix_disc",
        method="tikhonov",
    )
    path = folder / "own.mcap"
    try:
        wait_until(lambda: daemon.status()["state"] == "running", "a reference")
        [port] = daemon.status()["ports"]
        assert (port["protocol"], port["device"]["device_id"]) == ("float-board",) * 2
        daemon.ask("record_start", path=path.name)
        frames = daemon.status()["frames"]
        wait_until(lambda: daemon.status()["frames"] > frames + 10, "frames")
        daemon.ask("record_stop")
        for module in ("own_board:FloatBoard", "own_board:Broken"):
            with pytest.raises(ControlError):
                request("set_tier", daemon.control, tier=module)
    finally:
        daemon.stop()
    find_protocol("own_board:FloatBoard")
    recording = open_recording(path)
    assert recording.origin.protocol == "float-board"
    assert recording.summary.frames > 5
    assert sum(recording.summary.scans.values()) >= recording.summary.frames


def test_a_recording_names_no_module(folder: Path) -> None:
    origin = Origin("skin", "matrix_disc", "", ("p",), "0", protocol="own_board:Another")
    with pytest.raises(RecordingError, match=r"own_board:Another.*there is no protocol"):
        origin.new_protocol()


@pytest.mark.parametrize(
    ("name", "cause"),
    [
        ("no_such_module:Floats", "cannot import no_such_module: ModuleNotFoundError"),
        ("own_board:Nothing", "own_board has no Nothing"),
        ("own_board:Another", "own_board:Another is no protocol: no name"),
        ("own_board:Matrix", "calls itself 'matrix'"),
        ("own board:Floats", "names no class"),
        ("floatz", "there is no protocol 'floatz'; use one of: tactomo, "),
    ],
)
def test_what_is_no_protocol_is_named(folder: Path, name: str, cause: str) -> None:
    with pytest.raises(ConfigError, match=cause):
        load_config(ports=("/dev/null",), protocol=name)


def test_a_mistake_in_a_protocol_costs_no_port(folder: Path) -> None:
    protocol = protocol_named(find_protocol("own_board:Broken").name, SENSOR)
    assert protocol.feed(b"EIT\n") == []
    assert protocol.trouble is not None
    assert "protocol broken failed: ValueError: volts of shape" in protocol.trouble.cause
    assert protocol.counts.malformed == 1


def test_the_twin_says_what_it_needs_to_speak_it(folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"does not speak the protocol 'mute'.*emulator ="):
        TwinConfig(SENSOR, protocol="own_board:Mute")


@pytest.mark.slow
def test_ports_knows_it_by_what_it_sends(folder: Path, board: str) -> None:
    from tactomo.cli import app

    assert recognised(b"..EIT\n..") is None
    result = CliRunner().invoke(
        app, ["ports", board, "--ask", "--protocol", "own_board:FloatBoard"]
    )
    assert "--protocol float-board" in " ".join(result.output.split())


class WithCell(ForeignProtocol):
    """Whatever comes is a scan of ones, with a reading of a companion of that name."""

    name, device_id = "with-cell", "with-cell"

    def parse(self, data: bytes) -> Iterator[Reading]:
        yield Reading(np.ones(SENSOR.measurements), 7, {data.decode(): 4.5})


def test_a_reading_of_a_companion_comes_before_its_scan() -> None:
    cell = {"index": 3, "gain_n_per_unit": 1.0, "noise_n": 1.0}
    protocol = WithCell(variant(SENSOR, companion={"cell": cell}))
    _, reading, scan = protocol.feed(b"cell")
    assert reading == CompanionReading(3, ScanFlag(0), 7, 4.5)
    assert isinstance(scan, Scan)
    assert protocol.feed(b"pad") == []
    assert protocol.trouble is not None
    assert "no companion pad" in protocol.trouble.cause

"""A Sciospec instrument, emulated on a pty, through a daemon to a controller."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_process import DaemonProcess
from emulated_board import MeasuredSkin, changed, emulated, frame_where
from shared_data import measured
from tactomo.recordings.imported_scans import read_scans
from tactomo.recordings.recording import open_recording
from tactomo.twin import Twin
from tactomo_client import request
from tactomo_client.recording import open_recording as open_frames
from tactomo_models import load_description
from tactomo_protocol import Scan
from waiting import PATIENCE_S, wait_until
from whole_system import tactomo

TANK = "sciospec_disc"
Start = Callable[..., tuple[Twin, DaemonProcess]]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start an emulated instrument and a daemon on it."""
    with ExitStack() as running:
        yield lambda sensor, daemon=None, skin=None, **config: running.enter_context(
            emulated(tmp_path, sensor, "sciospec", skin, daemon, **config)
        )


def is_streaming(twin: Twin) -> bool:
    return bool(request("status", twin.control, PATIENCE_S)["ports"][0]["streaming"])


@pytest.mark.slow
def test_an_instrument_is_configured_believed_and_stopped(start: Start, tmp_path: Path) -> None:
    record = {"recording": {"file": str(tmp_path / "a.mcap")}}
    twin, daemon = start(changed(tmp_path, TANK), record)
    wait_until(lambda: daemon.told("tared"), "a reference")
    for x_mm in (40.0, -40.0):
        request("press", twin.control, PATIENCE_S, x_mm=x_mm, y_mm=20.0, radius_mm=15.0)
        found = frame_where(
            daemon,
            lambda f, x=x_mm: len(f.contacts) == 1 and f.contacts[0].x_mm * x > 0,  # type: ignore[misc]
        )
        frame = frame_where(daemon, lambda f, n=found.sequence: f.sequence > n + 3)  # type: ignore[misc]
        [contact] = frame.contacts
        assert math.hypot(contact.x_mm - x_mm, contact.y_mm - 20.0) < 3.0
    request("clear", twin.control, PATIENCE_S)
    # Junk between messages, and a cable that is pulled in the middle of one.
    request("garbage", twin.control, PATIENCE_S, count=3000)
    wait_until(lambda: daemon.status()["ports"][0]["corrupt"] > 0, "damage that is counted")
    request("unplug", twin.control, PATIENCE_S)
    wait_until(lambda: daemon.told("port_lost"), "a lost port")
    request("replug", twin.control, PATIENCE_S)
    wait_until(lambda: daemon.told("port_back"), "the port again")
    request("press", twin.control, PATIENCE_S, x_mm=0.0, y_mm=-50.0, radius_mm=15.0)
    frame_where(daemon, lambda f: len(f.contacts) == 1 and f.contacts[0].y_mm < -40)
    assert not daemon.told("device_refused")
    assert daemon.status()["ports"][0]["device"]["device_id"] == "sciospec"
    assert is_streaming(twin)
    daemon.stop()
    assert wait_until(lambda: not is_streaming(twin), "an instrument that was stopped")
    summary = open_recording(tmp_path / "a.mcap").summary
    assert summary.origin.protocol == "sciospec"
    assert sum(summary.scans.values()) >= summary.frames > 20
    assert summary.corrupt > 0


@pytest.mark.long
def test_a_daemon_that_was_killed_leaves_it_measuring_and_the_next_takes_over(
    start: Start, tmp_path: Path
) -> None:
    tank = changed(tmp_path, TANK)
    twin, daemon = start(tank)
    wait_until(lambda: daemon.told("tared"), "a reference")
    daemon.signal(signal.SIGKILL)
    daemon.popen.wait(PATIENCE_S)
    assert is_streaming(twin)
    again = DaemonProcess(tmp_path, twin.ports, protocol="sciospec", description=tank)
    try:
        wait_until(lambda: again.told("tared"), "a reference of the next daemon")
        [port] = again.status()["ports"]
        assert port["state"] == "running"
        assert port["refusal"] is None
    finally:
        again.kill()


@pytest.mark.slow
def test_what_the_instrument_refuses_is_named(start: Start, tmp_path: Path) -> None:
    _, daemon = start(changed(tmp_path, TANK, ("scan_rate_hz = 20.0", "scan_rate_hz = 500.0")))
    [told] = wait_until(lambda: daemon.told("device_refused"), "a refusal")
    assert "will not measure 500 frames a second (NACK 81)" in told["detail"]
    assert "[instrument]" in told["next_step"]
    assert daemon.status()["ports"][0]["state"] == "refused"


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_played_stream_gives_what_its_import_gives(start: Start, tmp_path: Path) -> None:
    """The measured cup, said by the emulator and read from its file: equal scans and contacts."""
    path = measured("tank_sciospec_20fps.npz")
    live, imported = tmp_path / "live.mcap", "import.mcap"
    tank = changed(tmp_path, TANK)
    settings = {"lossless": True, "recording": {"file": str(live), "maps": True}}
    description = load_description(tank)
    [volts] = read_scans(path, description, None).volts.values()
    skin = MeasuredSkin(description, volts)
    _, daemon = start(tank, settings, skin, noise_v=0.0)
    wait_until(lambda: skin.said > len(volts) + 5, "its scans", 60.0)
    wait_until(lambda: daemon.status()["frames"] > len(volts), "its frames", 300.0)
    daemon.stop()
    # The first frame goes for reading the instrument's clock, the next 20 for the reference.
    said = scans(live)[: len(volts) - 1]
    np.testing.assert_allclose(said, volts[1:], rtol=1e-5, atol=2e-7)
    path = tmp_path / "said.npz"
    np.savez(path, structure=said, t=0.05 * np.arange(len(said)))
    tactomo(
        *("import", path, tmp_path / imported, "--description", tank, "--reference-frames", "0:20")
    )
    np.testing.assert_array_equal(scans(tmp_path / imported), said)
    again = tmp_path / "again.mcap"
    tactomo(
        *("daemon", "--description", tank, "--port", f"replay://{tmp_path / imported}?speed=0"),
        *("--set", f"recording.file={again}", "--set", "recording.maps=true"),
        *("--set", "exit_at_end=true"),
        *("--stream", "tcp://127.0.0.1:0", "--control", "tcp://127.0.0.1:0"),
    )
    ours, theirs = list(open_frames(live)), list(open_frames(again))
    assert len(theirs) == 254
    ours, theirs = ours[20:254], theirs[-234:]
    for live_frame, read_frame in zip(ours, theirs, strict=True):
        places = [[(c.x_mm, c.y_mm) for c in frame.contacts] for frame in (live_frame, read_frame)]
        np.testing.assert_allclose(places[0], places[1], atol=0.01)
    moving = ours[-125:-55]
    angle = np.unwrap([math.atan2(f.contacts[0].y_mm, f.contacts[0].x_mm) for f in moving])
    assert angle[-1] - angle[0] > math.pi  # around the tank, counter-clockwise


def scans(path: Path) -> list[np.ndarray[Any, np.dtype[np.float32]]]:
    recording = open_recording(path)
    protocol = recording.origin.new_protocol()
    packets = (packet for chunk in recording.chunks(0) for packet in protocol.feed(chunk.data))
    return [np.asarray(packet.samples) for packet in packets if isinstance(packet, Scan)]

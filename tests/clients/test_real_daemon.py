"""The client against a real daemon process on a real pseudo-terminal, killed and started again."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_process import DaemonProcess
from pty_skin import Playing, PtySkin
from small_sensor import SMALL
from tactomo_client import (
    AlreadyRecording,
    BadArgument,
    CannotWrite,
    Daemon,
    Frame,
    NoNetwork,
    NotRecording,
    aio,
    subscribe,
)
from tactomo_client.recording import open_recording
from tactomo_models import load_description
from tactomo_protocol import Channel

SENSOR = "skin"
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def description_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sensor") / "small.toml"
    path.write_text(SMALL)
    return path


@pytest.fixture
def config(tmp_path: Path, description_path: Path) -> Iterator[dict[str, Any]]:
    """What starts a daemon on a skin that says twenty dual scans a second, nothing pressed."""
    description = load_description(str(description_path))
    skin = PtySkin(tmp_path / "lines", description, ports=1)
    rest = np.linspace(0.05, 0.2, description.measurements)
    playing = Playing(skin, itertools.repeat(dict.fromkeys(Channel, rest)), 20.0)
    yield {
        "ports": [str(path) for path in skin.paths],
        "description": str(description_path),
        "tare_scans": 3,
    }
    playing.stop()
    skin.close()


@pytest.mark.slow
def test_both_clients_go_on_by_themselves_after_the_daemon_was_killed(
    tmp_path: Path, config: dict[str, Any]
) -> None:
    first = DaemonProcess(tmp_path, **config)
    address, control = first.stream, first.control
    second: list[DaemonProcess] = []

    def restart() -> None:
        first.kill()
        second.append(DaemonProcess(tmp_path, **config, stream=address, control=control))

    async def follow() -> tuple[Frame, Frame, str]:
        async with (
            aio.subscribe(SENSOR, address=address, timeout_s=PATIENCE_S) as skin,
            aio.Daemon(control, timeout_s=PATIENCE_S) as daemon,
        ):
            before, status = await anext(skin), await daemon.status()
            assert status.session == before.session
            await asyncio.to_thread(restart)
            async for frame in skin:
                if frame.session != before.session:
                    return before, frame, (await daemon.status()).session
        raise AssertionError("the iteration ended")

    try:
        with (
            subscribe(SENSOR, address=address, kind="contacts", timeout_s=PATIENCE_S) as skin,
            Daemon(control, timeout_s=PATIENCE_S) as daemon,
        ):
            old = next(skin)
            assert daemon.status().session == old.session
            before, after, session = asyncio.run(follow())
            new = next(frame for frame in skin if frame.session != old.session)
            assert old.session == before.session
            assert new.session == after.session == session == daemon.status().session
            assert skin.malformed == 0
            assert (latest := skin.latest()) is not None
            assert latest.session == new.session
    finally:
        for process in (first, *second):
            process.kill()


@pytest.mark.slow
def test_every_command_on_the_real_thing(tmp_path: Path, config: dict[str, Any]) -> None:
    process = DaemonProcess(tmp_path, **config)
    path = tmp_path / "grasp.mcap"
    try:
        with (
            Daemon(process.control, timeout_s=PATIENCE_S) as daemon,
            subscribe(SENSOR, address=process.stream, kind="event", timeout_s=PATIENCE_S) as events,
            subscribe(SENSOR, address=process.stream, timeout_s=PATIENCE_S) as skin,
        ):
            next(skin)
            assert daemon.tare().scans == 3
            assert next(event for event in events if event.name == "tared").severity == "info"
            with daemon.record(path.name, maps=True) as recording:
                begin_ns = time.monotonic_ns()  # what was acquired before may not be in it
                since = (frame for frame in skin if frame.acquired_monotonic_ns > begin_ns)
                live = list(itertools.islice(since, 3))
                status = daemon.status()
                assert status.recording is not None
                assert status.recording.path == recording.path == str(path)
                with pytest.raises(AlreadyRecording):
                    daemon.record_start()
            with pytest.raises(NotRecording):
                daemon.record_stop()
            with pytest.raises(CannotWrite, match="exists already"):
                daemon.record_start(path.name)
            assert daemon.set_tier("tikhonov").tier == "tikhonov"
            assert daemon.set_budget(20).budget_ms == 20.0
            with pytest.raises(BadArgument):
                daemon.set_budget(-1)
            with pytest.raises(NoNetwork):
                daemon.set_tier("network")
            assert status.state == "running"
            assert status.ports[0].device is not None
            assert status.ports[0].device.device_id == "pty-skin"
            assert status.description is not None
            assert status.description.model == "small"
    finally:
        process.kill()
    recorded = {frame.sequence: frame for frame in open_recording(path)}
    for frame in live:
        again = recorded[frame.sequence]
        assert (again.session, again.contacts) == (frame.session, frame.contacts)
        np.testing.assert_array_equal(again.map, frame.map)

"""A load cell beneath a simulated sheet: from packets to frames, and back from a recording."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from tactomo_client import Daemon, Frame, subscribe
from tactomo_client.recording import open_recording
from tactomo_models.sensor.description_file import shipped_text
from waiting import PATIENCE_S, wait_until
from whole_system import ANYWHERE, SENSOR, Demo, running_demo, tactomo

CELL = """
[companion.load_cell]
gain_n_per_unit = 2.0
offset = 5.0
noise_n = 0.5
relative_error = 0.01
"""
ABSENT = """
[companion.pad]
gain_n_per_unit = 1.0
noise_n = 1.0
"""
pytestmark = pytest.mark.slow
TRUTH_N = 180e3 * math.pi * 0.015**2
"""Of a flat disc of 15 mm at 180 kPa."""


@pytest.fixture(scope="module")
def sensors(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Descriptions of one graded sheet: alone, with a cell, and with a pad that never speaks."""
    folder = tmp_path_factory.mktemp("sensors")
    sheet = shipped_text("graded_square")
    texts = {"alone": sheet, "cell": sheet + CELL, "pad": sheet + CELL + ABSENT}
    for name, text in texts.items():
        (folder / f"{name}.toml").write_text(text, "utf-8")
    return {name: folder / f"{name}.toml" for name in texts}


@pytest.fixture(scope="module")
def demo(sensors: dict[str, Path]) -> Iterator[Demo]:
    with running_demo("--description", str(sensors["cell"])) as running:
        yield running


@pytest.fixture(scope="module")
def live(demo: Demo) -> Path:
    """A recording of a press, from before it on."""
    with (
        Daemon(demo.control) as daemon,
        subscribe(SENSOR, address=demo.stream, timeout_s=PATIENCE_S) as skin,
        daemon.record("live.mcap", maps=True) as recording,
    ):
        next(skin)
        demo.press(0.0, 0.0, pressure_kpa=180.0, radius_mm=15.0)
        wait_until(lambda: next(skin).contacts, "the contact")
        assert len(list(islice(skin, 8))) == 8
    return Path(recording.path)


def test_the_status_says_what_the_cell_reads_and_whether_it_is_believed(
    demo: Demo, live: Path
) -> None:
    with Daemon(demo.control) as daemon:
        wait_until(lambda: daemon.status().companions["load_cell"].state == "fitted")
        cell = daemon.status().companions["load_cell"]
        assert cell.force_n == pytest.approx(TRUTH_N, rel=0.04)
        assert cell.reading == pytest.approx(5.0 + TRUTH_N / 2, rel=0.04)
        assert cell.force_sigma_n == pytest.approx(np.hypot(0.5, 0.01 * TRUTH_N), rel=0.05)


def replayed(live: Path, description: Path, again: Path) -> dict[int, Frame]:
    """Frames by scan counter, as a daemon makes them of a recording."""
    anywhere = ("--stream", ANYWHERE, "--control", ANYWHERE)
    options = ("--description", description, "--record", again)
    tactomo("replay", live, "--speed", "max", *options, *anywhere)
    return {frame.scan_counter: frame for frame in open_recording(again)}


def pressed(frames: dict[int, Frame]) -> list[Frame]:
    found = [frame for frame in frames.values() if frame.contacts]
    assert found
    return found


def test_a_load_cell_makes_the_force_sure_live_and_in_a_replay(
    live: Path, sensors: dict[str, Path], tmp_path: Path
) -> None:
    recorded = {frame.scan_counter: frame for frame in open_recording(live)}
    again = replayed(live, sensors["cell"], tmp_path / "again.mcap")
    assert {n: f.force_n for n, f in again.items()} == {n: f.force_n for n, f in recorded.items()}
    alone = replayed(live, sensors["alone"], tmp_path / "alone.mcap")
    with_cell, without = (
        [(frame.force_n, frame.force_sigma_n) for frame in pressed(frames)[-5:]]
        for frames in (recorded, alone)
    )
    for force_n, sigma_n in with_cell:
        assert force_n == pytest.approx(TRUTH_N, rel=0.04)
        assert (sigma_n or np.inf) < 0.02 * TRUTH_N
    # The sheet alone is 20 % low without a bound, or less sure: by its noise, one or the other.
    assert all((sigma_n or np.inf) > 0.04 * TRUTH_N for _, sigma_n in without)
    assert not any(frame.flags for frame in recorded.values())


def test_a_companion_that_never_speaks_is_named(
    live: Path, sensors: dict[str, Path], tmp_path: Path
) -> None:
    frames = pressed(replayed(live, sensors["pad"], tmp_path / "pad.mcap"))
    assert all(frame.flags == {"companion_missing"} for frame in frames)
    assert all("companion pad has no reading" in str(frame.tier_reason) for frame in frames)
    assert all(abs((frame.force_n or 0) - TRUTH_N) < 0.04 * TRUTH_N for frame in frames)

"""Measured sets, said by the emulators of the boards that they belong to, and seen by a controller.

The sets hold changes of voltages alone, so what the boards say is the model's voltages of the bare
sheet plus those changes, after scans at rest with the noise that the changes show.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_process import SENSOR, DaemonProcess
from emulated_board import MeasuredSkin, emulated
from shared_data import measured
from tactomo_client import Frame, subscribe
from tactomo_lab.evaluation.skin_presses import read_presses
from tactomo_lab.evaluation.tanks import (
    TankImager,
    on_pixels,
    read_tanks,
)
from tactomo_lab.scenes.measures import correlation
from tactomo_models import Artifact, SensorDescription, build_artifact, load_description
from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scans.reference import noise_of_reciprocity
from tactomo_models.sensor.description_file import shipped_text

REST = 100
"""Scans at rest that come first: a daemon tares by twenty, and a controller subscribes."""
SCALE = 0.62
"""Of the tanks' changes, as a share of the largest possible: what `evaluate measured` finds."""
ONE_SIDED = '[instrument]\nvoltages = "positive"\nvolts_per_unit = 1e-3\nregularisation = 30.0\n'
UNSIGNED = '[instrument]\nvoltages = "unsigned"\n'


def described(tmp_path: Path, name: str, more: str = "") -> Path:
    path = tmp_path / f"{name}.toml"
    path.write_text(f"{shipped_text(name)}\n{more}")
    return path


def bare_volts(sensor: SensorDescription, artifact: Artifact) -> FloatArray:
    model = ForwardModel(sensor, artifact.bare)
    return np.asarray(model.bare_voltages * model.volts_per_unit)


@contextmanager
def playing(
    tmp_path: Path, scans: FloatArray, sensor: Path, protocol: str, rate_hz: float, **config: Any
) -> Iterator[DaemonProcess]:
    """A board that says these scans, and a daemon on it."""
    skin = MeasuredSkin(scans)
    rate = {"rate_hz": rate_hz, "noise_v": 0.0}
    with emulated(tmp_path, str(sensor), protocol, skin, config, **rate) as (_, daemon):
        yield daemon


def frames_of(daemon: DaemonProcess, last: int, missed: int = 0) -> dict[int, Frame]:
    """Frames by the number of their scan, up to the last one.

    A board without a greeting says one line, `missed`, before it is known where a line begins.
    """
    found: dict[int, Frame] = {}
    with closing(subscribe(SENSOR, address=daemon.stream, timeout_s=60.0)) as frames:
        for frame in frames:
            found[frame.scan_counter + missed] = frame
            if frame.scan_counter + missed >= last:
                return found
    raise AssertionError("the stream ended")


@pytest.mark.long
def test_presses_on_a_round_skin_are_located_through_a_board(
    tmp_path: Path,
) -> None:
    """As near as by `tactomo evaluate measured`, whose NOSER image comes to 5.7 mm."""
    path = described(tmp_path, "skin_round", ONE_SIDED)
    sensor = load_description(path)
    presses = read_presses(measured("skin_round_presses.npz"), sensor)
    bare = bare_volts(sensor, build_artifact(sensor))
    # Of the half that the set's converter reads, all but 1 % change by less than 30 %.
    bare *= np.quantile(np.abs(presses.changes / bare)[:, bare > 0], 0.99) / 0.3
    # Noise as in the half that it does not read.
    noise = np.median(np.abs(presses.changes[:, bare < 0])) / 0.6745
    at_rest = bare + noise * np.random.default_rng(0).standard_normal((REST, len(bare)))
    last = REST + len(presses.changes) - 1
    scans = np.vstack([at_rest, bare + presses.changes, at_rest])
    with playing(tmp_path, scans, path, "matrix", 40.0, method="noser") as daemon:
        frames = frames_of(daemon, last, missed=1)
    came = [n for n in range(REST, last + 1) if n in frames]
    found = [frames[n].contacts for n in came]
    positions = [presses.positions_m[n - REST] for n in came]
    assert len(found) > 0.9 * len(presses.positions_m)  # a busy machine leaves some out
    touched = [n for n, contacts in enumerate(found) if contacts]
    assert len(touched) > 0.98 * len(found)
    largest = [max(found[n], key=lambda c: c.area_mm2) for n in touched]
    seen = np.array([(c.x_mm, c.y_mm, 1.0) for c in largest])
    true_mm = np.array([positions[n] for n in touched]) * 1e3
    errors = np.concatenate(
        [off(seen, true_mm, fold) for fold in np.arange(len(seen)) % 10 == np.arange(10)[:, None]]
    )
    assert np.median(errors) < 6.5


def off(seen: FloatArray, true_mm: FloatArray, test: BoolArray) -> FloatArray:
    """Errors of some presses, by an affine map into the robot's frame that is fitted to others."""
    into = np.linalg.lstsq(seen[~test], true_mm[~test], rcond=None)[0]
    return np.asarray(np.linalg.norm(seen[test] @ into - true_mm[test], axis=1))


@pytest.mark.long
def test_tanks_come_as_well_through_a_board_that_prints_tables(tmp_path: Path) -> None:
    """Near what `tactomo evaluate measured` makes of the same set: 0.86 on average."""
    path = described(tmp_path, "tank_uef2017", UNSIGNED)
    sensor = load_description(path)
    tanks = read_tanks(measured("tank_uef2017.npz"), sensor)
    artifact = build_artifact(sensor)
    size = np.abs(ForwardModel(sensor, artifact.bare).bare_voltages)
    changes = tanks.changes * SCALE * TankImager(sensor, artifact).largest_scale(tanks.changes)
    noise = noise_of_reciprocity(sensor, changes)
    assert noise is not None
    rng = np.random.default_rng(0)
    rest = [size + noise * rng.standard_normal(len(size)) for _ in range(50)]
    scans, last = list(rest), []
    for change in changes:
        scans += [*rest[:3], *[size + change] * 8]
        last.append(len(scans) - 1)
    played = playing(
        *(tmp_path, np.array(scans), path, "matrix", 4.0),
        budget_ms=200.0,
        tare_scans=30,
        lossless=True,
    )
    with played as daemon:
        frames = frames_of(daemon, last[-1], missed=1)
    found = []
    for number, truth in zip(last, tanks.truth, strict=True):
        image = frames[number].structure
        assert image is not None
        found.append(correlation(on_pixels(sensor, image, truth.shape), truth))
    assert np.mean(found) > 0.82


@pytest.mark.long
def test_a_broken_device_is_flagged_in_every_frame_and_called_broken(tmp_path: Path) -> None:
    with np.load(measured("skin_bad_device_32el.npz")) as arrays:
        baseline, changes = arrays["baseline"].astype(float), arrays["dv"].astype(float)
    path = described(tmp_path, "matrix_square", "")
    path.write_text(
        path.read_text().replace("[structure]", "[map]\nnodes_x = 25\nnodes_y = 25\n\n[structure]")
    )
    sensor = load_description(path)
    table = np.vstack([baseline, baseline, baseline.mean(axis=0) + changes])
    k, m = sensor.pairs.drive[:, 0], sensor.pairs.measure[:, 0]
    scans = table.reshape(-1, 32, 32)[:, k, m]
    with playing(tmp_path, scans, path, "matrix", 10.0) as daemon:
        frames = frames_of(daemon, len(scans) - 1, missed=1)
        command = [*(sys.executable, "-m", "tactomo.cli", "doctor", "--json"), "--seconds", "3"]
        command += ["--sensor", SENSOR, "--address", daemon.stream, "--description", str(path)]
        doctor = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    pressed = [frame for number, frame in frames.items() if number >= 2 * len(baseline)]
    assert len(pressed) > 50
    assert all({"noise_high", "reference_mismatch"} <= set(frame.flags) for frame in pressed)
    assert doctor.returncode == 1
    assert json.loads(doctor.stdout)["verdict"] == "broken"

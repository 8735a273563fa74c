"""Simulating training scenes: thousands of them, on as many cores as there are.

Voltages are noise-free: noise is added in training, anew in every epoch.

The mesh is another one than the one that inverts, and coarser than the one that evaluates; within
each triangle the conductivity is the mean over nine parts (of resistivities, where contacts
conduct better). Changes differ from the evaluation's by 2 % in the structure channel and 1 % in the
magnitude channel (root mean square; twice that where contacts are small).
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from tactomo_models.archive import read_arrays, write_arrays
from tactomo_models.arrays import FloatArray
from tactomo_models.errors import DataError, ModelError, os_errors_as
from tactomo_models.physics.mesh import SheetMesh, mesh_sheet, part_middles
from tactomo_models.scene.press import strongest
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.simulation.simulator import conductivity_ratio
from tactomo_protocol import Channel
from threadpoolctl import threadpool_limits

from tactomo_lab.scenes.drawing import require_channels
from tactomo_lab.scenes.presets import TrainingScene, draw_scene
from tactomo_lab.scenes.simulation import (
    SHARP_M,
    UnevenSheet,
    displaced,
    truth_of,
    with_contrast,
    with_opposite_magnitude,
)

TOGETHER = 200  # scenes that a process simulates at a time
SCENES = "scenes.npz"  # of a folder
SPACING_SHARE = 5 / 6  # of the map's nodes' distance: 2.5 mm on the paper's sensor
REFINEMENTS = 2
PARTS = 3  # that each side of a triangle is divided into, where its conductivity is averaged
FORMAT = 4  # raise it when what is drawn or simulated changes


class SceneSimulator:
    """Simulates training scenes of one sensor.

    Raises DataError where it has no magnitude channel.
    """

    def __init__(self, description: SensorDescription) -> None:
        require_channels(description, Channel.MAGNITUDE)
        self.description = description
        # Scenes in a row may have the same sheets.
        self._last: dict[Channel, tuple[int, SheetMesh, FloatArray]] = {}

    @cached_property
    def _mesh(self) -> SheetMesh:
        spacing_m = SPACING_SHARE * self.description.spacing_m
        return mesh_sheet(self.description, spacing_m, REFINEMENTS)

    def simulate(self, scene: TrainingScene) -> dict[str, Any]:
        """Noise-free data of a scene, and its truth.

        Returns:
            For each channel `<name>_change` (M,) relative voltage changes and `<name>_rest` (M,)
            volts, single precision; `map` and `pressed` (nodes_y, nodes_x), see `Truth`, half
            precision; `contacts`, how many; `opposite`.
        """
        sensor = self.description
        if sensor.structure is not None:
            sensor = with_contrast(sensor, scene.contrast)
        if scene.opposite:
            sensor = with_opposite_magnitude(sensor)
        made: dict[str, Any] = {}
        for index, name in enumerate(self.description.channels):
            rest, change = self._channel(sensor, name, scene, index)
            made[f"{name}_rest"] = rest.astype(np.float32)
            made[f"{name}_change"] = change.astype(np.float32)
        truth = truth_of(sensor, scene.presses)
        made["map"] = truth.map.astype(np.float16)
        made["pressed"] = truth.pressed.astype(np.float16)
        made["contacts"] = np.int8(len(scene.presses))
        made["opposite"] = np.bool_(scene.opposite)
        return made

    def _channel(
        self, sensor: SensorDescription, name: Channel, scene: TrainingScene, index: int
    ) -> tuple[FloatArray, FloatArray]:
        """Volts at rest and relative changes of one channel."""
        sheet = scene.sheets[index]
        mesh, rest = self._at_rest(name, sheet, scene.displaced_m[index])
        if not scene.presses:
            return rest, np.zeros_like(rest)
        pressed = sheet.voltages(sensor, mesh, _ratio_of(sensor, name, scene, mesh))
        return rest, (pressed - rest) / np.abs(rest)

    def _at_rest(
        self, name: Channel, sheet: UnevenSheet, displaced_m: FloatArray
    ) -> tuple[SheetMesh, FloatArray]:
        """Mesh and volts (M,) of a sheet; of the last scene's, if this one has the same."""
        if name not in self._last or self._last[name][0] != sheet.seed:
            mesh = displaced(self._mesh, self.description, displaced_m)
            self._last[name] = (sheet.seed, mesh, sheet.voltages(self.description, mesh))
        return self._last[name][1:]


def _ratio_of(
    sensor: SensorDescription, name: Channel, scene: TrainingScene, mesh: SheetMesh
) -> FloatArray:
    """Conductivity of each triangle over what it is at rest, (T,)."""
    corners = mesh.mesh.p[:, mesh.mesh.t]
    x, y = np.einsum("sk,dkt->dst", np.stack(part_middles(PARTS), axis=1), corners)
    pressure, coverage = strongest(scene.presses, x, y, SHARP_M)
    ratio = conductivity_ratio(sensor, name, pressure, coverage)
    better = ratio.max() > 1
    return np.asarray(1 / (1 / ratio).mean(axis=0) if better else ratio.mean(axis=0))


def simulate_some(
    description: SensorDescription, seed: int, scenes: int, first: int
) -> dict[str, Any]:
    """Simulate up to `TOGETHER` of so many scenes, from the number `first` on, on one thread."""
    simulator = SceneSimulator(description)
    with threadpool_limits(1):
        made = [
            simulator.simulate(draw_scene(description, seed, number))
            for number in range(first, min(first + TOGETHER, scenes))
        ]
    return {key: np.stack([one[key] for one in made]) for key in made[0]}


def simulate(
    description: SensorDescription,
    folder: Path,
    scenes: int,
    *,
    seed: int = 0,
    jobs: int | None = None,
) -> Iterator[int]:
    """Simulate a set of scenes, and write it when the last one is done.

    Returns:
        How many scenes more are simulated, again and again; simulated as it is asked for.

    Raises:
        ModelError: the folder holds a set, the file cannot be written, or a process fails.
        DataError: the sensor has no magnitude channel, or no room for the contacts.
    """
    SceneSimulator(description)  # refuses a sensor it cannot serve before anything is written
    path = folder / SCENES
    if path.exists():
        raise ModelError(f"{path} is there already: choose another folder, or delete it")
    with os_errors_as(ModelError, f"cannot write {path}", "choose another folder"):
        folder.mkdir(parents=True, exist_ok=True)
    return _simulated(description, path, scenes, seed, jobs)


def _simulated(
    description: SensorDescription, path: Path, scenes: int, seed: int, jobs: int | None
) -> Iterator[int]:
    parts: list[dict[str, Any]] = []
    # Not forked: what runs threads does not survive that.
    pool = ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"))
    try:
        make = partial(simulate_some, description, seed, scenes)
        for made in (map if jobs == 1 else pool.map)(make, range(0, scenes, TOGETHER)):
            parts.append(made)
            yield len(made["map"])
    except BrokenExecutor as error:
        raise ModelError(
            "a process that simulates was killed, as happens when memory runs out; run the command "
            "again with fewer jobs"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)
    arrays = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    made_of = {"format": np.array(FORMAT), "sha256": np.array(description.sha256)}
    with os_errors_as(ModelError, f"cannot write {path}", "free some space"):
        write_arrays(path, arrays | made_of)


def read_scenes(folder: Path, description: SensorDescription) -> dict[str, Any]:
    """Read all scenes of a folder, in the order of their numbers.

    Returns:
        The arrays of `SceneSimulator.simulate`, each with a first axis of scenes.

    Raises ModelError where the folder holds none, those of another sensor, or the file is damaged.
    """
    path = folder / SCENES
    try:
        arrays = read_arrays(path)
        made_of = (int(arrays.pop("format")), str(arrays.pop("sha256")))
    except FileNotFoundError as error:
        raise ModelError(
            f"{folder} holds no simulated scenes; make some: tactomo models simulate {folder}"
        ) from error
    except (OSError, DataError, KeyError, ValueError, TypeError) as error:
        raise ModelError(f"{path} is damaged ({error}): delete it and simulate anew") from error
    if made_of != (FORMAT, description.sha256):
        raise ModelError(
            f"{path} holds scenes of format {made_of[0]}, sensor {made_of[1][:12]}; the network "
            f"needs {FORMAT}, {description.sha256[:12]}: name another folder, or simulate one"
        )
    return arrays

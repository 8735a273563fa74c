"""Simulating training scenes: thousands of them, on as many cores as there are.

Scenes are kept in shards, files of a few hundred that are drawn from their own seeds, so that an
interrupted run goes on where it stopped and shards may be made anywhere, in any order. One process
writes them, each as a whole. Voltages are noise-free: noise is added in training, anew in every
epoch.

The mesh is another one than the one that inverts, and coarser than the one that evaluates; within
each triangle the conductivity is the mean over nine parts (of resistivities, where contacts
conduct better). Changes differ from the evaluation's by 2 % in the structure channel and 1 % in the
magnitude channel (root mean square; twice that where contacts are small).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from concurrent.futures import BrokenExecutor
from contextlib import AbstractContextManager, closing
from dataclasses import asdict, dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tactomo_models.archive import read_arrays, write_arrays, write_whole
from tactomo_models.arrays import FloatArray
from tactomo_models.errors import DataError, ModelError, os_errors_as
from tactomo_models.physics.bare_sheet import scan_voltages, transfer_resistances, volts_per_unit
from tactomo_models.physics.mesh import SheetMesh, mesh_sheet
from tactomo_models.scene.press import strongest
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.simulation.simulator import conductivity_ratio, smooth_noise
from tactomo_protocol import Channel
from threadpoolctl import threadpool_limits

from tactomo_lab.scenes.drawing import require_channels
from tactomo_lab.scenes.presets import (
    SheetErrors,
    TrainingScene,
    draw_scene,
)
from tactomo_lab.scenes.simulation import (
    SHARP_M,
    displaced,
    truth_of,
    with_contrast,
    with_opposite_magnitude,
)

SHARD = 200  # scenes in a file
SPACING_SHARE = 5 / 6  # of the map's nodes' distance: 2.5 mm on the paper's sensor
REFINEMENTS = 2
PARTS = 3  # that each side of a triangle is divided into, where its conductivity is averaged
PRESET = "robust"  # what scenes are drawn by; versions before had a second one
FORMAT = 2  # raise it when what is drawn or simulated changes
MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Manifest:
    """What a folder of shards holds; a run with other settings is refused.

    Attributes:
        format: of the shards.
        preset, seed: what scenes were drawn by.
        sensor, sha256: description, and the hash of its physics.
        scenes: how many there are to be.
        responses: hash of what its channels show of a pressure; "" where that was not kept.
    """

    format: int
    preset: str
    seed: int
    sensor: str
    sha256: str
    scenes: int
    responses: str = ""


@dataclass(frozen=True)
class _Sheet:
    """A solved sheet."""

    mesh: SheetMesh  # with electrodes where they really are
    conductivity: FloatArray  # (T,) of each triangle, relative to the description's
    impedance: FloatArray  # (L,) of its electrodes, likewise
    rest: FloatArray  # (M,) volts while nothing presses


class SceneSimulator:
    """Simulates training scenes of one sensor.

    Raises DataError where it has no magnitude channel.
    """

    def __init__(self, description: SensorDescription) -> None:
        require_channels(description, Channel.MAGNITUDE)
        self.description = description
        # Scenes in a row may have the same sheets.
        self._sheets: dict[Channel, tuple[int, _Sheet]] = {}

    @cached_property
    def _mesh(self) -> SheetMesh:
        spacing_m = SPACING_SHARE * self.description.width_m / (self.description.map.nodes_x - 1)
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
            rest, change = self._channel(sensor, name, scene, scene.sheets[index])
            made[f"{name}_rest"] = rest.astype(np.float32)
            made[f"{name}_change"] = change.astype(np.float32)
        truth = truth_of(sensor, scene.presses)
        made["map"] = truth.map.astype(np.float16)
        made["pressed"] = truth.pressed.astype(np.float16)
        made["contacts"] = np.int8(len(scene.presses))
        made["opposite"] = np.bool_(scene.opposite)
        return made

    def _channel(
        self,
        sensor: SensorDescription,
        name: Channel,
        scene: TrainingScene,
        errors: SheetErrors,
    ) -> tuple[FloatArray, FloatArray]:
        """Volts at rest and relative changes of one channel."""
        sheet = self._sheet_of(name, errors)
        if not scene.presses:
            return sheet.rest, np.zeros_like(sheet.rest)
        ratio = _ratio_of(sensor, name, scene, sheet.mesh)
        pressed = self._solve(sheet.mesh, sheet.conductivity * ratio, sheet.impedance)
        return sheet.rest, (pressed - sheet.rest) / np.abs(sheet.rest)

    def _sheet_of(self, name: Channel, errors: SheetErrors) -> _Sheet:
        """The last scene's sheet, if this one has the same."""
        if name not in self._sheets or self._sheets[name][0] != errors.seed:
            self._sheets[name] = (errors.seed, self._sheet(errors))
        return self._sheets[name][1]

    def _sheet(self, errors: SheetErrors) -> _Sheet:
        """A sheet with its errors, solved at rest."""
        mesh = displaced(self._mesh, self.description, errors.displaced_m)
        x, y = mesh.mesh.p[:, mesh.mesh.t].mean(axis=1)
        rng = np.random.default_rng(errors.seed)
        field = smooth_noise(x, y, self.description.width_m / 4, rng)
        conductivity = np.exp(errors.unevenness * field)
        rest = self._solve(mesh, conductivity, errors.impedance)
        return _Sheet(mesh, conductivity, errors.impedance, rest)

    def _solve(
        self, mesh: SheetMesh, conductivity: FloatArray, impedance: FloatArray
    ) -> FloatArray:
        transfer = transfer_resistances(self.description, mesh, conductivity, impedance)
        return scan_voltages(self.description, transfer) * volts_per_unit(self.description)


def _ratio_of(
    sensor: SensorDescription, name: Channel, scene: TrainingScene, mesh: SheetMesh
) -> FloatArray:
    """Conductivity of each triangle over what it is at rest, (T,)."""
    corners = mesh.mesh.p[:, mesh.mesh.t]
    x, y = np.einsum("sk,dkt->dst", _parts(), corners)
    pressure, coverage = strongest(scene.presses, x, y, SHARP_M)
    ratio = conductivity_ratio(sensor, name, pressure, coverage)
    better = ratio.max() > 1
    return np.asarray(1 / (1 / ratio).mean(axis=0) if better else ratio.mean(axis=0))


@lru_cache(maxsize=1)
def _parts() -> FloatArray:
    """Barycentric coordinates (parts, 3) of the centroids of a triangle's equal parts."""
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(PARTS) for j in range(PARTS - i)]
    turned = [(i + 2 / 3, j + 2 / 3) for i in range(PARTS) for j in range(PARTS - i - 1)]
    second, third = np.array(upright + turned).T / PARTS
    return np.stack([1 - second - third, second, third], axis=1)


def simulate_shard(
    description: SensorDescription, seed: int, first: int, size: int
) -> dict[str, Any]:
    """Simulate the `size` scenes of a shard that begins with scene `first`, on one thread."""
    simulator = SceneSimulator(description)
    with threadpool_limits(1):
        made = [
            simulator.simulate(draw_scene(description, seed, number))
            for number in range(first, first + size)
        ]
    return {key: np.stack([one[key] for one in made]) for key in made[0]}


def shard_path(folder: Path, first: int) -> Path:
    """File of the shard that begins with a scene's number."""
    return folder / f"scenes-{first:07d}.npz"


def simulate(
    description: SensorDescription,
    folder: Path,
    scenes: int,
    *,
    seed: int = 0,
    jobs: int = -1,
) -> Iterator[int]:
    """Simulate what is missing of a set of scenes.

    Yields:
        How many scenes more are there: those of earlier runs first.

    Raises:
        ModelError: the folder holds another set, a file cannot be written, or a process fails.
        DataError: the sensor has no magnitude channel, or no room for the contacts.
        ModuleNotFoundError: joblib is not installed; it comes with tactomo-lab[train].
    """
    from joblib import Parallel, delayed  # before anything is written

    SceneSimulator(description)  # refuses a sensor it cannot serve before anything is written
    write_manifest(folder, _manifest(description, seed, scenes))
    make = partial(simulate_shard, description, seed)
    sizes = dict(shards_of(scenes))
    missing = [n for n in sizes if not is_whole(shard_path(folder, n), sizes[n])]
    yield sum(sizes.values()) - sum(sizes[first] for first in missing)

    def numbered(first: int, size: int) -> tuple[int, dict[str, Any]]:
        return first, make(first, size)

    work = (delayed(numbered)(first, sizes[first]) for first in missing)
    try:
        with closing(Parallel(n_jobs=jobs, return_as="generator_unordered")(work)) as made:
            for first, arrays in made:
                with _writing(path := shard_path(folder, first)):
                    write_arrays(path, arrays)
                yield sizes[first]
    except BrokenExecutor as error:
        raise ModelError(
            "a process that simulates was killed, as happens when memory runs out; run the same "
            "command again with fewer jobs: it goes on where it stopped"
        ) from error


def shards_of(scenes: int) -> Iterator[tuple[int, int]]:
    """Number of the first scene of each shard, and how many scenes it has at least."""
    for first in range(0, scenes, SHARD):
        yield first, min(SHARD, scenes - first)


def _writing(path: Path) -> AbstractContextManager[None]:
    """Say what to do where a file of a set cannot be written."""
    again = "then run the same command again: it goes on where it stopped"
    next_step = f"free some space or choose another folder, {again}"
    return os_errors_as(ModelError, f"cannot write {path}", next_step)


def _manifest(description: SensorDescription, seed: int, scenes: int) -> Manifest:
    channels = description.model_dump_json(include={"magnitude", "structure"})
    responses = hashlib.sha256(channels.encode()).hexdigest()
    return Manifest(FORMAT, PRESET, seed, description.name, description.sha256, scenes, responses)


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Say in a folder what its shards are; the number of scenes may change.

    Raises ModelError where it holds something else, or cannot be written.
    """
    path = folder / MANIFEST
    if path.exists():
        for name, old, new in _differences(read_manifest(folder), manifest):
            raise ModelError(
                f"{folder} holds scenes made with another {name}, {old}, not {new}: choose another "
                "folder, or delete this one"
            )
    content = json.dumps(asdict(manifest), indent=2) + "\n"
    with _writing(path):
        write_whole(path, lambda file: file.write(content.encode()))


def _differences(old: Manifest, new: Manifest) -> Iterator[tuple[str, str, str]]:
    for name in ("format", "preset", "seed", "sensor", "sha256", "responses"):
        before, now = str(getattr(old, name)), str(getattr(new, name))
        if before != now and before:
            yield name, before[:16], now[:16]


def read_manifest(folder: Path) -> Manifest:
    """Read what a folder of shards holds.

    Raises ModelError where there is none, or it is damaged.
    """
    path = folder / MANIFEST
    try:
        return Manifest(**json.loads(path.read_text()))
    except FileNotFoundError as error:
        raise ModelError(
            f"{folder} holds no simulated scenes; make some: tactomo models simulate {folder}"
        ) from error
    except (OSError, ValueError, TypeError) as error:
        raise ModelError(
            f"{path} is damaged ({error}): delete the folder and simulate anew"
        ) from error


def read_scenes(folder: Path) -> dict[str, Any]:
    """Read all scenes of a folder, in the order of their numbers.

    Returns:
        The arrays of `SceneSimulator.simulate`, each with a first axis of scenes.

    Raises ModelError where the folder holds none, is not complete, or a file is damaged.
    """
    shards = [
        read_shard(shard_path(folder, first), size)
        for first, size in shards_of(read_manifest(folder).scenes)
    ]
    return {key: np.concatenate([shard[key] for shard in shards]) for key in shards[0]}


def read_shard(path: Path, size: int) -> dict[str, Any]:
    """Read the first scenes of a shard, which has more if the set was larger once."""
    try:
        arrays = read_arrays(path)
    except FileNotFoundError:
        arrays = {}
    except (OSError, DataError) as error:
        raise ModelError(
            f"{error}; run `tactomo models simulate` again, it makes damaged files anew"
        ) from error
    if _length(arrays) < size:
        raise ModelError(
            f"{path.parent} is not complete, {path.name} is missing or short: run `tactomo models "
            "simulate` again, it goes on where it stopped"
        )
    return {key: array[:size] for key, array in arrays.items()}


def is_whole(path: Path, size: int) -> bool:
    """Tell whether a shard is there, undamaged, with at least so many scenes."""
    try:
        return _length(read_arrays(path)) >= size
    except (OSError, DataError):
        return False


def _length(arrays: Mapping[str, NDArray[Any]]) -> int:
    return min((len(array) for array in arrays.values()), default=0)

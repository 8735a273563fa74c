"""Simulating training scenes: thousands of them, on as many cores or machines as there are.

Scenes are kept in shards, files of a few hundred that are drawn from their own seeds, so that an
interrupted run goes on where it stopped and shards may be made anywhere, in any order. Voltages
are noise-free: noise is added in training, anew in every epoch.

The mesh is another one than the one that inverts, and coarser than the one that evaluates; within
each triangle the conductivity is the mean over nine parts (of resistivities, where contacts
conduct better). Changes are right to 1.5 % of the structure channel's, 0.5 % of the magnitude's.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import skfem
from numpy.typing import NDArray

from tactomo_models.archive import read_arrays
from tactomo_models.description import Modality, SensorDescription
from tactomo_models.errors import DataError, ModelError
from tactomo_models.evaluation.simulation import (
    truth_of,
    with_contrast,
    with_opposite_magnitude,
)
from tactomo_models.forward import scan_voltages, transfer_resistances, volts_per_unit
from tactomo_models.mesh import SheetMesh, mesh_sheet
from tactomo_models.scene import strongest
from tactomo_models.simulator import conductivity_ratio, smooth_noise
from tactomo_models.training.presets import (
    PresetName,
    SheetErrors,
    TrainingScene,
    draw_scene,
)

FloatArray = NDArray[np.float64]

SHARD = 200  # scenes in a file
SPACING_SHARE = 5 / 6  # of the map's nodes' distance: 2.5 mm on the paper's sensor
REFINEMENTS = 2
PARTS = 3  # that each side of a triangle is divided into, where its conductivity is averaged
SHARP_M = 1e-9  # width of an outline: a point lies inside or outside
ELECTRODE_REACH_M = 0.008  # of the stretch around an electrode that sits off its place
FORMAT = 1
MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Manifest:
    """What a folder of shards holds; a run with other settings is refused.

    Attributes:
        format: of the shards.
        preset, seed: what scenes were drawn by.
        sensor, sha256: description, and the hash of its physics.
        scenes: how many there are to be.
    """

    format: int
    preset: str
    seed: int
    sensor: str
    sha256: str
    scenes: int


@dataclass(frozen=True)
class _Sheet:
    """A solved sheet.

    Attributes:
        mesh: with electrodes where they really are.
        conductivity: (T,) of each triangle, relative to the description's.
        impedance: (L,) of its electrodes, likewise; all 1 if None.
        rest: (M,) volts while nothing presses.
    """

    mesh: SheetMesh
    conductivity: FloatArray
    impedance: FloatArray | None
    rest: FloatArray


class SceneSimulator:
    """Simulates training scenes of one sensor.

    Args:
        description: the sensor; needs both channels.

    Raises:
        DataError: it has one channel.
    """

    def __init__(self, description: SensorDescription) -> None:
        if len(description.modalities) < 2:
            raise DataError(
                f"sensor {description.name!r} has one channel; training scenes need a magnitude "
                "and a structure channel: choose another description"
            )
        self.description = description
        # Scenes in a row may have the same sheets.
        self._sheets: dict[Modality, tuple[int | None, _Sheet]] = {}

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
        sensor = with_contrast(self.description, scene.contrast)
        if scene.opposite:
            sensor = with_opposite_magnitude(sensor)
        made: dict[str, Any] = {}
        for index, name in enumerate(self.description.modalities):
            errors = scene.sheets[index] if scene.sheets else None
            rest, change = self._channel(sensor, name, scene, errors)
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
        name: Modality,
        scene: TrainingScene,
        errors: SheetErrors | None,
    ) -> tuple[FloatArray, FloatArray]:
        """Volts at rest and relative changes of one channel."""
        seed = errors.seed if errors else None
        if name not in self._sheets or self._sheets[name][0] != seed:
            self._sheets[name] = (seed, self._sheet(errors))
        sheet = self._sheets[name][1]
        if not scene.presses:
            return sheet.rest, np.zeros_like(sheet.rest)
        ratio = _ratio_of(sensor, name, scene, sheet.mesh)
        pressed = self._solve(sheet.mesh, sheet.conductivity * ratio, sheet.impedance)
        return sheet.rest, (pressed - sheet.rest) / np.abs(sheet.rest)

    def _sheet(self, errors: SheetErrors | None) -> _Sheet:
        """A sheet with its errors, solved at rest."""
        mesh, impedance = self._mesh, None
        conductivity = np.ones(mesh.mesh.t.shape[1])
        if errors is not None:
            mesh, impedance = (
                displaced(mesh, self.description, errors.displaced_m),
                errors.impedance,
            )
            x, y = mesh.mesh.p[:, mesh.mesh.t].mean(axis=1)
            rng = np.random.default_rng(errors.seed)
            field = smooth_noise(x, y, self.description.width_m / 4, rng)
            conductivity = np.exp(errors.unevenness * field)
        return _Sheet(mesh, conductivity, impedance, self._solve(mesh, conductivity, impedance))

    def _solve(
        self, mesh: SheetMesh, conductivity: FloatArray, impedance: FloatArray | None
    ) -> FloatArray:
        transfer = transfer_resistances(self.description, mesh, conductivity, impedance)
        return scan_voltages(self.description, transfer) * volts_per_unit(self.description)


def _ratio_of(
    sensor: SensorDescription, name: Modality, scene: TrainingScene, mesh: SheetMesh
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


def displaced(
    sheet: SheetMesh, description: SensorDescription, displaced_m: FloatArray
) -> SheetMesh:
    """Mesh of a sheet whose electrodes sit off their places.

    Args:
        sheet: mesh with the electrodes in place.
        description: the sensor.
        displaced_m: (L,) by how much along the rim, counter-clockwise.
    """
    ends = description.electrode_ends_m
    along = ends[:, 1] - ends[:, 0]
    step = displaced_m[:, None] * along / np.linalg.norm(along, axis=1, keepdims=True)
    off = sheet.mesh.p.T[:, None, :] - description.electrode_centres_m
    reach = np.exp(-0.5 * (off**2).sum(axis=2) / ELECTRODE_REACH_M**2)
    return SheetMesh(
        skfem.MeshTri(sheet.mesh.p + (reach @ step).T, sheet.mesh.t), sheet.electrode_facets
    )


def simulate_shard(
    description: SensorDescription,
    preset: PresetName,
    seed: int,
    folder: str,
    first: int,
    last: int,
) -> int:
    """Simulate scenes `first` to before `last` into their file.

    Returns:
        How many scenes it holds.

    Raises:
        ModelError: the file cannot be written.
    """
    simulator = _simulator(description.model_dump_json(by_alias=True))
    made = [
        simulator.simulate(draw_scene(preset, description, seed, number))
        for number in range(first, last)
    ]
    arrays: dict[str, Any] = {key: np.stack([one[key] for one in made]) for key in made[0]}
    path = _shard_path(Path(folder), first)
    part = path.with_name(f".{path.name}.part")
    try:
        with part.open("wb") as file:
            np.savez_compressed(file, **arrays)
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise ModelError(
            f"cannot write {path}: {error.strerror}; free some space, then run the same command "
            "again: it goes on where it stopped"
        ) from error
    return last - first


@lru_cache(maxsize=2)
def _simulator(description: str) -> SceneSimulator:
    """One for each process."""
    return SceneSimulator(SensorDescription.model_validate_json(description))


def _shard_path(folder: Path, first: int) -> Path:
    return folder / f"scenes-{first:07d}.npz"


def simulate(
    description: SensorDescription,
    preset: PresetName,
    folder: Path,
    scenes: int,
    *,
    seed: int = 0,
    jobs: int = -1,
    dask: str | None = None,
) -> Iterator[int]:
    """Simulate what is missing of a set of scenes.

    Args:
        description: the sensor.
        preset: what scenes are like.
        folder: where the shards go.
        scenes: how many; a set can be enlarged later.
        seed: of the set.
        jobs: processes; -1 for one on every core.
        dask: address of a Dask scheduler whose workers do the work instead, and see the folder.

    Yields:
        How many scenes more are there: those of earlier runs first.

    Raises:
        ModelError: the folder holds another set, or a file cannot be written.
        DataError: the sensor has one channel, or no room for the contacts.
    """
    from joblib import Parallel, delayed, parallel_config

    SceneSimulator(description)  # refuses a sensor it cannot serve before anything is written
    write_manifest(
        folder, Manifest(FORMAT, preset, seed, description.name, description.sha256, scenes)
    )
    shards = [(first, min(first + SHARD, scenes)) for first in range(0, scenes, SHARD)]
    missing = [shard for shard in shards if not _is_whole(folder, *shard)]
    yield sum(last - first for first, last in shards) - sum(b - a for a, b in missing)
    work = (
        delayed(simulate_shard)(description, preset, seed, str(folder), first, last)
        for first, last in missing
    )
    where = parallel_config("dask") if dask else parallel_config(n_jobs=jobs)
    with _on_cluster(dask) if dask else nullcontext(), where:
        yield from Parallel(return_as="generator_unordered")(work)


def _on_cluster(address: str) -> Any:
    from distributed import Client

    try:
        return Client(address, timeout="10s")
    except OSError as error:
        raise ModelError(
            f"no Dask scheduler answers at {address}: start one with `dask scheduler`, or leave "
            "--dask out to use this machine's cores"
        ) from error


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Say in a folder what its shards are; the number of scenes may grow.

    Raises:
        ModelError: it holds something else, or cannot be written.
    """
    path = folder / MANIFEST
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if path.exists():
            there = read_manifest(folder)
            for name, old, new in _differences(there, manifest):
                raise ModelError(
                    f"{folder} holds scenes of {name} {old}, not {new}: choose another folder, or "
                    "delete this one"
                )
        path.write_text(json.dumps(asdict(manifest), indent=2) + "\n")
    except OSError as error:
        raise ModelError(
            f"cannot write to {folder}: {error.strerror}; choose another folder"
        ) from error


def _differences(old: Manifest, new: Manifest) -> Iterator[tuple[str, Any, Any]]:
    for name in ("format", "preset", "seed", "sensor", "sha256"):
        if getattr(old, name) != getattr(new, name):
            yield name, getattr(old, name), getattr(new, name)


def read_manifest(folder: Path) -> Manifest:
    """Read what a folder of shards holds.

    Raises:
        ModelError: there is none, or it is damaged.
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


def _is_whole(folder: Path, first: int, last: int) -> bool:
    """Tell whether a shard is there with all its scenes; a damaged one is made anew."""
    try:
        return len(read_arrays(_shard_path(folder, first))["contacts"]) == last - first
    except (OSError, KeyError, ValueError, DataError):
        return False


def read_scenes(folder: Path) -> dict[str, Any]:
    """Read all scenes of a folder, in the order of their numbers.

    Returns:
        The arrays of `SceneSimulator.simulate`, each with a first axis of scenes.

    Raises:
        ModelError: the folder holds none, is not complete, or a file is damaged.
    """
    manifest = read_manifest(folder)
    shards = []
    for first in range(0, manifest.scenes, SHARD):
        path = _shard_path(folder, first)
        try:
            shards.append(read_arrays(path))
        except FileNotFoundError as error:
            raise ModelError(
                f"{folder} is not complete: {path.name} is missing; run tactomo models simulate "
                "again, it goes on where it stopped"
            ) from error
        except (OSError, ValueError, DataError) as error:
            raise ModelError(
                f"{path} is damaged ({error}): delete it and simulate again"
            ) from error
    return {key: np.concatenate([shard[key] for shard in shards]) for key in shards[0]}


def shard_paths(folder: Path) -> list[Path]:
    """The files of a folder's scenes, in the order of their numbers.

    Raises:
        ModelError: the folder holds no scenes.
    """
    scenes = read_manifest(folder).scenes
    return [_shard_path(folder, first) for first in range(0, scenes, SHARD)]

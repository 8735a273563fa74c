"""What the physics makes of noisy training scenes: what the refining network is given.

Each scene gets its noise once, and is reconstructed from a cold start as the hybrid does it. The
outcome is kept beside the scenes, with the filtered data that it was made of.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from tactomo_models.archive import read_arrays
from tactomo_models.batch import BUDGET_S
from tactomo_models.errors import DataError, ModelError
from tactomo_models.methods.auto import Auto
from tactomo_models.methods.trained_networks import FusionNetwork, SensorNetworks
from tactomo_models.reconstruct import Reconstructor
from tactomo_models.scans.changes import towards_pressing
from tactomo_models.scans.reference import Reference
from tactomo_models.sensor.description import SensorDescription
from tactomo_protocol import Channel

from tactomo_lab.scenes.simulation import with_opposite_magnitude
from tactomo_lab.scenes.still_scenes import REFERENCE_SCANS, seed_of
from tactomo_lab.training.training_scenes import (
    make_shards,
    read_manifest,
    read_shard,
    shard_path,
    shards_of,
)

REFINER_INPUTS = "refiner_inputs"  # begins the names of the files that hold them
MAX_REFINER_SCENES = 10_000  # scenes of a set that are reconstructed: a twentieth of a second each
SNR_DB = (8.0, 60.0)  # of the changes, drawn evenly
VOLTAGE_SNR_DB = (35.0, 70.0)  # of the voltages, for the rest of the scenes
OF_VOLTAGE = 0.2  # share of scenes whose noise goes by the voltages
NAMES: tuple[Channel, ...] = (Channel.MAGNITUDE, Channel.STRUCTURE)


def make_refiner_inputs(
    description: SensorDescription, folder: Path, scenes: int, *, jobs: int = -1
) -> Iterator[int]:
    """Make what is missing for the first scenes of a folder.

    Args:
        description: the sensor; its network must have been trained.
        folder: of simulated scenes.
        scenes: how many, rounded up to whole shards.
        jobs: processes; -1 for one on every core.

    Yields:
        How many scenes more have theirs: those of earlier runs first.

    Raises:
        ModelError: a file is missing, damaged, or cannot be written; there is no network.
    """
    shards = [shard for shard in shards_of(read_manifest(folder).scenes) if shard[0] < scenes]
    make = partial(_input_shard, description.model_dump_json(by_alias=True), folder)
    # Scenes without contacts are left out: a whole file may be shorter than its shard.
    yield from make_shards(
        folder, REFINER_INPUTS, shards, make, is_there=lambda path, _: path.exists(), jobs=jobs
    )


def read_refiner_inputs(folder: Path) -> dict[str, Any]:
    """Read all there are.

    Returns:
        `number` (n,) of each scene, `inputs` (n, K) filtered data, `map` and `structure`
        (n, nodes_y, nodes_x) as the physics sees them, `true_map` and `pressed` likewise,
        `contacts` (n,), `snr_db` (n,) of the changes.

    Raises:
        ModelError: there are none, or they are damaged.
    """
    all_paths = (
        shard_path(folder, first, REFINER_INPUTS)
        for first, _ in shards_of(read_manifest(folder).scenes)
    )
    paths = [path for path in all_paths if path.exists()]
    if not paths:
        raise ModelError(
            f"{folder} holds nothing for the refining network to learn from; make it: "
            "tactomo models train --configuration refiner does so first"
        )
    try:
        shards = [read_arrays(path) for path in paths]
    except (OSError, DataError) as error:
        raise ModelError(f"{error}: delete the file and run the same command again") from error
    return {key: np.concatenate([shard[key] for shard in shards]) for key in shards[0]}


def _input_shard(description: str, folder: Path, first: int, size: int) -> dict[str, Any]:
    """Reconstruct the scenes with contacts of the shard that begins with scene `first`."""
    scenes = read_shard(shard_path(folder, first), size)
    reconstructors = _reconstructors(description)
    made: dict[str, list[Any]] = {}
    for index in range(len(scenes["contacts"])):
        if not scenes["map"][index].any():
            continue
        rng = np.random.default_rng(seed_of("training", "sights", first + index))
        reconstructor = reconstructors[bool(scenes["opposite"][index])]
        one = _refiner_input(scenes, index, reconstructor, _network(description), rng)
        one["number"] = np.int64(first + index)
        for key, value in one.items():
            made.setdefault(key, []).append(value)
    return {key: np.stack(values) for key, values in made.items()}


def _refiner_input(
    scenes: dict[str, Any],
    index: int,
    reconstructor: Reconstructor,
    network: FusionNetwork,
    rng: np.random.Generator,
) -> dict[str, Any]:
    by_voltage = rng.random() < OF_VOLTAGE
    snr_db = rng.uniform(*(VOLTAGE_SNR_DB if by_voltage else SNR_DB))
    scans, rest = {}, {}
    for name in NAMES:
        still = scenes[f"{name}_rest"][index].astype(np.float64)
        change = np.abs(still) * scenes[f"{name}_change"][index]
        signal = still if by_voltage else change
        std = float(np.sqrt(np.mean(signal**2))) * 10 ** (-snr_db / 20)
        noise = std * rng.standard_normal((1 + REFERENCE_SCANS, len(still)))
        scans[name], rest[name] = still + change + noise[0], still + noise[1:]
    reconstructor.set_reference(
        Reference.from_scans(rest[Channel.MAGNITUDE], rest[Channel.STRUCTURE])
    )
    measurement = reconstructor.compare(scans[Channel.MAGNITUDE], scans[Channel.STRUCTURE])
    frame = reconstructor.solve(measurement)
    description = reconstructor.description
    inputs = network.filtered(*towards_pressing(description, measurement.changes))
    assert frame.map is not None
    assert frame.structure is not None
    return {
        "inputs": inputs.astype(np.float32),
        "map": frame.map.astype(np.float16),
        Channel.STRUCTURE: frame.structure.astype(np.float16),
        "true_map": scenes["map"][index],
        "pressed": scenes["pressed"][index],
        "contacts": scenes["contacts"][index],
        "snr_db": np.float32(np.nan if by_voltage else snr_db),
    }


@lru_cache(maxsize=1)
def _network(description: str) -> FusionNetwork:
    return SensorNetworks(SensorDescription.model_validate_json(description)).fusion


@lru_cache(maxsize=2)
def _reconstructors(description: str) -> dict[bool, Reconstructor]:
    """One for each sign of the magnitude channel, in each process."""
    sensor = SensorDescription.model_validate_json(description)
    return {
        opposite: Reconstructor(
            with_opposite_magnitude(sensor) if opposite else sensor,
            method=Auto(refines=False),
            budget_s=BUDGET_S,
        )
        for opposite in (False, True)
    }

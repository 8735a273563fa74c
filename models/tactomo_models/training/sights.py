"""What the physics makes of noisy training scenes: what the refining network is given.

Each scene gets its noise once, and is reconstructed from a cold start as the hybrid does it. The
outcome is kept beside the scenes, with the filtered data that it was made of.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from tactomo_models.archive import read_arrays, write_arrays
from tactomo_models.batch import BUDGET_S
from tactomo_models.description import Modality, SensorDescription
from tactomo_models.errors import ModelError
from tactomo_models.evaluation.scenes import REFERENCE_SCANS, seed_of
from tactomo_models.evaluation.simulation import with_opposite_magnitude
from tactomo_models.reconstruct import Reconstructor
from tactomo_models.reference import Reference
from tactomo_models.tier import Tier
from tactomo_models.training.simulate import (
    on_cores,
    read_manifest,
    read_shard,
    shard_path,
    shards_of,
    writing,
)

SIGHTS = "sights"  # begins the names of the files that hold them
MOST_SIGHTS = 10_000  # scenes of a set that are reconstructed: a twentieth of a second each
SNR_DB = (8.0, 60.0)  # of the changes, drawn evenly
VOLTAGE_SNR_DB = (35.0, 70.0)  # of the voltages, for the rest of the scenes
OF_VOLTAGE = 0.2  # share of scenes whose noise goes by the voltages
NAMES: tuple[Modality, ...] = ("magnitude", "structure")


def make_sights(
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
    from joblib import delayed

    shards = [shard for shard in shards_of(read_manifest(folder).scenes) if shard[0] < scenes]
    missing = {
        first: size for first, size in shards if not shard_path(folder, first, SIGHTS).exists()
    }
    yield sum(size for _, size in shards) - sum(missing.values())
    as_json = description.model_dump_json(by_alias=True)
    work = (
        delayed(_sight_shard)(as_json, str(folder), first, size) for first, size in missing.items()
    )
    with on_cores(jobs) as parallel, closing(parallel(work)) as made:
        for first in made:
            yield missing[first]


def read_sights(folder: Path) -> dict[str, Any]:
    """Read all there are.

    Returns:
        `number` (n,) of each scene, `inputs` (n, K) filtered data, `map` and `structure`
        (n, nodes_y, nodes_x) as the physics sees them, `true_map` and `pressed` likewise,
        `contacts` (n,), `snr_db` (n,) of the changes.

    Raises:
        ModelError: there are none, or they are damaged.
    """
    all_paths = (
        shard_path(folder, first, SIGHTS) for first, _ in shards_of(read_manifest(folder).scenes)
    )
    paths = [path for path in all_paths if path.exists()]
    if not paths:
        raise ModelError(
            f"{folder} holds nothing for the refining network to learn from; make it: "
            "tactomo models train --recipe refiner does so first"
        )
    try:
        shards = [read_arrays(path) for path in paths]
    except (OSError, ModelError) as error:
        raise ModelError(f"{error}: delete the file and run the same command again") from error
    return {key: np.concatenate([shard[key] for shard in shards]) for key in shards[0]}


def _sight_shard(description: str, folder: str, first: int, size: int) -> int:
    """Reconstruct the scenes with contacts of the shard that begins with `first`; returns it."""
    scenes = read_shard(shard_path(Path(folder), first), size)
    reconstructors = _reconstructors(description)
    made: dict[str, list[Any]] = {}
    for index in range(len(scenes["contacts"])):
        if not scenes["map"][index].any():
            continue
        rng = np.random.default_rng(seed_of("training", "sights", first + index))
        reconstructor = reconstructors[bool(scenes["opposite"][index])]
        one = _sight(scenes, index, reconstructor, rng)
        one["number"] = np.int64(first + index)
        for key, value in one.items():
            made.setdefault(key, []).append(value)
    with writing(shard_path(Path(folder), first, SIGHTS)) as target:
        write_arrays(target, {key: np.stack(values) for key, values in made.items()})
    return first


def _sight(
    scenes: dict[str, Any], index: int, reconstructor: Reconstructor, rng: np.random.Generator
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
    reconstructor.set_reference(Reference.from_scans(rest["magnitude"], rest["structure"]))
    frame = reconstructor.reconstruct(scans["magnitude"], scans["structure"])
    inputs = reconstructor.network_inputs(scans["magnitude"], scans["structure"])
    assert frame.map is not None
    assert frame.structure is not None
    return {
        "inputs": inputs.astype(np.float32),
        "map": frame.map.astype(np.float16),
        "structure": frame.structure.astype(np.float16),
        "true_map": scenes["map"][index],
        "pressed": scenes["pressed"][index],
        "contacts": scenes["contacts"][index],
        "snr_db": np.float32(np.nan if by_voltage else snr_db),
    }


@lru_cache(maxsize=2)
def _reconstructors(description: str) -> dict[bool, Reconstructor]:
    """One for each sign of the magnitude channel, in each process."""
    sensor = SensorDescription.model_validate_json(description)
    return {
        opposite: Reconstructor(
            with_opposite_magnitude(sensor) if opposite else sensor,
            tier=Tier.HYBRID,
            budget_s=BUDGET_S,
            redraw=False,
        )
        for opposite in (False, True)
    }

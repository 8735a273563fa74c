"""What the physics makes of noisy training scenes: what the refining network is given.

Each scene gets its noise once, and is reconstructed from a cold start as the hybrid does it. The
outcome is kept beside the scenes, with the filtered data that it was made of.
"""

from __future__ import annotations

from collections.abc import Iterator
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
from tactomo_models.reconstruct import Reconstructor, Tier
from tactomo_models.reference import Reference
from tactomo_models.training.simulate import shard_paths

SIGHTS = 10_000  # scenes of a set that are reconstructed, at most: a twentieth of a second each
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
    from joblib import Parallel, delayed

    shards = [path for path in shard_paths(folder) if _first_scene(path) < scenes]
    missing = [path for path in shards if not _sights_path(path).exists()]
    yield round(scenes * (1 - len(missing) / len(shards)))
    as_json = description.model_dump_json(by_alias=True)
    work = (delayed(_sight_shard)(as_json, str(path)) for path in missing)
    yield from Parallel(n_jobs=jobs, return_as="generator_unordered")(work)


def read_sights(folder: Path) -> dict[str, Any]:
    """Read all there are.

    Returns:
        `number` (n,) of each scene, `inputs` (n, K) filtered data, `map` and `structure`
        (n, nodes_y, nodes_x) as the physics sees them, `true_map` and `pressed` likewise,
        `contacts` (n,), `snr_db` (n,) of the changes.

    Raises:
        ModelError: there are none, or they are damaged.
    """
    paths = [path for path in map(_sights_path, shard_paths(folder)) if path.exists()]
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


def _first_scene(shard: Path) -> int:
    return int(shard.stem.rpartition("-")[2])


def _sights_path(shard: Path) -> Path:
    return shard.with_name(shard.name.replace("scenes", "sights"))


def _sight_shard(description: str, path: str) -> int:
    """Reconstruct one shard's scenes that have contacts; says how many scenes it has."""
    scenes, first = read_arrays(Path(path)), _first_scene(Path(path))
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
    target = _sights_path(Path(path))
    try:
        write_arrays(target, {key: np.stack(values) for key, values in made.items()})
    except OSError as error:
        raise ModelError(
            f"cannot write {target}: {error.strerror}; free some space, then run the same command "
            "again: it goes on where it stopped"
        ) from error
    return len(scenes["contacts"])


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

"""The images that the paper's networks are given, made once for a folder of scenes.

Tikhonov's image of the magnitude channel and the paper's level set of the structure channel, of
noise-free data, as the paper trains on (section III-C-2). They are kept beside the scenes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from tactomo_models.archive import write_arrays
from tactomo_models.description import Modality, SensorDescription
from tactomo_models.evaluation.simulation import with_opposite_magnitude
from tactomo_models.reconstruct import Reconstructor
from tactomo_models.reference import Reference
from tactomo_models.tier import Tier
from tactomo_models.training.simulate import (
    is_whole,
    on_cores,
    read_manifest,
    read_shard,
    read_shards,
    shard_path,
    shards_of,
    writing,
)

IMAGES = "images"  # begins the names of the files that hold them


def make_images(description: SensorDescription, folder: Path, *, jobs: int = -1) -> Iterator[int]:
    """Make what is missing of a folder's images.

    Args:
        description: the sensor.
        folder: of simulated scenes.
        jobs: processes; -1 for one on every core.

    Yields:
        How many scenes more have theirs: those of earlier runs first.

    Raises:
        ModelError: a file is missing, damaged, or cannot be written.
    """
    from joblib import delayed

    scenes = read_manifest(folder).scenes
    missing = {
        first: size
        for first, size in shards_of(scenes)
        if not is_whole(shard_path(folder, first, IMAGES), size)
    }
    yield scenes - sum(missing.values())
    as_json = description.model_dump_json(by_alias=True)
    work = (
        delayed(_image_shard)(as_json, str(folder), first, size) for first, size in missing.items()
    )
    with on_cores(jobs) as parallel, closing(parallel(work)) as made:
        for first in made:
            yield missing[first]


def read_images(folder: Path) -> dict[str, Any]:
    """`magnitude` and `structure`, (scenes, nodes_y, nodes_x) each.

    Raises:
        ModelError: some are missing or damaged.
    """
    return read_shards(folder, IMAGES)


def _image_shard(description: str, folder: str, first: int, size: int) -> int:
    """Make the images of the shard that begins with scene `first`; returns that."""
    scenes = read_shard(shard_path(Path(folder), first), size)
    reconstructors = _reconstructors(description)
    made: dict[Modality, list[Any]] = {"magnitude": [], "structure": []}
    last: dict[bool, bytes] = {}  # what each measures changes against: the paper's sheet is one
    for number in range(len(scenes["contacts"])):
        rest = {name: scenes[f"{name}_rest"][number].astype(np.float64) for name in made}
        volts = {
            name: rest[name] + np.abs(rest[name]) * scenes[f"{name}_change"][number]
            for name in made
        }
        opposite = bool(scenes["opposite"][number])
        reconstructor, at_rest = reconstructors[opposite], rest["magnitude"].tobytes()
        if last.get(opposite) != at_rest:
            reconstructor.set_reference(Reference(rest["magnitude"], rest["structure"]))
            last[opposite] = at_rest
        images = reconstructor.preliminary_images(volts["magnitude"], volts["structure"])
        for name, image in images.items():
            made[name].append(image.astype(np.float16))
    with writing(shard_path(Path(folder), first, IMAGES)) as target:
        write_arrays(target, {name: np.stack(images) for name, images in made.items()})
    return first


@lru_cache(maxsize=2)
def _reconstructors(description: str) -> dict[bool, Reconstructor]:
    """One for each sign of the magnitude channel, in each process."""
    sensor = SensorDescription.model_validate_json(description)
    return {
        False: Reconstructor(sensor, tier=Tier.PLS_PAPER),
        True: Reconstructor(with_opposite_magnitude(sensor), tier=Tier.PLS_PAPER),
    }

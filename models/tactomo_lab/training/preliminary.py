"""The images that the paper's networks are given, made once for a folder of scenes.

Tikhonov's image of the magnitude channel and the paper's level set of the structure channel, of
noise-free data, as the paper trains on (section III-C-2). They are kept beside the scenes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.methods.method import Skin
from tactomo_models.scans.reference import Reference
from tactomo_models.scans.tare import Tare
from tactomo_models.sensor.description import SensorDescription
from tactomo_protocol import Channel

from tactomo_lab.baselines.paper_methods import PreliminaryImages
from tactomo_lab.scenes.simulation import with_opposite_magnitude
from tactomo_lab.training.training_scenes import (
    make_shards,
    read_manifest,
    read_shard,
    read_shards,
    shard_path,
    shards_of,
)

IMAGES = "images"  # begins the names of the files that hold them


def make_images(description: SensorDescription, folder: Path, *, jobs: int = -1) -> Iterator[int]:
    """Make what is missing of a folder's images.

    Yields:
        How many scenes more have theirs: those of earlier runs first.

    Raises:
        ModelError: a file is missing, damaged, or cannot be written.
    """
    shards = shards_of(read_manifest(folder).scenes)
    as_json = description.model_dump_json(by_alias=True)
    make = partial(_image_shard, as_json, folder)
    yield from make_shards(folder, IMAGES, shards, make, jobs=jobs)


def read_images(folder: Path) -> dict[str, Any]:
    """`magnitude` and `structure`, (scenes, nodes_y, nodes_x) each.

    Raises:
        ModelError: some are missing or damaged.
    """
    return read_shards(folder, IMAGES)


def _image_shard(description: str, folder: Path, first: int, size: int) -> dict[str, Any]:
    """Make the images of the shard that begins with scene `first`."""
    scenes = read_shard(shard_path(folder, first), size)
    imagers = _imagers(description)
    made: dict[Channel, list[Any]] = {Channel.MAGNITUDE: [], Channel.STRUCTURE: []}
    last: dict[bool, bytes] = {}  # what each measures changes against: the paper's sheet is one
    for number in range(len(scenes["contacts"])):
        rest = {name: scenes[f"{name}_rest"][number].astype(np.float64) for name in made}
        volts = {
            name: rest[name] + np.abs(rest[name]) * scenes[f"{name}_change"][number]
            for name in made
        }
        opposite = bool(scenes["opposite"][number])
        imager, at_rest = imagers[opposite], rest[Channel.MAGNITUDE].tobytes()
        if last.get(opposite) != at_rest:
            imager.set_reference(Reference(rest[Channel.MAGNITUDE], rest[Channel.STRUCTURE]))
            last[opposite] = at_rest
        for name, image in imager.images(volts).items():
            made[name].append(image.astype(np.float16))
    return {name: np.stack(images) for name, images in made.items()}


class _Imager:
    """Makes the images of one sensor's scans."""

    def __init__(self, description: SensorDescription) -> None:
        self._skin = Skin.of(description)

    def set_reference(self, reference: Reference) -> None:
        tare = Tare.take(self._skin.tare.sensor, reference)
        self._skin = replace(self._skin, tare=tare)
        self._images = PreliminaryImages(self._skin)

    def images(self, volts: dict[Channel, FloatArray]) -> dict[Channel, FloatArray]:
        """Images (nodes_y, nodes_x) of both channels' scans (M,)."""
        scans = (volts[Channel.MAGNITUDE], volts[Channel.STRUCTURE])
        if self._skin.tare.asks_noise:
            self._skin = replace(self._skin, tare=self._skin.tare.with_noise_of(*scans))
        return self._images.of(self._skin.tare.changes(*scans).changes, volts.keys())


@lru_cache(maxsize=2)
def _imagers(description: str) -> dict[bool, _Imager]:
    """One for each sign of the magnitude channel, in each process."""
    sensor = SensorDescription.model_validate_json(description)
    return {False: _Imager(sensor), True: _Imager(with_opposite_magnitude(sensor))}

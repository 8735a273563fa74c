"""Configurations: which network is trained, how long, and how it is exported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import torch
from tactomo_models.arrays import FloatArray
from tactomo_models.errors import ModelError
from tactomo_models.methods.trained_networks import outputs_of
from tactomo_models.physics.artifact import load_or_build_artifact
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.sensor.description import SensorDescription
from tactomo_protocol import Channel

from tactomo_lab.scenes.measures import full_range
from tactomo_lab.training.batches import SceneBatches
from tactomo_lab.training.export import export, notes_of
from tactomo_lab.training.networks import FusionNetwork
from tactomo_lab.training.objectives import FusionObjective, linear_images
from tactomo_lab.training.train import Settings, Training, load_weights
from tactomo_lab.training.training_scenes import PRESET, read_manifest

BOTH: Final[tuple[Channel, ...]] = (Channel.MAGNITUDE, Channel.STRUCTURE)


@dataclass(frozen=True)
class Configuration:
    """How a network is made."""

    channels: tuple[Channel, ...]
    width: int


KIND: Final = "network"
SETTINGS: Final = Settings(epochs=40, batch=64)

CONFIGURATIONS: Final[dict[str, Configuration]] = {
    "ours": Configuration(BOTH, 24),
    "ours-small": Configuration(BOTH, 12),
    "ours-single": Configuration((Channel.MAGNITUDE,), 24),
}


@dataclass(frozen=True)
class Prepared:
    """A network before its first step, and what it is trained on."""

    configuration: Configuration
    description: SensorDescription
    network: FusionNetwork
    objective: FusionObjective
    scale: float
    bases: Mapping[Channel, FloatArray]


def check_scenes(folder: Path, description: SensorDescription) -> None:
    """Refuse scenes of another sensor.

    Raises ModelError where they are of another sensor, or of the preset `paper` of versions before;
    or there are none.
    """
    manifest = read_manifest(folder)
    for name, there, needed in (
        ("preset", manifest.preset, PRESET),
        ("sensor", manifest.sha256, description.sha256),
    ):
        if there != needed:
            raise ModelError(
                f"{folder} holds scenes of {name} {there[:12]}, the network needs "
                f"{needed[:12]}: name another folder, or simulate one"
            )


def prepare(
    configuration: Configuration,
    folder: Path,
    description: SensorDescription,
    seed: int = 0,
    start: Path | None = None,
) -> Prepared:
    """Read the scenes and make the network.

    Raises ModelError where the scenes are of another sensor, or something is missing.
    """
    check_scenes(folder, description)
    torch.manual_seed(seed)
    scale = full_range(description)
    there = tuple(name for name in configuration.channels if name in description.channels)
    configuration = replace(configuration, channels=there)
    forward = ForwardModel(description, load_or_build_artifact(description).bare)
    batches = SceneBatches(folder, description, configuration.channels, forward)
    network = FusionNetwork(batches.inputs, batches.nodes, configuration.width, scale)
    bases = dict(zip(configuration.channels, batches.bases, strict=True))
    if start is None:
        network.start_linear(linear_images(batches, scale))
    else:
        load_weights(network, start)
    return Prepared(configuration, description, network, FusionObjective(batches), scale, bases)


def export_trained(prepared: Prepared, training: Training, path: Path) -> None:
    """Write the averaged network as an ONNX file.

    Raises ModelError where the file cannot be written.
    """
    trained = f"{len(training.history)} epochs, {prepared.objective.scenes} scenes"
    example = {"data": torch.zeros(1, prepared.network.inputs)}
    notes = notes_of(
        KIND,
        prepared.description,
        prepared.configuration.channels,
        prepared.scale,
        prepared.bases,
        trained=trained,
    )
    export(training.averaged.to("cpu"), example, outputs_of(KIND), notes, path)

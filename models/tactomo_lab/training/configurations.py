"""Configurations: which network is trained on which scenes, how long, and how it is exported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, cast

import torch
from tactomo_models.arrays import FloatArray
from tactomo_models.errors import ModelError
from tactomo_models.methods.trained_networks import outputs_of
from tactomo_models.physics.artifact import load_or_build_artifact
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.sensor.description import SensorDescription
from tactomo_protocol import Channel
from torch import nn

from tactomo_lab.scenes.measures import full_range
from tactomo_lab.scenes.presets import PresetName
from tactomo_lab.training.batches import SceneBatches
from tactomo_lab.training.export import export, notes_of
from tactomo_lab.training.networks import FusionNetwork, PaperNetwork
from tactomo_lab.training.objectives import FusionObjective, PaperObjective, linear_images
from tactomo_lab.training.train import Objective, Settings, Training, load_weights
from tactomo_lab.training.training_scenes import read_manifest

BOTH: Final[tuple[Channel, ...]] = (Channel.MAGNITUDE, Channel.STRUCTURE)


@dataclass(frozen=True)
class Configuration:
    """How a network is made."""

    kind: str
    preset: PresetName
    channels: tuple[Channel, ...]
    width: int
    settings: Settings
    hidden: int = 0


# The paper: 200 epochs in batches of 128 at a constant rate of 1e-4, without turning the scenes.
# Begun as a regression, at a rate that rises and falls, a tenth of that is enough.
_PAPER = Settings(epochs=24, batch=64, rate=5e-4, weight_decay=0.0)

_OURS = Settings(epochs=40, batch=64)

CONFIGURATIONS: Final[dict[str, Configuration]] = {
    "ours": Configuration("network", "robust", BOTH, 24, _OURS),
    "ours-small": Configuration("network", "robust", BOTH, 12, _OURS),
    "ours-single": Configuration("network", "robust", (Channel.MAGNITUDE,), 24, _OURS),
    "paper-single": Configuration(
        "cnn-single", "paper", (Channel.MAGNITUDE,), 12, _PAPER, hidden=384
    ),
    "paper-multimodal": Configuration("cnn-multimodal", "paper", BOTH, 12, _PAPER, hidden=384),
}


@dataclass(frozen=True)
class Prepared:
    """A network before its first step, and what it is trained on."""

    configuration: Configuration
    description: SensorDescription
    network: nn.Module
    objective: Objective
    scale: float
    bases: Mapping[Channel, FloatArray] | None = None


def check_scenes(
    configuration: Configuration, folder: Path, description: SensorDescription
) -> None:
    """Refuse scenes that a configuration cannot use.

    Raises:
        ModelError: they are of another sensor or preset, or there are none.
    """
    manifest = read_manifest(folder)
    for name, there, needed in (
        ("preset", manifest.preset, configuration.preset),
        ("sensor", manifest.sha256, description.sha256),
    ):
        if there != needed:
            raise ModelError(
                f"{folder} holds scenes of {name} {there[:12]}, this configuration "
                f"needs {needed[:12]}: name another folder, or simulate one"
            )


def prepare(
    configuration: Configuration,
    folder: Path,
    description: SensorDescription,
    seed: int = 0,
    start: Path | None = None,
) -> Prepared:
    """Read the scenes and make the network.

    Raises:
        ModelError: the scenes are of another sensor or preset, or something is missing.
    """
    check_scenes(configuration, folder, description)
    torch.manual_seed(seed)
    scale = full_range(description)
    if configuration.kind == "network":
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
    multimodal = len(configuration.channels) == 2
    objective = PaperObjective(folder, description, multimodal=multimodal, scale=scale)
    paper = PaperNetwork(
        len(configuration.channels), objective.nodes, configuration.width, configuration.hidden
    )
    if start is None:
        objective.start_linear(paper)
    else:
        load_weights(paper, start)
    return Prepared(configuration, description, paper, objective, scale)


def export_trained(prepared: Prepared, training: Training, path: Path) -> None:
    """Write the averaged network as an ONNX file.

    Raises:
        ModelError: the file cannot be written.
    """
    configuration, objective = prepared.configuration, prepared.objective
    further = {"trained": f"{len(training.history)} epochs, {objective.scenes} scenes"}
    example: dict[str, torch.Tensor] = {}
    if isinstance(objective, PaperObjective):
        further["input_scale"] = repr(objective.input_scale)
        for name in configuration.channels:
            example[name] = torch.zeros(1, *objective.nodes)
    else:
        network = cast(FusionNetwork, training.averaged)
        example["data"] = torch.zeros(1, network.inputs)
    notes = notes_of(
        configuration.kind,
        prepared.description,
        configuration.channels,
        prepared.scale,
        prepared.bases,
        **further,
    )
    export(training.averaged.to("cpu"), example, outputs_of(configuration.kind), notes, path)

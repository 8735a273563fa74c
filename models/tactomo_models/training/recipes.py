"""The recipes: which network is trained on which scenes, how long, and how it is exported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from tactomo_models.artifact import load_or_build_artifact
from tactomo_models.description import Modality, SensorDescription
from tactomo_models.errors import ModelError
from tactomo_models.evaluation.measures import full_range
from tactomo_models.forward import ForwardModel
from tactomo_models.network import OUTPUTS, NetworkKind, SensorNetworks
from tactomo_models.training.batches import SceneBatches
from tactomo_models.training.export import export, notes_of
from tactomo_models.training.lessons import FusionLesson, PaperLesson, RefinerLesson, linear_images
from tactomo_models.training.networks import FusionNetwork, PaperNetwork
from tactomo_models.training.presets import PresetName
from tactomo_models.training.simulate import read_manifest
from tactomo_models.training.train import Lesson, Settings, Training, load_weights

BOTH: Final[tuple[Modality, ...]] = ("magnitude", "structure")


@dataclass(frozen=True)
class Recipe:
    """How a network is made.

    Attributes:
        kind: what it is used as.
        preset: of the scenes it is trained on.
        modalities: channels it is given.
        width: channels of its first convolutions.
        hidden: neurons between the paper's fully connected blocks; unused by ours.
        settings: how long and how fast; the default, which a user may shorten.
    """

    kind: NetworkKind
    preset: PresetName
    modalities: tuple[Modality, ...]
    width: int
    settings: Settings
    hidden: int = 0


# The paper: 200 epochs in batches of 128 at a constant rate of 1e-4. Here a tenth of the epochs in
# smaller batches, at a rate that rises and falls, and narrower convolutions: an hour on a core.
_SHORT = Settings(epochs=20, batch=32, rate=1e-3, weight_decay=0.0)

_OURS = Settings(epochs=40, batch=64)

RECIPES: Final[dict[str, Recipe]] = {
    "ours": Recipe("network", "robust", BOTH, 24, _OURS),
    "ours-small": Recipe("network", "robust", BOTH, 12, _OURS),
    "ours-single": Recipe("network", "robust", ("magnitude",), 24, _OURS),
    "refiner": Recipe("refiner", "robust", BOTH, 24, Settings(epochs=16, batch=64, rate=1e-3)),
    "paper-single": Recipe("cnn-single", "paper", ("magnitude",), 12, _SHORT, hidden=256),
    "paper-multimodal": Recipe("cnn-multimodal", "paper", BOTH, 12, _SHORT, hidden=256),
}


@dataclass(frozen=True)
class Prepared:
    """A network before its first step, and what it is trained on."""

    recipe: Recipe
    description: SensorDescription
    network: nn.Module
    lesson: Lesson
    scale: float
    bases: Mapping[Modality, NDArray[np.float64]] | None = None


def check_scenes(recipe: Recipe, folder: Path, description: SensorDescription) -> None:
    """Refuse scenes that a recipe cannot use.

    Raises:
        ModelError: they are of another sensor or preset, or there are none.
    """
    manifest = read_manifest(folder)
    for name, there, needed in (
        ("preset", manifest.preset, recipe.preset),
        ("sensor", manifest.sha256, description.sha256),
    ):
        if there != needed:
            raise ModelError(
                f"{folder} holds scenes of {name} {there[:12]}, this recipe needs {needed[:12]}: "
                "name another folder, or simulate one"
            )


def prepare(
    recipe: Recipe,
    folder: Path,
    description: SensorDescription,
    seed: int = 0,
    start: Path | None = None,
) -> Prepared:
    """Read the scenes and make the network.

    Args:
        recipe: what is to be made.
        folder: of simulated scenes; with their images, for the paper's networks; with their
            sights, for the refiner.
        description: the sensor.
        seed: of the network's first weights.
        start: checkpoint whose averaged weights it begins with; a refiner may begin with those of
            a network that is given no images.

    Raises:
        ModelError: the scenes are of another sensor or preset, or something is missing.
    """
    check_scenes(recipe, folder, description)
    torch.manual_seed(seed)
    scale = full_range(description)
    if recipe.kind == "network":
        forward = ForwardModel(description, load_or_build_artifact(description).bare)
        batches = SceneBatches(folder, description, recipe.modalities, forward)
        network = FusionNetwork(batches.inputs, batches.nodes, recipe.width, scale)
        if start is None:
            network.start_linear(linear_images(batches, scale))
        else:
            load_weights(network, start)
        bases = dict(zip(recipe.modalities, batches.bases, strict=True))
        return Prepared(recipe, description, network, FusionLesson(batches), scale, bases)
    if recipe.kind == "refiner":
        proposing = SensorNetworks(description).fusion
        redrawn = RefinerLesson(folder, description, list(proposing.bases.values()), scale)
        nodes = redrawn.nodes
        network = FusionNetwork(redrawn.inputs, nodes, recipe.width, scale, images=2)
        if start is not None:
            other = FusionNetwork(redrawn.inputs, nodes, recipe.width, scale)
            load_weights(other, start)
            network.start_from(other)
        return Prepared(recipe, description, network, redrawn, scale, proposing.bases)
    lesson = PaperLesson(folder, multimodal=len(recipe.modalities) == 2, scale=scale)
    paper = PaperNetwork(len(recipe.modalities), lesson.nodes, recipe.width, recipe.hidden)
    if start is not None:
        load_weights(paper, start)
    return Prepared(recipe, description, paper, lesson, scale)


def export_trained(prepared: Prepared, training: Training, path: Path) -> None:
    """Write the averaged network as an ONNX file.

    Raises:
        ModelError: the file cannot be written.
    """
    recipe, lesson = prepared.recipe, prepared.lesson
    further = {"trained": f"{len(training.history)} epochs, {lesson.scenes} scenes"}
    example: dict[str, torch.Tensor] = {}
    if isinstance(lesson, PaperLesson):
        further["input_scale"] = repr(lesson.input_scale)
        for name in recipe.modalities:
            example[name] = torch.zeros(1, *lesson.nodes)
    else:
        network = cast(FusionNetwork, training.averaged)
        example["data"] = torch.zeros(1, network.inputs)
        if network.images:
            example["seen"] = torch.zeros(1, network.images, *network.nodes)
    notes = notes_of(
        recipe.kind,
        prepared.description,
        recipe.modalities,
        prepared.scale,
        prepared.bases,
        **further,
    )
    export(training.averaged.to("cpu"), example, OUTPUTS[recipe.kind], notes, path)

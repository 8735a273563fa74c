"""The recipes: which network is trained on which scenes, how long, and how it is exported."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, cast

import torch
from torch import nn

from tactomo_models.artifact import load_or_build_artifact
from tactomo_models.description import Modality, SensorDescription
from tactomo_models.errors import ModelError
from tactomo_models.evaluation.measures import full_range
from tactomo_models.forward import ForwardModel
from tactomo_models.network import OUTPUTS, NetworkKind
from tactomo_models.training.batches import SceneBatches
from tactomo_models.training.export import export, notes_of
from tactomo_models.training.lessons import FusionLesson, PaperLesson, linear_images
from tactomo_models.training.networks import FusionNetwork, PaperNetwork
from tactomo_models.training.presets import PresetName
from tactomo_models.training.simulate import read_manifest
from tactomo_models.training.train import Lesson, Settings, Training

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

RECIPES: Final[dict[str, Recipe]] = {
    "ours": Recipe("network", "robust", BOTH, 24, Settings(epochs=26)),
    "ours-small": Recipe("network", "robust", BOTH, 12, Settings(epochs=26)),
    "ours-single": Recipe("network", "robust", ("magnitude",), 24, Settings(epochs=26)),
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
    recipe: Recipe, folder: Path, description: SensorDescription, seed: int = 0
) -> Prepared:
    """Read the scenes and make the network.

    Args:
        recipe: what is to be made.
        folder: of simulated scenes; with their images, for the paper's networks.
        description: the sensor.
        seed: of the network's first weights.

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
        network.start_linear(linear_images(batches, scale))
        return Prepared(recipe, description, network, FusionLesson(batches), scale)
    lesson = PaperLesson(folder, multimodal=len(recipe.modalities) == 2, scale=scale)
    paper = PaperNetwork(len(recipe.modalities), lesson.nodes, recipe.width, recipe.hidden)
    return Prepared(recipe, description, paper, lesson, scale)


def export_trained(prepared: Prepared, training: Training, path: Path) -> None:
    """Write the averaged network as an ONNX file.

    Raises:
        ModelError: the file cannot be written.
    """
    recipe, lesson = prepared.recipe, prepared.lesson
    further = {"trained": f"{len(training.history)} epochs, {lesson.scenes} scenes"}
    bases = None
    if isinstance(lesson, FusionLesson):
        bases = dict(zip(recipe.modalities, lesson.batches.bases, strict=True))
        example = {"data": torch.zeros(1, lesson.batches.inputs)}
    else:
        paper = cast(PaperLesson, lesson)
        further["input_scale"] = repr(paper.input_scale)
        example = {name: torch.zeros(1, *paper.nodes) for name in recipe.modalities}
    notes = notes_of(
        recipe.kind, prepared.description, recipe.modalities, prepared.scale, bases, **further
    )
    export(training.averaged.to("cpu"), example, OUTPUTS[recipe.kind], notes, path)

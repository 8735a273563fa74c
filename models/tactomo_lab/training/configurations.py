"""Configurations: which network is trained, how long, and how it is exported."""

from __future__ import annotations

import io
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from tactomo_models.archive import write_whole
from tactomo_models.arrays import FloatArray
from tactomo_models.errors import ModelError, os_errors_as
from tactomo_models.methods.trained_networks import CHANNELS_KEY, FORMAT, outputs_of
from tactomo_models.physics.artifact import load_or_build_artifact
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.sensor.description import SensorDescription
from tactomo_protocol import Channel

from tactomo_lab.scenes.measures import full_range
from tactomo_lab.training.batches import SceneBatches
from tactomo_lab.training.networks import FusionNetwork, FusionObjective, linear_images
from tactomo_lab.training.train import Settings, Training

OPSET: Final = 18
MIN_HALVED: Final = 1024  # numbers of a weight that is stored in half precision


KIND: Final = "network"
SETTINGS: Final = Settings(epochs=40, batch=64)

WIDTHS: Final = {"ours": 24, "ours-small": 12}  # of networks, by their configuration


@dataclass(frozen=True)
class Prepared:
    """A network before its first step, and what it is trained on."""

    description: SensorDescription
    network: FusionNetwork
    objective: FusionObjective
    scale: float  # relative conductivity change that counts as 1 inside
    bases: Mapping[Channel, FloatArray]


def prepare(width: int, folder: Path, description: SensorDescription, seed: int = 0) -> Prepared:
    """Read the scenes and make the network.

    Raises ModelError where the scenes are of another sensor, or something is missing.
    """
    torch.manual_seed(seed)
    scale = full_range(description)
    forward = ForwardModel(description, load_or_build_artifact(description).bare)
    batches = SceneBatches(folder, description, description.channels, forward)
    network = FusionNetwork(batches.inputs, batches.nodes, width, scale)
    bases = dict(zip(description.channels, batches.bases, strict=True))
    network.start_linear(linear_images(batches, scale))
    return Prepared(description, network, FusionObjective(batches), scale, bases)


def export_trained(prepared: Prepared, training: Training, path: Path) -> None:
    """Write the averaged network as an ONNX file: large weights in half precision.

    Raises ModelError where the file cannot be written.
    """
    buffer = io.BytesIO()
    torch.onnx.export(
        training.averaged.to("cpu").eval(),
        (torch.zeros(1, prepared.network.inputs),),
        buffer,
        input_names=["data"],
        output_names=list(outputs_of(KIND)),
        opset_version=OPSET,
        dynamo=False,
    )
    model = halved(onnx.load_from_string(buffer.getvalue()))
    for name, value in _notes(prepared, training).items():
        model.metadata_props.add(key=name, value=value)
    onnx.checker.check_model(model)
    next_step = "free some space or name another file"
    with os_errors_as(ModelError, f"cannot write {path}", next_step):
        write_whole(path, lambda file: file.write(model.SerializeToString()))


def _notes(prepared: Prepared, training: Training) -> dict[str, str]:
    """What a network's file says of itself, the bases (M, K) of its prefilters included."""
    packed = io.BytesIO()
    singles: dict[str, Any] = {n: basis.astype(np.float32) for n, basis in prepared.bases.items()}
    np.savez_compressed(packed, **singles)
    return {
        "format": str(FORMAT),
        "kind": KIND,
        "sensor": prepared.description.name,
        "sha256": prepared.description.sha256,
        CHANNELS_KEY: " ".join(prepared.description.channels),
        "scale": repr(prepared.scale),
        "trained": f"{len(training.history)} epochs, {prepared.objective.scenes} scenes",
        "bases": b64encode(packed.getvalue()).decode(),
    }


def halved(model: onnx.ModelProto) -> onnx.ModelProto:
    """The same network with large weights stored in half precision, and widened when it loads."""
    casts = []
    for weight in model.graph.initializer:
        values = numpy_helper.to_array(weight)
        if weight.data_type != TensorProto.FLOAT or values.size < MIN_HALVED:
            continue
        name = weight.name
        stored = f"{name}_half"
        weight.CopyFrom(numpy_helper.from_array(values.astype(np.float16), stored))
        casts.append(helper.make_node("Cast", [stored], [name], to=TensorProto.FLOAT))
    for position, cast in enumerate(casts):
        model.graph.node.insert(position, cast)
    return model

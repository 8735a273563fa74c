"""From a trained network to the ONNX file that runs, with notes on what it is for."""

from __future__ import annotations

import io
from base64 import b64encode
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from tactomo_models.archive import write_whole
from tactomo_models.arrays import FloatArray
from tactomo_models.errors import ModelError
from tactomo_models.methods.trained_networks import CHANNELS_KEY, FORMAT
from tactomo_models.sensor.description import SensorDescription
from tactomo_protocol import Channel
from torch import Tensor, nn

OPSET = 18
MIN_HALVED = 1024  # numbers of a weight that is stored in half precision


def export(
    network: nn.Module,
    example: Mapping[str, Tensor],
    outputs: tuple[str, ...],
    notes: Mapping[str, str],
    path: Path,
) -> None:
    """Write a network, its weights in half precision; it computes in single precision.

    Raises ModelError where the file cannot be written.
    """
    network.eval()
    buffer = io.BytesIO()
    torch.onnx.export(
        network,
        tuple(example.values()),
        buffer,
        input_names=list(example),
        output_names=list(outputs),
        opset_version=OPSET,
        dynamo=False,
    )
    model = halved(onnx.load_from_string(buffer.getvalue()))
    for name, value in notes.items():
        model.metadata_props.add(key=name, value=value)
    onnx.checker.check_model(model)
    try:
        write_whole(path, lambda file: file.write(model.SerializeToString()))
    except OSError as error:
        raise ModelError(
            f"cannot write {path}: {error.strerror}; free some space or name another file"
        ) from error


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


def notes_of(
    kind: str,  # of network
    description: SensorDescription,  # the sensor
    channels: tuple[Channel, ...],  # channels it is given
    scale: float,  # relative conductivity change that counts as 1 inside
    bases: Mapping[Channel, FloatArray],  # (M, K) of the prefilter of each channel
    **further: str,  # whatever else is worth knowing
) -> dict[str, str]:
    """What a network's file says of itself."""
    notes = {
        "format": str(FORMAT),
        "kind": kind,
        "sensor": description.name,
        "sha256": description.sha256,
        CHANNELS_KEY: " ".join(channels),
        "scale": repr(scale),
        **further,
    }
    packed = io.BytesIO()
    singles: dict[str, Any] = {name: basis.astype(np.float32) for name, basis in bases.items()}
    np.savez_compressed(packed, **singles)
    return {**notes, "bases": b64encode(packed.getvalue()).decode()}

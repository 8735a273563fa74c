"""Beginning with the weights of a network that was exported: the one that ships, above all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from google.protobuf.message import DecodeError
from onnx import numpy_helper
from tactomo_models.arrays import FloatArray
from tactomo_models.errors import ModelError
from tactomo_models.methods.prefilter import BANDS
from tactomo_models.methods.trained_networks import bases_of
from tactomo_protocol import Channel
from torch import Tensor, nn

from tactomo_lab.training.networks import FusionNetwork

SUFFIX = ".onnx"
STORED_HALF = "_half"  # ends the names of weights that are stored in half precision
FIRST_LAYERS = ("image.weight", "whole.0.weight", "trust.0.weight")  # what is given goes into them


def load_exported(
    network: FusionNetwork, path: Path, bases: Mapping[Channel, FloatArray], inputs: Tensor
) -> None:
    """Give our network the weights of one that was exported, for this sensor or one like it.

    Its prefilters may have other bases: the first layers are turned to the new ones. An export has
    batch normalisation folded into the convolutions; scenes say what to normalise by.

    Args:
        network: whose weights are overwritten.
        path: the .onnx file.
        bases: (M, K) of each channel's prefilter in this training.
        inputs: (n, inputs) filtered data of some scenes.

    Raises:
        ModelError: it cannot be read, or is of another network.
    """
    model, old = _read(path)
    weights = {
        weight.name.removesuffix(STORED_HALF): torch.as_tensor(
            numpy_helper.to_array(weight).astype(np.float32)
        )
        for weight in model.graph.initializer
    }
    state = network.state_dict()
    state |= {name: weights[name] for name in weights.keys() & state.keys()}
    folded = [
        node.input[1:]
        for node in model.graph.node
        if node.op_type == "Conv" and node.input[1] not in state
    ]
    normalised = _normalised(network)
    try:
        turns = [np.linalg.pinv(old[name]) @ basis for name, basis in bases.items()]
        for name in FIRST_LAYERS:
            state[name] = _turned(state[name], turns)
        for (convolution, normal), (weight, bias) in zip(normalised, folded, strict=True):
            state[f"{convolution}.weight"] = weights[weight]
            state[f"{normal}.bias"] = weights[bias]
        network.load_state_dict(state)
    except (RuntimeError, ValueError, KeyError) as error:
        raise ModelError(f"{path} is of another network: name another file") from error
    _normalise(network, inputs)


def _read(path: Path) -> tuple[onnx.ModelProto, dict[Channel, FloatArray]]:
    """The file, and the bases that its notes have."""
    try:
        model = onnx.load(path)
        return model, bases_of({note.key: note.value for note in model.metadata_props})
    except OSError as error:
        raise ModelError(f"cannot read {path}: {error.strerror}; name another file") from error
    except (DecodeError, KeyError, ValueError) as error:
        raise ModelError(f"{path} is no network of ours, or damaged: name another file") from error


def _normalised(network: nn.Module) -> list[tuple[str, str]]:
    """Names of each convolution that is normalised, and of what normalises it."""
    modules = list(network.named_modules())
    return [
        (before, name)
        for (before, _), (name, module) in pairwise(modules)
        if isinstance(module, nn.BatchNorm2d)
    ]


def _turned(weight: Tensor, turns: Sequence[FloatArray]) -> Tensor:
    """Weights (n, columns) whose last columns are each channel's components and bands."""
    turned = weight.clone()
    first = weight.shape[1] - sum(len(turn) + BANDS for turn in turns)
    for turn in turns:
        columns = slice(first, first + len(turn))
        turned[:, columns] = weight[:, columns] @ torch.as_tensor(turn, dtype=weight.dtype)
        first += len(turn) + BANDS
    return turned


def _normalise(network: FusionNetwork, inputs: Tensor) -> None:
    """Let each normalisation, the identity so far, go by the mean and deviation of some scenes."""

    def go_by(normal: nn.Module, given: tuple[Any, ...]) -> None:
        assert isinstance(normal, nn.BatchNorm2d)
        assert normal.running_mean is not None
        assert normal.running_var is not None
        variance, mean = torch.var_mean(given[0], dim=(0, 2, 3), correction=0)
        normal.running_mean.copy_(mean)
        normal.running_var.copy_(variance)
        normal.weight.copy_((variance + normal.eps).sqrt())
        normal.bias.add_(mean)

    normals = [module for module in network.modules() if isinstance(module, nn.BatchNorm2d)]
    hooks = [normal.register_forward_pre_hook(go_by) for normal in normals]
    with torch.no_grad():
        network.eval()(inputs)
    for hook in hooks:
        hook.remove()

"""The paper's networks at run time, with their pre- and post-processing (section III-C, Fig. 3)."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.ndimage import gaussian_filter
from tactomo_models.arrays import FloatArray, Image
from tactomo_models.methods.trained_networks import Network, load_network
from tactomo_models.sensor.description import SensorDescription
from tactomo_protocol import Channel

SHIPPED: Final = Path(str(files("tactomo_lab.baselines"))) / "networks"
FILTER_SIGMA: Final = 1.0  # nodes, of the Gaussian filter at the networks' output


def load_paper_network(description: SensorDescription, kind: str) -> Network:
    """Load one of a sensor's networks of the paper: `cnn-single` or `cnn-multimodal`.

    Raises ArtifactError where there is none, or it cannot be used.
    """
    return load_network(description, kind, None, SHIPPED)


class PaperNetwork:
    """One of the paper's networks, with its pre-processing (section III-C, Fig. 3)."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self._input_scale = float(network.notes["input_scale"])
        self._scale = float(network.notes["scale"])

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Channels whose images it is given."""
        return self._network.channels

    def image(self, images: Mapping[Channel, FloatArray | Image]) -> Image:
        """Map (nodes_y, nodes_x) of a frame: |relative conductivity change|.

        Args:
            images: (nodes_y, nodes_x) preliminary images: Tikhonov's of the magnitude channel,
                in the direction of pressing, and the paper's level set's of the structure channel.
        """
        made = self._network.run(preprocessed(images, self._input_scale))
        filtered = gaussian_filter(made["map"], FILTER_SIGMA)
        return np.asarray(filtered * self._scale, np.float32)


def preprocessed(
    images: Mapping[Any, FloatArray | Image],  # preliminary images (..., nodes_y, nodes_x)
    input_scale: float,  # largest value of all magnitude images trained on
) -> dict[str, FloatArray | Image]:
    """Truncate negatives; normalise to 0-1: magnitudes by one scale, each structure by its own."""
    ready: dict[str, FloatArray | Image] = {}
    for name, image in images.items():
        positive = np.maximum(image, 0.0)
        if name == Channel.MAGNITUDE:
            ready[name] = positive / input_scale
        else:
            largest = positive.max(axis=(-2, -1), keepdims=True)
            ready[name] = positive / np.where(largest > 0, largest, 1.0)
    return ready

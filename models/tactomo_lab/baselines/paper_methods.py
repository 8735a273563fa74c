"""The paper's methods behind the protocol that every method has: its level set and its networks."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import ClassVar

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.methods.fit import OutlineFit
from tactomo_models.methods.linear import LinearImages
from tactomo_models.methods.method import Estimate, Skin, UnsolvableError
from tactomo_models.scans.changes import Changes
from tactomo_models.scans.measurement import Measurement
from tactomo_models.scene.shape_fit import Budget, Shape
from tactomo_models.sensor.description import SensorDescription
from tactomo_protocol import Channel

from tactomo_lab.baselines.paper_level_set import PaperLevelSet
from tactomo_lab.baselines.paper_network import PaperNetwork, load_paper_network


class PaperShapes:
    """The paper's level set on a skin's structure channel, from its Tikhonov image, always cold."""

    def __init__(self, skin: Skin) -> None:
        assert skin.description.structure is not None
        ratio = skin.description.structure.saturated_ratio
        by_node = np.ascontiguousarray(skin.artifact.jacobian.T)
        self._images = LinearImages(skin, "tikhonov")
        self._level_set = PaperLevelSet(skin.forward, by_node, ratio)

    def fit(self, structure: Changes) -> Shape:
        """Fit a shape to the structure channel's changes."""
        image = np.maximum(self._images.image(Channel.STRUCTURE, structure.change), 0.0)
        return self._level_set.fit(structure, image)


class PaperLevelSetMethod(OutlineFit):
    """`pls-paper`: the paper's shape, and a magnitude for each of its areas as `fit` has it."""

    needs = (Channel.STRUCTURE,)

    def prepare(self, skin: Skin) -> None:
        """Make the level set's equations."""
        super().prepare(skin)
        if Channel.STRUCTURE in skin.channels:
            self._shapes = PaperShapes(skin)

    def _shape(self, measurement: Measurement, budget: Budget) -> tuple[Shape, str]:
        self._forget()  # it starts cold, always
        return self._shapes.fit(measurement.changes[Channel.STRUCTURE]), "as requested"

    def _name_of(self, shape: Shape) -> str:
        return "pls-paper"


class PreliminaryImages:
    """What the paper's networks are given (section III-C-2): linear image and level set."""

    def __init__(self, skin: Skin) -> None:
        self._skin = skin
        self._shapes = PaperShapes(skin) if Channel.STRUCTURE in skin.channels else None

    def of(
        self, changes: Mapping[Channel, Changes], channels: Collection[Channel]
    ) -> dict[Channel, FloatArray]:
        """Images (nodes_y, nodes_x) of some channels; 0 for one without a scan."""
        description, areas = self._skin.description, self._skin.areas
        blank = np.zeros((description.map.nodes_y, description.map.nodes_x))
        images = dict.fromkeys(channels, blank)
        if Channel.MAGNITUDE in changes and Channel.MAGNITUDE in channels:
            # The artifact's matrix, whose regularisation is fixed, as the paper's is: what a
            # network was trained on must not depend on the noise.
            signed = description.sign(Channel.MAGNITUDE) * changes[Channel.MAGNITUDE].change
            images[Channel.MAGNITUDE] = areas.on_map(self._skin.artifact.tikhonov @ signed)
        if Channel.STRUCTURE in changes and Channel.STRUCTURE in channels:
            assert self._shapes is not None
            shape = self._shapes.fit(changes[Channel.STRUCTURE])
            images[Channel.STRUCTURE] = areas.on_map(shape.coverage)
        return images


class _PaperNetworkMethod:
    """One of the paper's networks; areas are where its map exceeds half of its peak."""

    kind: ClassVar[str]

    @classmethod
    def check(cls, description: SensorDescription) -> None:
        """Make sure that there is such a network.

        Raises:
            ArtifactError: it is missing or cannot be used.
        """
        load_paper_network(description, cls.kind)

    def prepare(self, skin: Skin) -> None:
        """Load the network, and make what its images come from."""
        self._images = PreliminaryImages(skin)
        self._network = PaperNetwork(load_paper_network(skin.description, self.kind))

    def solve(
        self, measurement: Measurement, previous: Estimate | None, budget_s: float
    ) -> Estimate:
        """Show what the network makes of the preliminary images."""
        channels = self._network.channels
        if not measurement.changes.keys() >= set(channels):
            raise UnsolvableError("a channel that the network needs is missing")
        with measurement.timed("images"):
            images = self._images.of(measurement.changes, channels)
        with measurement.timed("network"):
            return Estimate(map=self._network.image(images), made_by=self.kind)


class CnnSingle(_PaperNetworkMethod):
    """`cnn-single`: the paper's network of the magnitude channel's Tikhonov image."""

    kind = "cnn-single"


class CnnMultimodal(_PaperNetworkMethod):
    """`cnn-multimodal`: ... and of the structure channel's level set."""

    kind = "cnn-multimodal"

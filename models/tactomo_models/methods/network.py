"""Our fusion network alone: no physics beside it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from tactomo_protocol import Channel

from tactomo_models.methods.method import Estimate, Skin
from tactomo_models.methods.trained_networks import FUSION, NetworkImage, need_network
from tactomo_models.scans.changes import Changes, towards_pressing
from tactomo_models.scans.measurement import Measurement
from tactomo_models.scans.plausibility import Flag
from tactomo_models.sensor.description import SensorDescription

LOW_CONFIDENCE: Final = 0.8  # expected correlation below which a map is better not trusted


class NetworkAlone:
    """The network's images; each area of its shape carries what its map shows there."""

    @staticmethod
    def check(description: SensorDescription) -> None:
        """Make sure that there is a network.

        Raises:
            ArtifactError: it is missing.
        """
        need_network(description, FUSION)

    def prepare(self, skin: Skin) -> None:
        """Load the network."""
        self._skin = skin
        _ = skin.networks.fusion

    def solve(
        self, measurement: Measurement, previous: Estimate | None, budget_s: float
    ) -> Estimate:
        """Show what the network makes of the changes."""
        return network_estimate(self._skin, measurement)


def network_image(skin: Skin, changes: Mapping[Channel, Changes]) -> NetworkImage:
    """What a sensor's network makes of a frame's changes."""
    return skin.networks.fusion.image(*towards_pressing(skin.description, changes))


def network_estimate(
    skin: Skin, measurement: Measurement, reason: str = "as requested"
) -> Estimate:
    """The estimate of a sensor's network alone."""
    with measurement.timed("network"):
        image = network_image(skin, measurement.changes)
    has_magnitude = Channel.MAGNITUDE in measurement.changes
    return Estimate(
        map=image.map if has_magnitude else None,
        structure=image.structure if Channel.STRUCTURE in measurement.changes else None,
        magnitude_sigmas=image.magnitude_sigma if has_magnitude else float("nan"),
        confidence=image.confidence,
        flags=Flag.LOW_CONFIDENCE if image.confidence < LOW_CONFIDENCE else Flag(0),
        made_by="network",
        reason=reason,
    )

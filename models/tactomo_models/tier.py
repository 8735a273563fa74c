"""How much model a scene is given: the tiers, and which of them a sensor can be given."""

from __future__ import annotations

from enum import StrEnum, auto
from typing import Final

from tactomo_models.description import SensorDescription
from tactomo_models.network import NetworkKind, load_network


class Tier(StrEnum):
    """How much model a scene was given."""

    AUTO = auto()  # as a request only: as much as the scene needs
    QUIET = auto()  # nothing pressed: a test and no solve
    TIKHONOV = auto()  # one linear step, every node alike
    NOSER = auto()  # one linear step, nodes weighted by how well they are seen
    PLS_PAPER = "pls-paper"  # the paper's level set, linear in the bare sheet's Jacobian, cold
    FIT = auto()  # a few outlines on the structure channel, magnitudes fitted to their areas
    LEVELSET = auto()  # a level set there instead: shapes of any form
    NETWORK = auto()  # our fusion network alone
    HYBRID = auto()  # the network proposes, outlines are refined and judged by the physics
    CNN_SINGLE = "cnn-single"  # the paper's network, of the magnitude channel's Tikhonov image
    CNN_MULTIMODAL = "cnn-multimodal"  # ... and of the structure channel's pls-paper image


METHODS: Final = tuple(tier for tier in Tier if tier is not Tier.QUIET)  # that may be asked for
LINEAR: Final = (Tier.TIKHONOV, Tier.NOSER)
PAPER_NETWORKS: Final = (Tier.CNN_SINGLE, Tier.CNN_MULTIMODAL)
NETWORKS_OF: Final[dict[Tier, tuple[NetworkKind, ...]]] = {  # what they cannot do without
    Tier.NETWORK: ("network",),
    Tier.HYBRID: ("network", "refiner"),
    Tier.CNN_SINGLE: ("cnn-single",),
    Tier.CNN_MULTIMODAL: ("cnn-multimodal",),
}


def check_tier(description: SensorDescription, tier: Tier) -> None:
    """Make sure that a sensor can be reconstructed that way.

    Raises:
        ArtifactError: the network that it takes is missing or cannot be used.
    """
    for kind in NETWORKS_OF.get(tier, ()):
        load_network(description, kind)

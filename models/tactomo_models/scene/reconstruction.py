"""What is reconstructed of one frame: its images, its contacts, and how far to trust them."""

from __future__ import annotations

from dataclasses import dataclass, field

from tactomo_models.arrays import Image
from tactomo_models.scans.plausibility import Flag
from tactomo_models.scene.contacts import Contact


@dataclass(frozen=True)
class Reconstruction:
    """One frame.

    Attributes:
        map: (nodes_y, nodes_x) |relative conductivity change| of the magnitude channel; None
            where it cannot be computed.
        pressure_kpa: (nodes_y, nodes_x); None where it cannot be computed. 0 where nothing
            touches, NaN in contacts whose pressure is not known.
        structure: (nodes_y, nodes_x) 0 bare to 1 pressed; None where it cannot be computed. For
            a sensor whose objects conduct `either_way`, -1 where one conducts worse.
        contacts: pressed areas.
        tier: what made this frame, in a word: `quiet`, or a method, or a part of `auto`.
        reason: why that made it.
        misfit: root mean square of the noise-weighted residual; about 1 where all is explained.
            Of a quiet frame, `Changes.signal`.
        flags: what stands in the way of trusting it.
        stage_s: seconds spent in each stage.
        confidence: expected correlation of the map with the truth, 0 to 1, as a network judges
            it; NaN where none did.
        failure: what a method of the user's own failed of; empty where none did.
    """

    map: Image | None
    pressure_kpa: Image | None
    structure: Image | None
    contacts: tuple[Contact, ...]
    tier: str
    reason: str
    misfit: float
    flags: Flag = field(default_factory=lambda: Flag(0))
    stage_s: dict[str, float] = field(default_factory=dict)
    confidence: float = float("nan")
    failure: str = ""

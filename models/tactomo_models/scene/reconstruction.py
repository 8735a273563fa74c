"""What is reconstructed of one frame: its images, its contacts, and how far to trust them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from tactomo_models.arrays import Image
from tactomo_models.scans.companion_forces import CompanionForce
from tactomo_models.scans.plausibility import Flag
from tactomo_models.scene.contacts import Contact


@dataclass(frozen=True)
class Reconstruction:
    """One frame."""

    #: (nodes_y, nodes_x) |relative conductivity change| of the magnitude channel; None where it
    #: cannot be computed
    map: Image | None
    #: (nodes_y, nodes_x); None where it cannot be computed. 0 where nothing touches, NaN in
    #: contacts whose pressure is not known
    pressure_kpa: Image | None
    #: (nodes_y, nodes_x) 0 bare to 1 pressed; None where it cannot be computed. For a sensor whose
    #: objects conduct `either_way`, -1 where one conducts worse
    structure: Image | None
    contacts: tuple[Contact, ...]  #: pressed areas
    tier: str  #: what made this frame, in a word: `quiet`, or a method, or a part of `auto`
    reason: str  #: why that made it
    #: root mean square of the noise-weighted residual; about 1 where all is explained. Of a quiet
    #: frame, `Changes.signal`
    misfit: float
    flags: Flag = field(default_factory=lambda: Flag(0))  #: what stands in the way of trusting it
    stage_s: dict[str, float] = field(default_factory=dict)  #: seconds spent in each stage
    #: expected correlation of the map with the truth, 0 to 1, as a network judges it; NaN where
    #: none did
    confidence: float = float("nan")
    #: of all contacts together, N; NaN where that of one is not known, a lower bound where one is
    #: `above`
    force_n: float = float("nan")
    #: standard uncertainty of `force_n`; NaN where unknown, and where nothing presses
    force_sigma_n: float = float("nan")
    #: of each companion that has a usable reading
    companions: Mapping[str, CompanionForce] = field(default_factory=dict)
    failure: str = ""  #: what a method of the user's own failed of; empty where none did

"""A second opinion on what the physics has found: a network redraws it, and the data decide.

Few outlines explain the structure channel, but a ring looks like a disc there, and noise hides
corners. A network that has seen many such scenes redraws map and shape. Each area that it draws
gets a magnitude from the data as any other, and the two drawings are weighed by how well they
explain the magnitude channel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.methods.contact_model import Account
from tactomo_models.methods.magnitudes import WarmStartedMagnitudes
from tactomo_models.methods.method import Skin
from tactomo_models.methods.trained_networks import NetworkImage
from tactomo_models.scans.changes import Changes, towards_pressing
from tactomo_models.scene.areas import Areas

# The redrawn one's share is a half where its misfit is a tenth larger: its areas are coarser. Tuned
# on tuning scenes of 40, 20 and 10 dB; half or twice as much changes the correlation by 0.001.
HANDICAP = 0.1


@dataclass(frozen=True)
class RefinedEstimate:
    """A refined account.

    Attributes:
        account: what it shows.
        share: of it in what is published, 0 to 1; the rest is the physics'.
        confidence: expected correlation of the network's map with the truth.
    """

    account: Account
    share: float
    confidence: float


class NetworkRefiner:
    """Redraws frame after frame; what has not changed is not drawn again."""

    def __init__(self, skin: Skin) -> None:
        self._description, self._areas = skin.description, skin.areas
        self._network = skin.networks.refiner
        self._magnitudes = WarmStartedMagnitudes(skin.forward)
        self.forget()

    def forget(self) -> None:
        """Drop what was drawn before."""
        self._magnitudes.forget()
        self._last: tuple[Areas, FloatArray, Areas, NetworkImage] | None = None

    def refine(
        self, own: Account, changes: Mapping[Channel, Changes], solves: int
    ) -> RefinedEstimate | None:
        """Redraw the physics' account of a frame; None where the network sees nothing.

        Args:
            own: the physics' account.
            changes: of both channels.
            solves: forward solves allowed.
        """
        decision = 0.1  # of the misfits' ratio, in logarithm, that tips the scales
        areas, image = self._refined(own, changes)
        fitted = self._magnitudes.fit(areas, changes[Channel.MAGNITUDE], solves=solves)
        if fitted is None or own.fitted is None:
            return None
        better = np.log(own.fitted.misfit / fitted.misfit)
        share = float(1 / (1 + np.exp(-(better + HANDICAP) / decision)))
        return RefinedEstimate(Account(areas, image.structure, fitted), share, image.confidence)

    def _refined(
        self, own: Account, changes: Mapping[Channel, Changes]
    ) -> tuple[Areas, NetworkImage]:
        still = 1.5  # mean square of a still scene's differences over their noise
        magnitude = changes[Channel.MAGNITUDE]
        if self._last is not None:
            of, change, areas, image = self._last
            valid = magnitude.weight > 0
            moved = (magnitude.change - change)[valid] ** 2 / (2 * magnitude.frame_variance[valid])
            if of is own.areas and float(moved.mean()) < still:
                return areas, image
        shown = own.map(self._description.sign(Channel.MAGNITUDE))
        seen = (shown.astype(np.float32), own.pressed.astype(np.float32))
        image = self._network.image(*towards_pressing(self._description, changes), seen)
        areas = self._areas.find(image.structure, self._areas.on_nodes(image.structure))
        areas = _placed_as(areas, own.areas)
        self._last = (own.areas, magnitude.change, areas, image)
        return areas, image


def _placed_as(areas: Areas, known: Areas) -> Areas:
    """Areas with the places, and the uncertainties, of the known ones that they are of.

    An outline's centre is known to a tenth of a millimetre, an image's to half a node.
    """
    same_m = 0.012  # centres within this are of the same contact
    if len(areas) == 0 or len(known) == 0:
        return areas
    apart = np.linalg.norm(areas.centres_m[:, None] - known.centres_m[None], axis=2)
    nearest = apart.argmin(axis=1)
    # Each other's nearest, that is: one of two halves is not where the whole was.
    same = (apart.min(axis=1) < same_m) & (apart.argmin(axis=0)[nearest] == np.arange(len(areas)))
    return replace(
        areas,
        centres_m=np.where(same[:, None], known.centres_m[nearest], areas.centres_m),
        sigmas=np.where(same[:, None], known.sigmas[nearest], np.nan),
    )

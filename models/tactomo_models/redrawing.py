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
from numpy.typing import NDArray

from tactomo_models.areas import AreaFinder, Areas
from tactomo_models.changes import Changes, towards_pressing
from tactomo_models.description import Modality, SensorDescription
from tactomo_models.drawing import Drawing
from tactomo_models.forward import ForwardModel
from tactomo_models.magnitudes import MagnitudeFollower
from tactomo_models.network import FusionNetwork, NetworkImage

FloatArray = NDArray[np.float64]
Image = NDArray[np.float32]

# The redrawn one's share is a half where its misfit is a tenth larger: its areas are coarser. Tuned
# on tuning scenes of 40, 20 and 10 dB; half or twice as much changes the correlation by 0.001.
HANDICAP = 0.1
DECISION = 0.1  # of the misfits' ratio, in logarithm, that tips the scales
SAME_M = 0.012  # centres within this are of the same contact
STILL = 1.5  # mean square of a still scene's differences over their noise


@dataclass(frozen=True)
class SecondOpinion:
    """A redrawn account.

    Attributes:
        drawing: what it shows.
        share: of it in what is published, 0 to 1; the rest is the physics'.
        confidence: expected correlation of the network's map with the truth.
    """

    drawing: Drawing
    share: float
    confidence: float


class Redrawer:
    """Redraws frame after frame; what has not changed is not drawn again.

    Args:
        description: the sensor.
        forward: the model of the sheet.
        areas: finds areas on its map.
        network: the refining one.
    """

    def __init__(
        self,
        description: SensorDescription,
        forward: ForwardModel,
        areas: AreaFinder,
        network: FusionNetwork,
    ) -> None:
        self._description, self._areas, self._network = description, areas, network
        self._magnitudes = MagnitudeFollower(forward)
        self.forget()

    def forget(self) -> None:
        """Drop what was drawn before."""
        self._magnitudes.forget()
        self._last: tuple[Areas, FloatArray, Areas, NetworkImage] | None = None

    def redraw(
        self, own: Drawing, data: Mapping[Modality, Changes], solves: int
    ) -> SecondOpinion | None:
        """Redraw the physics' account of a frame; None where the network sees nothing.

        Args:
            own: the physics' account.
            data: both channels'.
            solves: forward solves allowed.
        """
        areas, image = self._drawn(own, data)
        taken = data["magnitude"]
        fitted = self._magnitudes.fit(
            areas, taken.change, taken.weight, taken.spread, solves=solves
        )
        if fitted is None or own.fitted is None or image.structure is None:
            return None
        better = np.log(own.fitted.misfit / fitted.misfit)
        share = float(1 / (1 + np.exp(-(better + HANDICAP) / DECISION)))
        return SecondOpinion(Drawing(areas, image.structure, fitted), share, image.confidence)

    def _drawn(self, own: Drawing, data: Mapping[Modality, Changes]) -> tuple[Areas, NetworkImage]:
        taken = data["magnitude"]
        if self._last is not None:
            of, change, areas, image = self._last
            valid = taken.weight > 0
            moved = (taken.change - change)[valid] ** 2 / (2 * taken.between[valid])
            if of is own.areas and float(moved.mean()) < STILL:
                return areas, image
        shown = own.map(self._description.sign("magnitude"))
        seen = (shown.astype(np.float32), own.pressed.astype(np.float32))
        image = self._network.image(*towards_pressing(self._description, data), seen)
        assert image.structure is not None
        areas = self._areas.find(image.structure, self._areas.on_nodes(image.structure))
        areas = _placed_as(areas, own.areas)
        self._last = (own.areas, taken.change, areas, image)
        return areas, image


def _placed_as(areas: Areas, known: Areas) -> Areas:
    """Areas with the places, and the uncertainties, of the known ones that they are of.

    An outline's centre is known to a tenth of a millimetre, an image's to half a node.
    """
    if len(areas) == 0 or len(known) == 0:
        return areas
    apart = np.linalg.norm(areas.centres_m[:, None] - known.centres_m[None], axis=2)
    nearest = apart.argmin(axis=1)
    # Each other's nearest, that is: one of two halves is not where the whole was.
    same = (apart.min(axis=1) < SAME_M) & (apart.argmin(axis=0)[nearest] == np.arange(len(areas)))
    return replace(
        areas,
        centres_m=np.where(same[:, None], known.centres_m[nearest], areas.centres_m),
        sigmas=np.where(same[:, None], known.sigmas[nearest], np.nan),
    )

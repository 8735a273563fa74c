"""`auto`: as much model as a scene needs, by networks and physics together.

The network proposes contacts where a fit starts cold, outlines or a level set are fitted and judged
by the physics, the refining network redraws them, and the data choose. Where the fit explains
nothing, or the structure channel is missing, the network stands in. Where a sensor has no networks,
the physics does it alone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.methods.contact_model import Account
from tactomo_models.methods.fit import OutlineFit
from tactomo_models.methods.magnitudes import known_magnitudes
from tactomo_models.methods.method import Estimate, Skin, UnsolvableError
from tactomo_models.methods.network import LOW_CONFIDENCE, network_estimate, network_image
from tactomo_models.methods.network_refiner import NetworkRefiner, RefinedEstimate
from tactomo_models.methods.trained_networks import NONE_TRAINED
from tactomo_models.methods.warm_started_fit import Propose, ShapeModel
from tactomo_models.scans.measurement import Measurement
from tactomo_models.scans.plausibility import Flag
from tactomo_models.scene.outlines import ellipses_of
from tactomo_models.scene.shape_fit import Shape

UNSURE_MISFIT: Final = 1.5  # of both channels together, from which the network is asked


class Auto(OutlineFit):
    """Networks propose, the physics fits and judges, the data choose.

    Args:
        refines: whether the refining network redraws what the fit has found.
    """

    shape_model = ShapeModel.AS_NEEDED

    def __init__(self, *, refines: bool = True) -> None:
        self._refines = refines
        self._refiner: NetworkRefiner | None = None

    def prepare(self, skin: Skin) -> None:
        """Make the fit of this sheet and load its networks, where there are any."""
        super().prepare(skin)
        missing = skin.networks.missing if self._refines else ""
        self._has_networks = not missing
        self._note = ""
        if missing and NONE_TRAINED not in missing:
            self._note = f"; no network: {missing}"
        if self._has_networks and self._refines and self._refiner is None:
            self._refiner = NetworkRefiner(skin)

    def solve(
        self, measurement: Measurement, previous: Estimate | None, budget_s: float
    ) -> Estimate:
        """Fit, refine, and let the data choose."""
        try:
            estimate = super().solve(measurement, previous, budget_s)
        except UnsolvableError as error:
            if not self._has_networks:
                raise UnsolvableError(f"{error}{self._note}") from error
            self._forget()  # the network fills in what is missing as best it can
            return network_estimate(self._skin, measurement, str(error))
        return replace(estimate, reason=estimate.reason + self._note)

    def _forget(self) -> None:
        super()._forget()
        if self._refiner is not None:
            self._refiner.forget()

    def _proposer(self, measurement: Measurement) -> Propose | None:
        return (lambda: self._proposed(measurement)) if self._has_networks else None

    def _proposed(self, measurement: Measurement) -> FloatArray:
        """Ellipses that the network's shape suggests, to be refined and judged by the physics."""
        with measurement.timed("network"):
            pressed = network_image(self._skin, measurement.changes).structure
        finder = self._skin.areas
        areas = finder.find(pressed, finder.on_nodes(pressed))
        return ellipses_of(areas.on_map, *finder.map_places)

    def _conclude(
        self, measurement: Measurement, shape: Shape, own: Account, how: str, solves: int
    ) -> Estimate:
        sure_share = 0.85  # of the refiner, from which contacts are its own: outlines know theirs
        refined = self._refined(measurement, own, solves)
        if refined is None:
            return super()._conclude(measurement, shape, own, how, solves)
        shown = refined.account if refined.share > sure_share else own
        flags = Flag(0) if shape.converged else Flag.NOT_CONVERGED
        if self._leaves_unexplained(measurement, shape, shown) or _is_unsure(shape, shown):
            return self._network_instead(measurement, shape, flags)
        assert shown.fitted is not None
        vague = not measurement.changes[Channel.MAGNITUDE].quiet and _is_vague(shown)
        if vague or refined.confidence < LOW_CONFIDENCE:
            flags |= Flag.LOW_CONFIDENCE
        ours, theirs = own.map(self._sign), refined.account.map(self._sign)
        size, sigma = known_magnitudes(shown.fitted, self._sign, len(shown.areas))
        return Estimate(
            map=ours + refined.share * (theirs - ours),
            structure=shown.pressed,
            areas=shown.areas,
            magnitudes=size,
            magnitude_sigmas=sigma,
            misfit=shape.misfit,
            confidence=refined.confidence,
            flags=flags,
            made_by="hybrid",
            reason=how,
        )

    def _refined(
        self, measurement: Measurement, own: Account, solves: int
    ) -> RefinedEstimate | None:
        if self._refiner is None or own.fitted is None:
            return None
        with measurement.timed("network"):
            return self._refiner.refine(own, measurement.changes, solves)

    def _network_instead(self, measurement: Measurement, shape: Shape, flags: Flag) -> Estimate:
        """The network's estimate where no shape with even pressures explains the data.

        It has learnt soft rims and contacts between two scans, too; where it is sure, so are we.
        """
        sure_confidence = 0.9  # of a network, from which a map is trusted that no fit explains
        made = network_estimate(self._skin, measurement, "no even presses explain the data")
        if made.confidence < sure_confidence:
            flags |= Flag.MISFIT_HIGH
        return replace(made, misfit=shape.misfit, flags=made.flags | flags)


def _is_unsure(shape: Shape, shown: Account) -> bool:
    """Tell whether so much is left of both channels that the network is better asked."""
    other = shown.fitted.misfit if shown.fitted else 0.0
    return bool(np.hypot(shape.misfit, other) > np.sqrt(2) * UNSURE_MISFIT)


def _is_vague(shown: Account) -> bool:
    """Tell whether the magnitudes are hardly known."""
    unsure_magnitude = 0.5  # uncertainty of all magnitudes together, share of themselves
    assert shown.fitted is not None
    weights, fitted = shown.areas.areas_m2, shown.fitted
    known, unknown = weights @ fitted.change**2, weights @ fitted.sigma**2
    return bool(unknown > unsure_magnitude**2 * known)

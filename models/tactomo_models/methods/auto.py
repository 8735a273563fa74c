"""`auto`: as much model as a scene needs, by physics and network together.

The network proposes contacts where a search starts cold; a pressure field is fitted and judged by
the data. Where no field explains the data, or the structure channel is missing, the network stands
in. Where a sensor has no network, the physics does it alone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from tactomo_models.arrays import FloatArray
from tactomo_models.methods.account import Propose
from tactomo_models.methods.fit import Course, Fit
from tactomo_models.methods.method import Estimate, Skin, UnsolvableError
from tactomo_models.methods.network import network_estimate, network_image
from tactomo_models.methods.trained_networks import NONE_TRAINED
from tactomo_models.scans.measurement import Measurement
from tactomo_models.scans.plausibility import Flag
from tactomo_models.scene.pressure_field import ellipses_of

UNSURE_MISFIT: Final = 1.5  # of all channels together, from which the network is asked


class Auto(Fit):
    """The network proposes, the physics fits, the data judge."""

    def prepare(self, skin: Skin) -> None:
        """Make the fit of this sensor and load its network, where there is one."""
        super().prepare(skin)
        missing = skin.networks.missing
        self._has_network = not missing
        self._note = f"; no network: {missing}" if missing and NONE_TRAINED not in missing else ""

    def solve(
        self, measurement: Measurement, previous: Estimate | None, budget_s: float
    ) -> Estimate:
        """Fit, and let the network stand in where nothing can be fitted."""
        try:
            estimate = super().solve(measurement, previous, budget_s)
        except UnsolvableError as error:
            if not self._has_network:
                raise UnsolvableError(f"{error}{self._note}") from error
            return network_estimate(self._skin, measurement, str(error))
        return replace(estimate, reason=estimate.reason + self._note)

    def _proposer(self, measurement: Measurement) -> Propose | None:
        return (lambda: self._proposed(measurement)) if self._has_network else None

    def _proposed(self, measurement: Measurement) -> FloatArray:
        """Ellipses that the network's shape suggests, to be refined and judged by the data."""
        with measurement.timed("network"):
            pressed = network_image(self._skin, measurement.changes).structure
        finder = self._skin.areas
        areas = finder.find(pressed, finder.on_nodes(pressed))
        return ellipses_of(areas.on_map, *finder.map_places, self._search.field.typical_peak)

    def _shows_any(self, made: Estimate) -> bool:
        """Whether an estimate shows a contact."""
        finder, shown = self._skin.areas, made.structure
        return shown is not None and len(finder.find(shown, finder.on_nodes(shown))) > 0

    def _concluded(self, course: Course, measurement: Measurement) -> Estimate:
        own = super()._concluded(course, measurement)
        belief = course.belief
        assert belief is not None
        # Where every contact was tried and none explains anything, no network knows better.
        found_none = belief.done and not len(own.areas or ())
        if not self._has_network or found_none:
            return own
        # What a small budget left unfinished has no claim before it explains the data, and each
        # contact was asked what it is.
        is_told = belief.done or (belief.is_explained and all(belief.rivals))
        fits = own.misfit <= UNSURE_MISFIT and Flag.MISFIT_HIGH not in own.flags
        if fits and is_told:
            return own
        # It has learnt scenes that no few contacts describe; but where data are left unexplained,
        # sheets may contradict each other, and no network is sure enough to hide that.
        why = "the search has not ended" if fits else "no pressure field explains the data"
        made = network_estimate(self._skin, measurement, why)
        if len(own.areas or ()) and not self._shows_any(made):
            return own  # what is felt is not hidden
        flags, at_rest = made.flags | own.flags, course.at_rest
        return replace(made, misfit=own.misfit, flags=flags, carried=course, lasting=at_rest)

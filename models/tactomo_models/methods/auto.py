"""`auto`: as much model as a scene needs, by physics and network together.

The network proposes contacts where a fit starts cold; a pressure field is fitted and judged by the
data. Where no field explains the data, or the structure channel is missing, the network stands in.
Where a sensor has no network, the physics does it alone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from tactomo_models.arrays import FloatArray, Image
from tactomo_models.methods.fit import OutlineFit
from tactomo_models.methods.method import Estimate, Skin, UnsolvableError
from tactomo_models.methods.moves import Propose, ShapeModel
from tactomo_models.methods.network import network_estimate, network_image
from tactomo_models.methods.trained_networks import NONE_TRAINED
from tactomo_models.scans.measurement import Measurement
from tactomo_models.scans.plausibility import Flag
from tactomo_models.scene.field_account import FieldAccount
from tactomo_models.scene.field_fit import FittedField
from tactomo_models.scene.pressure_field import ellipses_of

UNSURE_MISFIT: Final = 1.5  # of all channels together, from which the network is asked


# Error of a network's map where a field explains the data, as a share of it, about. Half or twice
# as much changes ICC by 0.003 at 20 dB.
NETWORK_ERROR: Final = 0.2
NEGLIGIBLE: Final = 0.1  # share of a network's map that is not worth asking for
# Contacts, of more of which a network's map is no help to a field that explains the data: with it
# ICC of five and six is 0.985 for 0.991, of eight to ten 0.912 for 0.921.
HEDGED: Final = 4


class Auto(OutlineFit):
    """The network proposes, the physics fits, the data judge."""

    shape_model = ShapeModel.AS_NEEDED

    def prepare(self, skin: Skin) -> None:
        """Make the fit of this sensor and load its network, where there is one."""
        super().prepare(skin)
        missing = skin.networks.missing
        self._has_network = not missing
        self._hedge: tuple[FieldAccount, Image] | None = None  # what a network drew beside it
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
            self._forget()  # the network fills in what is missing as best it can
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
        return ellipses_of(areas.on_map, *finder.map_places, self._typical_peak)

    def _conclude(
        self, measurement: Measurement, fitted: FittedField, account: FieldAccount, how: str
    ) -> Estimate:
        own = super()._conclude(measurement, fitted, account, how)
        if not self._has_network or len(account.areas) == 0:
            return own  # where no contact explains anything, no network knows better
        if fitted.misfit <= UNSURE_MISFIT and Flag.MISFIT_HIGH not in own.flags:
            return self._hedged(own, account, measurement)
        # It has learnt scenes that no few contacts describe; but where data are left unexplained,
        # sheets may contradict each other, and no network is sure enough to hide that.
        made = network_estimate(self._skin, measurement, "no pressure field explains the data")
        return replace(made, misfit=fitted.misfit, flags=made.flags | own.flags)

    def _hedged(self, own: Estimate, account: FieldAccount, measurement: Measurement) -> Estimate:
        """The field's map, as far as the field is sure of itself; for the rest, the network's.

        Noise that leaves open how large contacts are, and how hard they press, is where a network
        knows what is likely. What the data decide is not touched: its share is the field's.
        """
        unsure = account.uncertainty**2
        share = unsure / (unsure + NETWORK_ERROR**2)
        if self._drifts or own.map is None or not share > NEGLIGIBLE or len(account.areas) > HEDGED:
            return own
        if self._hedge is None or self._hedge[0] is not account:
            with measurement.timed("network"):
                self._hedge = account, network_image(self._skin, measurement.changes).map
        return replace(own, map=own.map + share * (self._hedge[1] - own.map))

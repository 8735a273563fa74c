"""Linear methods: one precomputed matrix for each channel, and no forward solve.

`tikhonov` takes every node alike, `noser` weights nodes by how well the electrodes see them; see
`physics.tikhonov` for both and for how the regularisation parameter is chosen.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray, Image
from tactomo_models.methods.magnitudes import (
    BAD_MISFIT,
    Magnitudes,
    bare_tangent,
    known_magnitudes,
    leaves_unexplained,
    linear_magnitudes,
)
from tactomo_models.methods.method import Estimate, Skin
from tactomo_models.physics.artifact import TYPICAL_CHANGE, central_target
from tactomo_models.physics.tikhonov import (
    EVEN,
    even_scale,
    noise_figure_weight,
    noser_scale,
    prior_weight,
    tikhonov_matrix,
)
from tactomo_models.scans.changes import Changes
from tactomo_models.scans.measurement import Measurement
from tactomo_models.scans.plausibility import Flag
from tactomo_models.scene.areas import Areas

Prior = Literal["tikhonov", "noser"]


class LinearImages:
    """Linear images of a skin's channels, each matrix made when it is first needed.

    Making one takes a tenth of a second.
    """

    def __init__(self, skin: Skin, prior: Prior) -> None:
        self._skin, self._prior = skin, prior
        self._matrices: dict[Channel, Image] = {}

    def image(self, channel: Channel, change: FloatArray) -> Image:
        """Image (P,) of relative voltage changes (M,), in the direction of pressing.

        What goes the other way is cut off, unless the sensor's objects conduct either way.
        """
        description = self._skin.description
        signed = description.sign(channel) * change
        image = self.matrix(channel) @ signed.astype(np.float32)
        return image if description.either_way(channel) else np.maximum(image, 0.0, out=image)

    def matrix(self, channel: Channel) -> Image:
        """Reconstruction matrix (P, M) for the noise at hand.

        In single precision: the rounding is far below the noise, and the product is bound by
        memory.
        """
        if channel not in self._matrices:
            self._matrices[channel] = self._make_matrix(channel).astype(np.float32)
        return self._matrices[channel]

    def _make_matrix(self, channel: Channel) -> FloatArray:
        skin, jacobian = self._skin, self._skin.artifact.jacobian
        noise = skin.tare.channels[channel].relative_noise
        noser = noser_scale(jacobian, noise) if self._prior == "noser" else None
        if channel == Channel.MAGNITUDE:
            prior_scale = even_scale(skin.forward.node_areas_m2) if noser is None else noser
            weight = prior_weight(TYPICAL_CHANGE, prior_scale)
        else:  # it changes far beyond what is linear: how much says no prior
            prior_scale = EVEN if noser is None else noser
            target = central_target(skin.description, skin.artifact.bare)
            weight = noise_figure_weight(jacobian, noise, target, prior_scale)
        return tikhonov_matrix(jacobian, noise, skin.regularisation * weight, prior_scale)


class Tikhonov:
    """One linear step, every node alike."""

    prior: Prior = "tikhonov"
    # Share of the clearest area's peak. The rest of the image is blur: a contact there would be as
    # large as the sheet.
    area_cut = 0.5

    def prepare(self, skin: Skin) -> None:
        """Make each channel's matrix."""
        self._skin = skin
        self._images = LinearImages(skin, self.prior)
        self._jacobian_by_node = np.ascontiguousarray(skin.artifact.jacobian.T)
        self._node_areas_m2 = skin.forward.node_areas_m2
        for channel in skin.tare.channels:
            self._images.matrix(channel)
        if Channel.MAGNITUDE in skin.tare.channels:  # of each voltage's noise, what the image has
            self._voltages_by_node = self._jacobian_by_node.astype(np.float32)
            self._image_noise = self._node_areas_m2 @ self._images.matrix(Channel.MAGNITUDE) ** 2

    def solve(
        self, measurement: Measurement, previous: Estimate | None, budget_s: float
    ) -> Estimate:
        """Linear images of both channels; areas above half of the clearest one's peak."""
        changes, areas = measurement.changes, self._skin.areas
        with measurement.timed(self.prior):
            images = {name: self._images.image(name, each.change) for name, each in changes.items()}
            maps = {name: areas.on_map(image) for name, image in images.items()}
        with measurement.timed("contacts"):
            shown = images[Channel.STRUCTURE if Channel.STRUCTURE in images else Channel.MAGNITUDE]
            peak = max(float(np.abs(shown).max()), 1e-12)
            found = self._areas(shown, self.area_cut * peak)
            fitted, unexplained = None, False
            if Channel.MAGNITUDE in changes:
                magnitude = changes[Channel.MAGNITUDE]
                if len(found):
                    fitted = linear_magnitudes(
                        bare_tangent(self._jacobian_by_node, found), magnitude
                    )
                image = images[Channel.MAGNITUDE]
                unexplained = self._leaves_unexplained(image, fitted, magnitude)
        size, sigma = known_magnitudes(fitted, self._skin.magnitude_sign, len(found))
        return Estimate(
            map=maps.get(Channel.MAGNITUDE),
            structure=maps[Channel.STRUCTURE] / peak if Channel.STRUCTURE in maps else None,
            areas=found,
            magnitudes=size,
            magnitude_sigmas=sigma,
            tells_pressure=False,  # a linear image spreads and pales
            misfit=fitted.misfit if fitted else float("nan"),
            flags=Flag.MISFIT_HIGH if unexplained else Flag(0),
            made_by=self.prior,
        )

    def _areas(self, shown: Image, cut: float) -> Areas:
        """Areas where an image (P,) is above a cut, and those where it is as far below zero.

        One that conducts better and one that conducts worse may touch, and remain two.
        """
        finder = self._skin.areas
        better, worse = (np.where(side > cut, 1.0, 0.0) for side in (shown, -shown))
        found = finder.find(finder.on_map(better), better)
        if worse.any():
            found = found.joined(finder.find(finder.on_map(worse), worse))
        return found

    def _leaves_unexplained(
        self, image: Image, fitted: Magnitudes | None, magnitude: Changes
    ) -> bool:
        """Tell whether the magnitude channel's changes say that something else presses.

        The image is asked, once what goes against pressing is cut off, to stand out of its noise
        and to make the changes but for a remainder; the areas, which come from the structure
        channel where there is one, to make most of them. The figures are from tuning scenes; the
        last one matters most where there are many contacts.

        Args:
            image: (P,) of the magnitude channel.
            fitted: the areas' magnitudes; None where there is no area.
            magnitude: the channel's changes.
        """
        least_snr = 3.5  # of the image, amplitude: Rose's criterion asks for 3 to 5
        remainder = 0.02  # of the changes' energy, that the image may leave beside their noise
        unexplained_part = 0.3  # of the misfit of nothing, that the areas may leave
        sure = 3.0  # standard deviations of the noise's energy
        variance = magnitude.noise_variance * (magnitude.weight > 0)
        if self._node_areas_m2 @ image**2 < least_snr**2 * (self._image_noise @ variance):
            return True
        weight = np.sqrt(magnitude.precision)
        measured, made = weight * magnitude.change, weight * (image @ self._voltages_by_node)
        explained = (made @ measured) ** 2 / (made @ made)
        energy, noise = measured @ measured, magnitude.precision * variance
        by_noise = noise.sum() + sure * np.sqrt(2 * noise @ noise)
        if energy - explained > by_noise + remainder * energy:
            return True
        bad = max(BAD_MISFIT, unexplained_part * magnitude.misfit)
        return leaves_unexplained(fitted, magnitude, self._skin.magnitude_sign, bad)


class Noser(Tikhonov):
    """One linear step, nodes weighted by how well they are seen."""

    prior = "noser"


class EitherWay(Noser):
    """What `auto` and `fit` do where objects conduct better or worse than what surrounds them."""

    # Objects differ more in size than contacts do. Of 67 in measured and simulated tanks 61 are
    # found and none made up; with 0.5, 54 and none; with 0.25, 64 and 2.
    area_cut = 0.35

    def solve(
        self, measurement: Measurement, previous: Estimate | None, budget_s: float
    ) -> Estimate:
        """The linear images of both kinds, and why there is no more."""
        estimate = super().solve(measurement, previous, budget_s)
        return replace(estimate, reason="objects conduct better or worse: one linear step")

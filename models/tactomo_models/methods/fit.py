"""Shapes fitted to the structure channel, and a magnitude for each of their areas.

`fit` describes what presses by a few outlines, `levelset` by shapes of any form; see
`warm_started_fit`. Where a sensor's objects conduct better or worse than what surrounds them,
either one is the fit of both kinds (`objects`).
"""

from __future__ import annotations

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.methods.contact_model import Account, ContactModel
from tactomo_models.methods.linear import LinearImages
from tactomo_models.methods.magnitudes import BAD_MISFIT, known_magnitudes, leaves_unexplained
from tactomo_models.methods.method import Estimate, Skin, UnsolvableError
from tactomo_models.methods.objects import ObjectFit
from tactomo_models.methods.warm_started_fit import Propose, ShapeModel, WarmStartedFit
from tactomo_models.scans.measurement import Measurement
from tactomo_models.scans.plausibility import Flag
from tactomo_models.scene.contacts import map_of
from tactomo_models.scene.outlines import Outlines
from tactomo_models.scene.shape_fit import Budget, Shape


class OutlineFit:
    """A few outlines, and how hard each area is pressed."""

    shape_model = ShapeModel.OUTLINES

    def prepare(self, skin: Skin) -> None:
        """Make the fit of this sheet, unless the last tare was of the same."""
        before = getattr(self, "_skin", None)
        self._skin = skin
        self._sign = skin.magnitude_sign
        self._images = LinearImages(skin, "noser")
        self._frames_held = 0  # since the last structure scan
        if before is not None and before.forward is skin.forward:
            return
        structure = skin.description.structure
        self._fit: WarmStartedFit | ObjectFit | None = None
        if structure is None:
            return
        if structure.either_way:
            self._fit = ObjectFit(skin.forward, structure.saturated_ratio, self._linear_image)
        else:
            ratio = structure.saturated_ratio
            self._fit = WarmStartedFit(skin.forward, ratio, self.shape_model)
        self._contact_model = ContactModel(skin.forward, skin.areas, self._fit.fit)

    def solve(
        self, measurement: Measurement, previous: Estimate | None, budget_s: float
    ) -> Estimate:
        """Fit a shape, from where the frame before ended, and the magnitudes of its areas."""
        if previous is None:
            self._forget()
        if self._fit is None:
            raise UnsolvableError("no structure channel")
        if Channel.STRUCTURE not in measurement.changes:
            return self._held(measurement)
        self._frames_held = 0
        with measurement.timed("shape"):
            shape, how = self._shape(measurement, Budget(budget_s))
        solves = 3 if shape.converged else 1
        with measurement.timed("contacts"):
            own = self._contact_model.account(shape, measurement.changes, solves)
        self._made_by = self._name_of(shape)
        return self._conclude(measurement, shape, own, how, solves)

    def _forget(self) -> None:
        if self._fit is not None:
            self._fit.forget()
            self._contact_model.forget()

    def _shape(self, measurement: Measurement, budget: Budget) -> tuple[Shape, str]:
        structure = measurement.changes[Channel.STRUCTURE]
        if isinstance(self._fit, ObjectFit):
            return self._fit.follow(structure, budget)
        assert self._fit is not None
        return self._fit.follow(structure, budget, self._proposer(measurement))

    def _proposer(self, measurement: Measurement) -> Propose | None:
        """What proposes contacts to start from; None where nothing does."""
        return None

    def _name_of(self, shape: Shape) -> str:
        return "fit" if isinstance(shape.family, Outlines) else "levelset"

    def _conclude(
        self, measurement: Measurement, shape: Shape, own: Account, how: str, solves: int
    ) -> Estimate:
        """The estimate that a shape and the account of it come to."""
        flags = Flag(0) if shape.converged else Flag.NOT_CONVERGED
        if self._leaves_unexplained(measurement, shape, own):
            flags |= Flag.MISFIT_HIGH
        size, sigma = known_magnitudes(own.fitted, self._sign, len(own.areas))
        return Estimate(
            map=own.map(self._sign) if Channel.MAGNITUDE in measurement.changes else None,
            structure=own.pressed,
            areas=own.areas,
            magnitudes=size,
            magnitude_sigmas=sigma,
            misfit=shape.misfit,
            flags=flags,
            made_by=self._made_by,
            reason=how,
        )

    def _leaves_unexplained(self, measurement: Measurement, shape: Shape, shown: Account) -> bool:
        """Tell whether the data say that something else presses."""
        magnitude = measurement.changes.get(Channel.MAGNITUDE)
        return shape.misfit > BAD_MISFIT or (
            magnitude is not None and leaves_unexplained(shown.fitted, magnitude, self._sign)
        )

    def _held(self, measurement: Measurement) -> Estimate:
        """Bridge a lost structure scan with the last shape, as long as it explains the other."""
        max_held = 10  # frames without a structure scan that the last shape stands in for: 0.5 s
        self._frames_held += 1
        if self._contact_model.has_shape and self._frames_held <= max_held:
            with measurement.timed("contacts"):
                shown = self._contact_model.account_again(measurement.changes)
            fitted, magnitude = shown.fitted, measurement.changes[Channel.MAGNITUDE]
            if fitted is not None and not leaves_unexplained(fitted, magnitude, self._sign):
                size, sigma = known_magnitudes(fitted, self._sign, len(shown.areas))
                return Estimate(
                    map=map_of(shown.areas, size),
                    areas=shown.areas,
                    magnitudes=size,
                    magnitude_sigmas=sigma,
                    misfit=fitted.misfit,
                    made_by=self._made_by,
                    reason="the last shape: the structure scan is missing",
                )
        raise UnsolvableError("the structure channel is missing")

    def _linear_image(self, change: FloatArray) -> FloatArray:
        return self._images.image(Channel.STRUCTURE, change).astype(np.float64)


class LevelSetFit(OutlineFit):
    """Shapes of any form, and how hard each area is pressed."""

    shape_model = ShapeModel.LEVEL_SET
    needs = (Channel.STRUCTURE,)

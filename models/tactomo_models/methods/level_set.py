"""`levelset`: shapes of any form on the structure sheet, and a pressure for each separate area.

A frame's shapes are refined from where the last frame ended, or from the linear image where that
explains more. A level set has no derivative where nothing presses, so that it cannot find what
lands by itself: the linear image of what the shapes leave unexplained is added to them and refined,
as long as that explains more. Outlines and pressures are then fitted to all sheets together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.errors import MethodError
from tactomo_models.methods.linear import LinearImages
from tactomo_models.methods.magnitudes import BAD_MISFIT
from tactomo_models.methods.method import Estimate, Skin, UnsolvableError
from tactomo_models.scans.measurement import Measurement
from tactomo_models.scans.plausibility import Flag
from tactomo_models.scans.stillness import are_still
from tactomo_models.scene.field_account import FieldAccount, FieldAccountant
from tactomo_models.scene.field_fit import Budget, FieldFit, FittedField, Measured
from tactomo_models.scene.level_set import LevelSet
from tactomo_models.scene.pressure_field import PressureField
from tactomo_models.scene.sheet_response import GradedResponse
from tactomo_models.sensor.description import SensorDescription

GOOD_MISFIT = 1.0  # explained to the noise (discrepancy principle): no further step, no other start
# Of the linear image's peak, where outlines may start. With half of the first as well, ICC stays
# (crowds 0.895, ordinary scenes 0.891); with 0.85 as well, 0.883 and 0.889.
CUT_HEIGHTS = (0.35, 0.6)


@dataclass(frozen=True)
class _Solved:
    """What a frame leaves for the next one."""

    shapes: FittedField  # on the structure sheet
    fitted: FittedField  # the same on all sheets, with pressures
    account: FieldAccount  # of these
    measured: Measured


class LevelSetFit:
    """Shapes of any form, and how hard each area is pressed."""

    needs = (Channel.STRUCTURE,)
    uses_sheets = True

    @staticmethod
    def check(description: SensorDescription) -> None:
        """Refuse a sensor whose objects conduct better or worse than what surrounds them.

        Raises:
            MethodError: it is such a sensor.
        """
        if description.either_way(Channel.STRUCTURE):
            raise MethodError(
                "method 'levelset' finds what changes the conductivity one way, and objects of "
                f"sensor {description.name!r} conduct better or worse; use auto, or another method"
            )

    def prepare(self, skin: Skin) -> None:
        """Make the fit of this sensor, with its sheets as they are."""
        self._skin = skin
        self._images = LinearImages(skin, "noser")
        self._fit = FieldFit(skin.forward, skin.description, skin.tare.sheets)
        self._accountant = FieldAccountant(self._fit, skin.areas)
        self._level_set = LevelSet(skin.forward)
        graded = self._fit.responses.get(Channel.MAGNITUDE)
        assert graded is None or isinstance(graded, GradedResponse)
        self._field = PressureField.on(skin.forward, graded)

    def solve(
        self, measurement: Measurement, previous: Estimate | None, budget_s: float
    ) -> Estimate:
        """Refine the shapes, then shapes and pressures together, within the budget."""
        if Channel.STRUCTURE not in measurement.changes:
            raise UnsolvableError("the structure channel is missing")
        measured = self._skin.tare.with_model_error(measurement).changes
        carried = previous.carried if previous is not None else None
        last = carried if isinstance(carried, _Solved) else None
        if last is not None and last.fitted.converged and are_still(last.measured, measured):
            still = replace(self._fit.compare(last.fitted, measured), converged=True)
            return _estimate(still, last.account, "still", last)
        budget = Budget(budget_s)
        with measurement.timed("shape"):
            outlines = {Channel.STRUCTURE: measured[Channel.STRUCTURE]}
            shapes, how = self._shapes(last, outlines, budget)
            fitted = self._with_pressures(shapes, last, measured, budget)
        with measurement.timed("contacts"):
            account = self._accountant.account(fitted, measured)
        return _estimate(fitted, account, how, _Solved(shapes, fitted, account, measured))

    def _shapes(
        self, last: _Solved | None, outlines: Measured, budget: Budget
    ) -> tuple[FittedField, str]:
        """The shapes on the structure sheet, and in words what they came from."""
        mu, likely = self._level_set.prior_mean, self._fit.likely
        nothing = self._fit.evaluate(self._level_set, mu, likely, outlines)
        shapes, how = nothing, "cold start"
        if last is not None:
            warm = self._fit.compare(last.shapes, outlines)
            starts = [(warm, "warm start")]
            if warm.misfit > GOOD_MISFIT:
                starts += [(each, how) for each in self._landed(nothing, outlines, budget)]
            shapes, how = min(starts, key=lambda start: start[0].cost)
            shapes = self._fit.refine(shapes, outlines, budget, GOOD_MISFIT)
        while shapes.misfit > GOOD_MISFIT and not budget.over:
            landed = self._landed(shapes, outlines, budget)
            if not landed:
                break
            start = min(landed, key=lambda start: start.cost)
            trial = self._fit.refine(start, outlines, budget, GOOD_MISFIT)
            if trial.cost >= shapes.cost:
                break
            shapes = trial
        return shapes, how

    def _landed(self, shapes: FittedField, outlines: Measured, budget: Budget) -> list[FittedField]:
        """The shapes with the linear image of what they leave unexplained, cut at each height."""
        bare = self._fit.sheet(Channel.STRUCTURE).bare_voltages
        explained = (shapes.solutions[Channel.STRUCTURE].voltages - bare) / np.abs(bare)
        left = outlines[Channel.STRUCTURE].change - explained
        image = self._images.image(Channel.STRUCTURE, left).astype(np.float64)
        landed = []
        for height in CUT_HEIGHTS:
            likeness = np.clip(image / max(height * float(image.max()), 1e-12) - 0.5, 0, 1)
            parameters = shapes.parameters + self._level_set.parameters_of(likeness)
            drawn = self._fit.evaluate(self._level_set, parameters, shapes.log_ratio, outlines)
            if drawn is not None:
                budget.spend(drawn)
                landed.append(drawn)
        return landed

    def _with_pressures(
        self, shapes: FittedField, last: _Solved | None, measured: Measured, budget: Budget
    ) -> FittedField:
        """The shapes on all sheets, each area with a pressure where the magnitude sheet tells."""
        if Channel.MAGNITUDE not in measured:
            return shapes
        pressed = np.zeros(len(self._level_set.kernels))
        pressed[shapes.drawing.nodes] = shapes.drawing.share
        found = self._skin.areas.find(self._skin.areas.on_map(pressed), pressed)
        centres_m = found.centres_m if len(found) else np.zeros((1, 2))  # specks share a pressure
        family = self._level_set.owned_by(centres_m, self._field)
        peaks = np.full(len(centres_m), self._field.typical_peak)
        if last is not None and len(last.fitted.parameters) == len(family.prior_mean):
            peaks = last.fitted.parameters[-len(peaks) :]
        parameters = np.append(shapes.parameters, peaks)
        fitted = self._fit.evaluate(family, parameters, shapes.log_ratio, measured)
        fitted = self._fit.refine(fitted, measured, budget, 0.0)
        return replace(fitted, converged=fitted.converged and shapes.converged)


def _estimate(fitted: FittedField, account: FieldAccount, how: str, carried: _Solved) -> Estimate:
    flags = Flag(0)
    if not fitted.converged and fitted.misfit > GOOD_MISFIT:
        flags |= Flag.NOT_CONVERGED
    if fitted.worst_misfit > BAD_MISFIT:
        flags |= Flag.MISFIT_HIGH
    return Estimate(
        map=account.map if Channel.MAGNITUDE in fitted.residuals else None,
        structure=account.structure,
        areas=account.areas,
        magnitudes=account.magnitudes,
        magnitude_sigmas=account.magnitude_sigmas,
        account=account,
        misfit=fitted.misfit,
        flags=flags,
        reason=how,
        carried=carried,
    )

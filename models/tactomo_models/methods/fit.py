"""A pressure field fitted to all sheets that have a scan.

What presses is described by a few contacts; see `warm_started_fit`. Where a sensor's objects
conduct better or worse than what surrounds them, there is a linear image alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.methods.linear import EitherWay
from tactomo_models.methods.magnitudes import BAD_MISFIT
from tactomo_models.methods.method import Estimate, Skin, UnsolvableError
from tactomo_models.methods.moves import Propose, ShapeModel
from tactomo_models.methods.warm_started_fit import WarmStartedFit
from tactomo_models.physics.actual_sheet import SheetEstimator
from tactomo_models.scans.changes import Changes
from tactomo_models.scans.measurement import Measurement
from tactomo_models.scans.plausibility import Flag
from tactomo_models.scene.field_account import FieldAccount, FieldAccountant
from tactomo_models.scene.field_fit import Budget, FieldFit, FittedField, Measured
from tactomo_models.scene.level_set import LevelSet
from tactomo_models.scene.pressure_field import PressureField

PATIENCE_S = 1.0  # of work on data that no field explains, before a drift is tried
EXPLAINED = 1.4  # misfit of the worst sheet, below which a drift beside a field is believed
MOST_DRIFT = 0.2  # of a sheet's voltages, 10 K at 2 % per kelvin: more is a fault


class OutlineFit:
    """A few contacts: their outlines, and how hard each presses."""

    shape_model = ShapeModel.OUTLINES
    uses_sheets = True

    def prepare(self, skin: Skin) -> None:
        """Make the fit of this sensor, unless the last tare was of the same."""
        before = getattr(self, "_skin", None)
        self._skin = skin
        self._either_way: EitherWay | None = None
        if skin.description.either_way(Channel.STRUCTURE):
            self._either_way = EitherWay()
            self._either_way.prepare(skin)
            return
        self._frames_held = 0  # since the last structure scan
        self._last: tuple[FittedField, FieldAccount] | None = None
        self._odds: list[float] = []  # of what the last account was made with
        if before is None or before.forward is not skin.forward:
            self._field_fit = FieldFit(skin.forward, skin.description)
            self._accountant = FieldAccountant(self._field_fit, skin.areas)
            self._fit = WarmStartedFit(self._field_fit, self.shape_model)
            self._drifting_fit = WarmStartedFit(self._field_fit, self.shape_model)
            self._drift: FloatArray | None = None  # see `SheetEstimator.drift`
            self._typical_peak = self._fit.typical_peak
        self._field_fit.sheets = dict(skin.sheets)
        self._error_ratios = {
            name: skin.channels[name].error_ratio(sheet.bare_voltages)
            for name, sheet in skin.sheets.items()
        }

    def solve(
        self, measurement: Measurement, previous: Estimate | None, budget_s: float
    ) -> Estimate:
        """Fit a field, from where the frame before ended."""
        if self._either_way is not None:
            return self._either_way.solve(measurement, previous, budget_s)
        measurement = self._as_sheets_are(measurement)
        if previous is None:
            self._forget()
        if Channel.STRUCTURE in self._skin.description.channels:
            if Channel.STRUCTURE not in measurement.changes:
                return self._held(self._drifting(measurement) if self._drifts else measurement)
            self._frames_held = 0
        with measurement.timed("shape"):
            fitted, how, measurement = self._fitted(measurement, Budget(budget_s))
        with measurement.timed("contacts"):
            account = self._account(fitted, measurement.changes)
        self._made_by = self._name_of(fitted)
        return self._conclude(measurement, fitted, account, how)

    def _as_sheets_are(self, measurement: Measurement) -> Measurement:
        """The same, with changes as sure as the sheets that they are judged by are known."""
        changes = {
            name: each.judged_by(self._error_ratios[name]) if name in self._error_ratios else each
            for name, each in measurement.changes.items()
        }
        return replace(measurement, changes=changes)

    def _drifting(self, measurement: Measurement) -> Measurement:
        """The same, where the sheets may have drifted since the tare."""
        if self._drift is None:
            self._drift = SheetEstimator(self._skin.description, self._skin.artifact.bare).drift()
        changes = {
            name: each.drifting(self._since_tare(name, each)[:, None] * self._drift)
            for name, each in measurement.changes.items()
        }
        return replace(measurement, changes=changes)

    def _since_tare(self, name: Channel, changes: Changes) -> FloatArray:
        """Voltages (M,) of a scan over the amounts that they had at the tare, signs kept."""
        return np.sign(self._field_fit.sheet(name).bare_voltages) + changes.change

    def _forget(self) -> None:
        self._fit.forget()
        self._drifting_fit.forget()
        self._drifts: bool | None = None  # whether only a drift explains the data; None: not tried
        self._unexplained_s = 0.0  # of work on data that no field has explained yet
        self._last = None

    def _fitted(
        self, measurement: Measurement, budget: Budget
    ) -> tuple[FittedField, str, Measurement]:
        """The field, in words what it came from, and the measurement that it is judged by."""
        given_s = budget.left_s
        if self._drifts:
            beside = self._beside_drift(measurement, budget)
            if self._drifted(beside[0], measurement) < MOST_DRIFT:
                return beside
            self._drifts = False
        fitted, how = self._fit.follow(measurement.changes, budget, self._proposer(measurement))
        self._unexplained_s += given_s - budget.left_s
        if _worst_misfit(fitted) <= BAD_MISFIT:
            self._unexplained_s = 0.0
        at_end = fitted.converged or self._unexplained_s > PATIENCE_S
        may_drift = measurement.may_drift and self._drifts is None
        if not (at_end and self._unexplained_s and may_drift):
            return fitted, how, measurement
        # This once the frame may take as long again.
        beside = self._beside_drift(measurement, Budget(given_s) if budget.over else budget)
        misfit, drifted = _worst_misfit(beside[0]), self._drifted(beside[0], measurement)
        if misfit <= EXPLAINED and drifted < MOST_DRIFT:
            self._drifts = True
            return beside
        self._drifts = False if beside[0].converged else None
        return fitted, how, measurement

    def _beside_drift(
        self, measurement: Measurement, budget: Budget
    ) -> tuple[FittedField, str, Measurement]:
        """The field beside a drift; nothing is proposed: who does so takes the drift for specks."""
        drifting = self._drifting(measurement)
        fitted, how = self._drifting_fit.follow(drifting.changes, budget)
        return fitted, f"{how}, drifted since the tare", drifting

    def _drifted(self, fitted: FittedField, measurement: Measurement) -> float:
        """By what share a sheet's voltages have drifted at most, beside what presses."""
        shares = []
        for name, solution in fitted.solutions.items():
            changes, bare = measurement.changes[name], self._field_fit.sheet(name).bare_voltages
            ratio = self._since_tare(name, changes) * np.abs(bare) / solution.voltages
            shares.append(abs(float(np.median(ratio[changes.weight > 0])) - 1))
        return max(shares)

    def _account(self, fitted: FittedField, measured: Measured) -> FieldAccount:
        """The account of a field; that of the frame before while neither field nor doubts moved."""
        course = self._drifting_fit if self._drifts else self._fit
        doubts = course.doubts
        odds = [doubt.odds for doubt in doubts]
        last = self._last
        if last is not None and last[0].drawing is fitted.drawing and self._odds == odds:
            return last[1]
        self._odds = odds
        known = {name: measured[name] for name in fitted.residuals}
        account = self._accountant.account(fitted, known, doubts)
        self._last = fitted, account
        return account

    def _proposer(self, measurement: Measurement) -> Propose | None:
        """What proposes contacts to start from; None where nothing does."""
        return None

    def _name_of(self, fitted: FittedField) -> str:
        return "fit" if isinstance(fitted.family, PressureField) else "levelset"

    def _conclude(
        self, measurement: Measurement, fitted: FittedField, account: FieldAccount, how: str
    ) -> Estimate:
        """The estimate that a field and the account of it come to."""
        unfinished = 1.2  # misfit below which what is still being refined explains the data already
        flags = Flag(0)
        if not fitted.converged and fitted.misfit > unfinished:
            flags |= Flag.NOT_CONVERGED
        if self._leaves_unexplained(fitted, account):
            flags |= Flag.MISFIT_HIGH
        return Estimate(
            map=account.map if Channel.MAGNITUDE in measurement.changes else None,
            structure=account.structure if Channel.STRUCTURE in measurement.changes else None,
            areas=account.areas,
            magnitudes=account.magnitudes,
            magnitude_sigmas=account.magnitude_sigmas,
            account=account,
            misfit=fitted.misfit,
            flags=flags,
            made_by=self._made_by,
            reason=how,
        )

    def _leaves_unexplained(self, fitted: FittedField, account: FieldAccount) -> bool:
        """Tell whether the data say that something else presses."""
        return _worst_misfit(fitted) > BAD_MISFIT or account.goes_wrong_way

    def _held(self, measurement: Measurement) -> Estimate:
        """Bridge a lost structure scan with the last field, as long as it explains the other."""
        max_held = 10  # frames without a structure scan that the last field stands in for: 0.5 s
        self._frames_held += 1
        last = self._last
        if last is not None and len(last[1].areas) and self._frames_held <= max_held:
            with measurement.timed("contacts"):
                held = self._with_outlines_of(last[0], measurement.changes)
                account = self._accountant.account(held, measurement.changes)
            if held.misfit <= BAD_MISFIT and not account.goes_wrong_way:
                sigmas = last[1].areas.sigmas
                if len(sigmas) == len(account.areas):  # outlines are no surer than they were
                    account = replace(account, areas=replace(account.areas, sigmas=sigmas))
                return Estimate(
                    map=account.map,
                    areas=account.areas,
                    magnitudes=account.magnitudes,
                    magnitude_sigmas=account.magnitude_sigmas,
                    account=account,
                    misfit=held.misfit,
                    made_by=self._made_by,
                    reason="the last shape: the structure scan is missing",
                )
        raise UnsolvableError("the structure channel is missing")

    def _with_outlines_of(self, last: FittedField, measured: Measured) -> FittedField:
        """Contacts as they were, with pressures as they are now."""
        family, parameters = last.family, last.parameters
        if isinstance(family, PressureField):
            family = family.with_peaks_alone(parameters)
            parameters = family.join(family.fixed)
        elif isinstance(family, LevelSet):
            family = family.with_peaks_alone(parameters)
        held = self._field_fit.evaluate(family, parameters, last.log_ratio, measured)
        assert held is not None
        steps = 3  # pressures alone are nearly linear
        return self._field_fit.refine(held, measured, Budget(1.0), 0.0, steps)


def _worst_misfit(fitted: FittedField) -> float:
    return max(fitted.misfit_of(name) for name in fitted.residuals)

"""`fit`: a pressure field of a few contacts, fitted to all sheets that have a scan.

How contacts are found from frame to frame: `search`. Here the sheets are taken as the tare knows
them, a drift of theirs is allowed for where nothing else explains the data, and a lost structure
scan is bridged. Where a sensor's objects conduct better or worse than what surrounds them, there is
a linear image alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.methods.account import Frame, Propose
from tactomo_models.methods.linear import EitherWay
from tactomo_models.methods.magnitudes import BAD_MISFIT
from tactomo_models.methods.method import Estimate, Skin, UnsolvableError
from tactomo_models.methods.search import Belief, Search
from tactomo_models.scans.changes import Changes
from tactomo_models.scans.companion_forces import CompanionForce
from tactomo_models.scans.measurement import Measurement
from tactomo_models.scans.plausibility import Flag
from tactomo_models.scene.field_account import FieldAccount, FieldAccountant
from tactomo_models.scene.field_fit import Budget, FieldFit, FittedField
from tactomo_models.scene.pressure_field import PressureField

PATIENCE_S = 1.0  # of work on data that no field explains, before a drift is tried
EXPLAINED = 1.4  # misfit of the worst sheet, below which a drift beside a field is believed
MAX_DRIFT = 0.2  # of a sheet's voltages, 10 K at 2 % per kelvin: more is a fault
WRONG = 1e-3  # how likely it is, beforehand, that companions read what they like
MAX_HELD = 10  # frames without a structure scan that the last field stands in for: 0.5 s


@dataclass(frozen=True)
class Course:
    """What a fit carries from frame to frame."""

    belief: Belief | None = None  # None: start cold
    drifts: bool | None = None  # whether only a drift explains the data; None: not tried
    unexplained_s: float = 0.0  # of work on data that no field has explained yet
    frames_held: int = 0  # since the last structure scan
    account: FieldAccount | None = None  # of the belief
    # companions that the sheets were asked about, and those that they then made unlikely
    believed: frozenset[str] = frozenset()
    disputed: Mapping[str, CompanionForce] = field(default_factory=dict)

    @property
    def at_rest(self) -> Course | None:
        """What is known once nothing presses: that the sheets have drifted since the tare."""
        return Course(drifts=True) if self.drifts else None


class Fit:
    """A few contacts: their outlines, and how hard each presses."""

    uses_sheets = True

    def prepare(self, skin: Skin) -> None:
        """Make the fit of this sensor, with its sheets as they are."""
        self._skin = skin
        self._either_way: EitherWay | None = None
        if skin.description.either_way(Channel.STRUCTURE):
            self._either_way = EitherWay()
            self._either_way.prepare(skin)
            return
        self._field_fit = FieldFit(skin.forward, skin.description, skin.tare.sheets)
        self._search = Search(self._field_fit)
        self._accountant = FieldAccountant(self._field_fit, skin.areas)

    def solve(
        self, measurement: Measurement, previous: Estimate | None, budget_s: float
    ) -> Estimate:
        """Fit a field, from where the frame before ended."""
        if self._either_way is not None:
            return self._either_way.solve(measurement, previous, budget_s)
        carried = previous.carried if previous is not None else None
        course = carried if isinstance(carried, Course) else Course()
        measurement = self._skin.tare.with_model_error(measurement)
        if Channel.STRUCTURE in self._skin.description.channels - measurement.changes.keys():
            judged = self._drifting(measurement) if course.drifts else measurement
            return self._held(course, judged)
        with measurement.timed("shape"):
            course, measurement = self._with_companions(course, measurement, budget_s)
        with measurement.timed("contacts"):
            account = self._account(course, measurement)
        assert course.belief is not None
        course = replace(course, frames_held=0, account=account)
        return self._concluded(course, measurement)

    def _drifting(self, measurement: Measurement) -> Measurement:
        """The same, where the sheets may have drifted since the tare."""
        drift = self._skin.tare.sensor.drift
        changes = {
            name: replace(each, drift=self._since_tare(name, each)[:, None] * drift)
            for name, each in measurement.changes.items()
        }
        return replace(measurement, changes=changes)

    def _since_tare(self, name: Channel, changes: Changes) -> FloatArray:
        """Voltages (M,) of a scan over the amounts that they had at the tare, signs kept."""
        return np.sign(self._field_fit.sheet(name).bare_voltages) + changes.change

    def _followed(
        self, course: Course, measurement: Measurement, budget: Budget
    ) -> tuple[Course, Measurement]:
        """The course after this frame, and the measurement that its field is judged by."""
        given_s = budget.left_s
        if course.drifts:
            drifting = self._drifting(measurement)
            belief = self._search.advance(course.belief, Frame(drifting.data, budget))
            plain = self._without_drift(belief, measurement, given_s)
            if plain is not None:
                return plain, measurement
            if self._drifted(belief.account.fitted, measurement) < MAX_DRIFT:
                return replace(course, belief=belief), drifting
            course = Course(drifts=False)
        propose = self._proposer(measurement)
        belief = self._search.advance(course.belief, Frame(measurement.data, budget, propose))
        fitted = belief.account.fitted
        unexplained_s = course.unexplained_s + given_s - budget.left_s
        if fitted.worst_misfit <= BAD_MISFIT:
            unexplained_s = 0.0
        course = replace(course, belief=belief, unexplained_s=unexplained_s)
        at_end = belief.done or unexplained_s > PATIENCE_S
        may_drift = measurement.may_drift and course.drifts is None
        if not (at_end and unexplained_s and may_drift):
            return course, measurement
        # This once the frame may take as long again. Nothing is proposed: who does so takes the
        # drift for specks.
        drifting = self._drifting(measurement)
        beside = self._search.advance(None, Frame(drifting.data, Budget(given_s)))
        field = beside.account.fitted
        if field.worst_misfit <= EXPLAINED and self._drifted(field, measurement) < MAX_DRIFT:
            return replace(course, belief=beside, drifts=True), drifting
        return replace(course, drifts=False if beside.done else None), measurement

    def _with_companions(
        self, course: Course, measurement: Measurement, budget_s: float
    ) -> tuple[Course, Measurement]:
        """The same as `_followed`, without the companions that contradict the sheets.

        Those that do not are fitted beside the sheets. Now and then, and where not all data are
        explained, the sheets are asked alone, from a cold start; the frame may take as long again.
        """
        companions = measurement.companions
        disputed = {k: one for k, one in course.disputed.items() if k in companions}
        trusted = {k: one for k, one in companions.items() if k not in disputed}
        fitted, judged = self._beside(course, measurement, trusted, budget_s)
        assert fitted.belief is not None
        if fitted.belief.how != "still":
            disputed = {k: companions[k] for k in disputed}
        fitted = replace(fitted, believed=course.believed & trusted.keys(), disputed=disputed)
        if self._are_doubtful(fitted, trusted):
            return self._questioned(fitted, judged, measurement, trusted, budget_s)
        again = self._agreeing_again(fitted, companions)
        if again:
            return self._trusted_again(fitted, judged, measurement, again, budget_s)
        return fitted, judged

    def _beside(
        self,
        course: Course,
        measurement: Measurement,
        companions: Mapping[str, CompanionForce],
        budget_s: float,
    ) -> tuple[Course, Measurement]:
        """The same as `_followed`, with these companions alone beside the sheets."""
        return self._followed(course, replace(measurement, companions=companions), Budget(budget_s))

    def _are_doubtful(self, fitted: Course, trusted: Mapping[str, CompanionForce]) -> bool:
        """Whether the sheets are to be asked about the companions that were fitted beside them."""
        belief = fitted.belief
        assert belief is not None
        if not trusted or not (belief.done or not belief.is_explained):
            return False
        if not belief.is_explained or _is_new(belief) or trusted.keys() - fitted.believed:
            return True
        felt = self._forces(belief, trusted)
        return not all(one.agrees_with(felt[name][0]) for name, one in trusted.items())

    def _questioned(
        self,
        fitted: Course,
        judged: Measurement,
        measurement: Measurement,
        trusted: Mapping[str, CompanionForce],
        budget_s: float,
    ) -> tuple[Course, Measurement]:
        """The course without the companions that the sheets alone contradict."""
        alone, sheets = self._beside(Course(drifts=fitted.drifts), measurement, {}, budget_s)
        assert fitted.belief is not None
        assert alone.belief is not None
        if not (alone.belief.is_explained or alone.belief.done):
            return fitted, judged
        told = self._forces(alone.belief, trusted)
        wrong = {k: one for k, one in trusted.items() if not one.agrees_with(*told[k])}
        if not wrong and fitted.belief.done and _are_unlikely(trusted, fitted.belief, alone.belief):
            wrong = dict(trusted)
        believed = frozenset(trusted.keys() - wrong.keys())
        if not wrong:
            return replace(fitted, believed=believed), judged
        return replace(alone, believed=believed, disputed={**fitted.disputed, **wrong}), sheets

    def _agreeing_again(
        self, fitted: Course, companions: Mapping[str, CompanionForce]
    ) -> dict[str, CompanionForce]:
        """Disputed companions that the sheets no longer contradict; rarely while nothing is new."""
        belief = fitted.belief
        assert belief is not None
        if not fitted.disputed or not belief.done:
            return {}
        now = {name: companions[name] for name in fitted.disputed}
        told = self._forces(belief, now)
        return {
            name: one
            for name, one in now.items()
            if one.agrees_with(*told[name])
            and (_is_new(belief) or _has_changed(belief, fitted.disputed[name], one))
        }

    def _trusted_again(
        self,
        fitted: Course,
        judged: Measurement,
        measurement: Measurement,
        again: Mapping[str, CompanionForce],
        budget_s: float,
    ) -> tuple[Course, Measurement]:
        """The course with companions that were disputed, where the sheets bear them out."""
        companions = measurement.companions
        assert fitted.belief is not None
        if fitted.belief.how == "still":  # fitted to another frame, whose noise is another
            trusted = {k: companions[k] for k in fitted.believed}
            cold = Course(drifts=fitted.drifts)
            anew, judged = self._beside(cold, measurement, trusted, budget_s)
            fitted = replace(anew, believed=fitted.believed, disputed=fitted.disputed)
        kept = {k: companions[k] for k in fitted.believed | again.keys()}
        beside, beside_judged = self._beside(fitted, measurement, kept, budget_s)
        assert fitted.belief is not None
        assert beside.belief is not None
        if not beside.belief.is_explained or _are_unlikely(again, beside.belief, fitted.belief):
            return fitted, judged
        disputed = {k: one for k, one in fitted.disputed.items() if k not in again}
        return replace(beside, believed=frozenset(kept), disputed=disputed), beside_judged

    def _forces(
        self, belief: Belief, companions: Mapping[str, CompanionForce]
    ) -> dict[str, tuple[float, float]]:
        """The force that each companion should feel of a belief, and its standard uncertainty."""
        if not companions:  # in every frame of most sensors
            return {}
        drawing = belief.account.fitted.drawing
        by_share, by_pressure = drawing.slopes()[2:]
        share, pressure = drawing.share, drawing.pressure_kpa
        covariance = np.linalg.inv(belief.account.hessian)[:-1, :-1]
        forces = {}
        for name, one in companions.items():
            weights = one.n_per_kpa[drawing.nodes]
            slope = (weights * pressure) @ by_share + (weights * share) @ by_pressure
            sigma_n = float(np.sqrt(slope @ covariance @ slope))
            forces[name] = float(weights @ (share * pressure)), sigma_n
        return forces

    def _without_drift(
        self, belief: Belief, measurement: Measurement, given_s: float
    ) -> Course | None:
        """A course without a drift, where contacts alone explain the data; asked rarely."""
        if belief.how == "still" or belief.frames & (belief.frames - 1):
            return None
        propose = self._proposer(measurement)
        plain = self._search.advance(None, Frame(measurement.data, Budget(given_s), propose))
        return Course(plain) if plain.account.fitted.worst_misfit <= EXPLAINED else None

    def _drifted(self, fitted: FittedField, measurement: Measurement) -> float:
        """By what share a sheet's voltages have drifted at most, beside what presses."""
        shares = []
        for name, solution in fitted.solutions.items():
            changes, bare = measurement.changes[name], self._field_fit.sheet(name).bare_voltages
            ratio = self._since_tare(name, changes) * np.abs(bare) / solution.voltages
            shares.append(abs(float(np.median(ratio[changes.weight > 0])) - 1))
        return max(shares)

    def _proposer(self, measurement: Measurement) -> Propose | None:
        """What proposes contacts to start from; None where nothing does."""
        return None

    def _account(self, course: Course, measurement: Measurement) -> FieldAccount:
        """The account of a belief; that of the frame before while nothing in it moved."""
        belief = course.belief
        assert belief is not None
        if course.account is not None and belief.how == "still" and belief.done:
            return course.account
        # Where the frame is still, it is of the frame that was fitted.
        jacobian = None if belief.how == "still" else belief.account.jacobian
        return self._accountant.account(
            belief.account.fitted,
            belief.judged(measurement.data),
            belief.alternatives,
            jacobian,
        )

    def _concluded(self, course: Course, measurement: Measurement) -> Estimate:
        """The estimate that a belief and the account of it come to."""
        belief, account = course.belief, course.account
        assert belief is not None
        assert account is not None
        fitted = belief.account.fitted
        unfinished = 1.2  # misfit below which what is still being refined explains the data already
        flags = Flag(0)
        if not belief.done and fitted.misfit > unfinished:
            flags |= Flag.NOT_CONVERGED
        if fitted.worst_misfit > BAD_MISFIT or account.goes_wrong_way:
            flags |= Flag.MISFIT_HIGH
        if course.disputed:
            flags |= Flag.COMPANION_DISPUTED
        felt = self._forces(belief, course.disputed)
        disputes = [
            f"companion {name} reads {one.force_n:.3g} N where the sheets say "
            f"{felt[name][0]:.3g} N: left out"
            for name, one in course.disputed.items()
        ]
        how = belief.how + (", drifted since the tare" if course.drifts else "")
        return Estimate(
            map=account.map if Channel.MAGNITUDE in measurement.changes else None,
            structure=account.structure if Channel.STRUCTURE in measurement.changes else None,
            areas=account.areas,
            magnitudes=account.magnitudes,
            magnitude_sigmas=account.magnitude_sigmas,
            account=account,
            has_drifted=bool(course.drifts),
            misfit=fitted.misfit,
            flags=flags,
            made_by="fit",
            reason="; ".join([f"{how}, {_in_words(belief)}", *disputes]),
            companions=dict.fromkeys(measurement.companions, True)
            | dict.fromkeys(course.disputed, False),
            carried=course,
            lasting=course.at_rest,
        )

    def _held(self, course: Course, measurement: Measurement) -> Estimate:
        """Bridge a lost structure scan with the last field, as long as it explains the other."""
        course = replace(course, frames_held=course.frames_held + 1)
        belief, last = course.belief, course.account
        if belief is None or last is None or not len(last.areas) or course.frames_held > MAX_HELD:
            raise UnsolvableError("the structure channel is missing")
        with measurement.timed("contacts"):
            held = self._with_outlines_of(belief.account.fitted, measurement)
            account = self._accountant.account(held, measurement.data)
        if held.misfit > BAD_MISFIT or account.goes_wrong_way:
            raise UnsolvableError("the structure channel is missing")
        if len(last.areas) == len(account.areas):  # outlines are no surer than they were
            account = replace(account, areas=replace(account.areas, sigmas=last.areas.sigmas))
        return Estimate(
            map=account.map,
            areas=account.areas,
            magnitudes=account.magnitudes,
            magnitude_sigmas=account.magnitude_sigmas,
            account=account,
            misfit=held.misfit,
            made_by="fit",
            reason="the last shape: the structure scan is missing",
            carried=course,
            lasting=course.at_rest,
        )

    def _with_outlines_of(self, last: FittedField, measurement: Measurement) -> FittedField:
        """Contacts as they were, with pressures as they are now."""
        assert isinstance(last.family, PressureField)
        family = last.family.with_peaks_alone(last.parameters)
        parameters = family.join(family.fixed)
        held = self._field_fit.evaluate(family, parameters, last.log_ratio, measurement.data)
        steps = 3  # pressures alone are nearly linear
        return self._field_fit.refine(held, measurement.data, Budget(1.0), 0.0, steps)


def _is_new(belief: Belief | None) -> bool:
    """Whether something moved in the frame that this came of: rarely, of many such frames."""
    return belief is None or (belief.how != "still" and not belief.frames & (belief.frames - 1))


def _has_changed(belief: Belief, before: CompanionForce, now: CompanionForce) -> bool:
    """Whether a companion reads something else than when it was disputed, of the same scene."""
    return belief.how == "still" and not now.agrees_with(before.force_n, before.sigma_n)


def _are_unlikely(companions: Mapping[str, CompanionForce], beside: Belief, alone: Belief) -> bool:
    """Whether it is likelier that companions are wrong than that their forces are what presses.

    By the evidence of all data over that of the sheets alone, which is the density of the readings
    as the sheets predict them. One that is wrong may read any force of that size.
    """
    sigmas = [one.sigma_n / max(abs(one.force_n), one.sigma_n) for one in companions.values()]
    foreseen = beside.account.log_evidence - alone.account.log_evidence
    return bool(foreseen - np.log(sigmas).sum() < np.log(WRONG))


def _in_words(belief: Belief) -> str:
    count = belief.account.family.count
    return f"{count} contact{'s' * (count != 1)}"

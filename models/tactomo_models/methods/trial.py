"""A trial of some contacts of a field, while the rest is frozen and answers to first order.

What a contact is matters little to the others: they move aside a little. So a trial solves for its
own contacts alone, and what the others would do follows from their Jacobian:

    r(p) = r_s(p) - J_o H_o^-1 J_o^T (r_s(p) - r_0)      H_o = J_o^T J_o + prior precision

with r_s the residual with the others frozen and r_0 that of the minimum to begin with. The log
ratio belongs to all: it answers as the others do, unless there are none. (Stepped by a trial, it
leads where the others do not follow to first order: a trial of the very same contact then ended
up to 13 nats away.) The same Schur complement makes the evidence of a trial comparable with that
of the whole field.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.methods.account import (
    NEGLIGIBLE,
    Account,
    Frame,
    damped_steps,
    limited_step,
    without_light_peaks,
)
from tactomo_models.methods.kinds import log_prior
from tactomo_models.scene.evidence import log_occam
from tactomo_models.scene.field_fit import FieldFit, FittedField
from tactomo_models.scene.parameters import E1, E2, SIZE, UNIT_M, X, Y
from tactomo_models.scene.pressure_field import PressureField

# Nodes between outlines, below which a neighbour is fitted with a trial: each outline is a node
# wide, a triangle lies around it, and the trial may move by a node. Where neighbours at 10 mm
# answer to first order alone, a trial of the very same contact errs by up to 13 nats.
NEAR_NODES = 5
# Of a trial, which takes three where the data are explained; elsewhere it may have far to go.
STEPS, FAR_STEPS = 6, 20
# Of chi-squared: what the Jacobian foresees of a last step is taken for true, without a solve. Half
# or twice of it changes solves by 3 % and maps of mixed presses by 0.0001; with twice, a ring that
# a soft press is taken for is 0.7 nats off.
FORESEEN = 0.5
# Logarithm of odds: a rival below is not asked again, for what others become changes its odds by
# less. Where after so many steps the Jacobian foresees such an end, a trial is given up: after one,
# a tenth fewer solves, rectangles and rings 0.983 instead of 0.984; after three, a tenth more.
HOPELESS, SURE_STEPS = -6.0, 2


def gaps_between(contacts: FloatArray) -> FloatArray:
    """Distances (K, K) between outlines of contacts (K, COLUMNS), m, about."""
    place = contacts[:, [X, Y]] * UNIT_M
    reach = np.exp(contacts[:, SIZE] + np.hypot(*contacts[:, [E1, E2]].T))
    apart = np.linalg.norm(place[:, None] - place, axis=2)
    return np.asarray(apart - reach[:, None] - reach)


@dataclass(frozen=True)
class Trial:
    """What a trial ended in."""

    log_odds: float  # logarithm of its evidence over that of the field as it was
    contacts: FloatArray  # (m, COLUMNS) what presses instead
    sigmas: FloatArray  # (m, COLUMNS) standard uncertainties; 0 of what is not fitted


class Rest:
    """All of a field but some of its contacts, frozen.

    Args:
        fit: what fits fields to the sheets.
        field: a field without contacts.
        account: the field at its minimum.
        replaced: which contacts a trial puts something else for.
        frame: the data.
        is_apart: whether no trial comes to touch the others; else each solves for all of them.
    """

    def __init__(
        self,
        fit: FieldFit,
        field: PressureField,
        account: Account,
        replaced: Sequence[int],
        frame: Frame,
        *,
        is_apart: bool = True,
    ) -> None:
        self._fit, self._field, self._account, self._frame = fit, field, account, frame
        self._replaced = list(replaced)
        fitted = account.fitted
        assert isinstance(fitted.family, PressureField)
        self._precision, self._offset = fit.prior(fitted)
        others = [k for k in range(len(account.contacts)) if k not in self._replaced]
        gaps = gaps_between(account.contacts)[np.ix_(others, self._replaced)].min(
            axis=1, initial=np.inf
        )
        nearest = [others[at] for at in np.argsort(gaps)]
        near = np.count_nonzero(gaps < NEAR_NODES * field.half_width_m) if is_apart else len(others)
        self._background = None
        while near < len(others) and self._background is None:
            free = [*self._replaced, *nearest[:near]]
            self._background = fit.background(fitted, free, frame.measured)
            near += self._background is None
        self._near = account.contacts[nearest[:near]]
        frozen = nearest[near:]
        self._frozen = account.contacts[frozen]
        index = fitted.family.index[frozen].ravel()
        self._keep: IntArray = np.sort(index[index >= 0])
        if frozen:  # the log ratio answers, too
            self._keep = np.append(self._keep, len(self._precision) - 1)
        self._own = slice(-1 if frozen else None)  # of a trial's parameters and the log ratio
        J = account.jacobian[:, self._keep]
        normal = J.T @ J
        normal[np.diag_indices(len(normal))] += self._precision[self._keep]
        self._root = np.linalg.cholesky(normal)
        self._aside = np.linalg.solve(self._root, J.T)  # (n, sum M): what of a residual they take
        told = without_light_peaks(fitted, account.jacobian)[:, self._keep]
        self._J = frame.likelihood.deflation[:, None] * told

    def trial(self, contacts: FloatArray) -> Trial | None:
        """Fit contacts (m, COLUMNS) in place of those that are replaced, from where they are.

        None where the forward model has no answer.
        """
        family = self._family(contacts)
        best = self._assessed(
            family,
            family.bounded(family.join(family.fixed)),
            self._account.fitted.log_ratio,
        )
        if best is None and self._background is not None:
            return self._touching.trial(contacts)
        if best is None:
            return None
        damping, unit = 1.0, self._account.unit
        explained = self._frame.likelihood.explains(self._account.chi_squared)
        steps, sure = (STEPS, SURE_STEPS) if explained else (FAR_STEPS, STEPS)
        J = self._jacobian(best)
        for taken in range(steps if len(best.fitted.parameters) else 0):
            normal, gradient = self._normal_equations(best, J)
            newton = -np.linalg.solve(normal, gradient)
            near_end = float(-gradient @ newton) * unit < FORESEEN
            if near_end or taken >= sure:
                told = np.where(J.any(axis=0), newton, 0.0)
                last = limited_step(self._fit, best.fitted, told)
                end = self._judged(family, best, J, last)
                if near_end or end.log_odds < HOPELESS:
                    return end
            better, damping = self._step(family, best, normal, gradient, damping)
            if better is None:
                break
            gain, best = best.cost - better.cost, better
            J = self._jacobian(best)
            if gain * unit < NEGLIGIBLE:
                break
        return self._judged(family, best, J, np.zeros(J.shape[1]))

    @cached_property
    def _touching(self) -> Rest:
        """The same for trials that touch the others."""
        return Rest(
            self._fit, self._field, self._account, self._replaced, self._frame, is_apart=False
        )

    def _family(self, contacts: FloatArray) -> PressureField:
        every = np.vstack([self._near, contacts])
        return self._field.of(every, fits_peaks=self._frame.fits_peaks)

    def _evaluated(
        self, family: PressureField, parameters: FloatArray, log_ratio: float
    ) -> FittedField | None:
        fitted = self._fit.evaluate(
            family, parameters, log_ratio, self._frame.measured, background=self._background
        )
        if fitted is not None:
            self._frame.budget.spend(fitted)
        return fitted

    def _assessed(
        self, family: PressureField, parameters: FloatArray, log_ratio: float
    ) -> _Assessed | None:
        fitted = self._evaluated(family, parameters, log_ratio)
        if fitted is None:
            return None
        before = self._account.fitted
        residual = fitted.residual
        taken = self._aside @ (residual - before.residual)
        prior, offset = (each[self._own] for each in self._fit.prior(fitted))
        cost = float(residual @ residual - taken @ taken + prior @ offset**2)
        return _Assessed(fitted, taken, prior, offset, cost)

    def _normal_equations(self, at: _Assessed, J: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Matrix (n, n) and gradient (n,) of half the linearised cost, the others answering."""
        own = self._aside @ J
        normal = J.T @ J - own.T @ own
        normal[np.diag_indices(len(normal))] += at.prior
        return normal, J.T @ at.fitted.residual - own.T @ at.taken + at.prior * at.offset

    def _step(
        self,
        family: PressureField,
        at: _Assessed,
        normal: FloatArray,
        gradient: FloatArray,
        damping: float,
    ) -> tuple[_Assessed | None, float]:
        """Levenberg-Marquardt, the others answering: what is better, and the damping for next."""
        count, fitted = len(at.fitted.parameters), at.fitted
        limited = partial(limited_step, self._fit, fitted)
        steps = damped_steps(normal, gradient, at.prior, damping, limited, self._account.unit)
        for step, damped in steps:
            trial = self._assessed(
                family,
                fitted.parameters + step[:count],
                fitted.log_ratio + float(step[count:].sum()),
            )
            if trial is not None and trial.cost < at.cost:
                return trial, max(damped / 5, 1e-3)
        return None, damping

    def _jacobian(self, at: _Assessed) -> FloatArray:
        return self._fit.jacobian(at.fitted, self._frame.measured)[:, self._own]

    def _judged(
        self,
        family: PressureField,
        at: _Assessed,
        sensed: FloatArray,  # (sum M, n) its Jacobian
        step: FloatArray,  # (n,) that is left to go, to first order
    ) -> Trial:
        account, likelihood = self._account, self._frame.likelihood
        ahead = sensed @ step
        taken = at.taken + self._aside @ ahead
        chi_squared = likelihood.chi_squared(at.fitted.residual + ahead - self._aside.T @ taken)
        scale = likelihood.precision(chi_squared)
        response = -np.linalg.solve(self._root.T, taken)
        kept, prior = self._precision[self._keep], at.prior
        away = kept @ (self._offset[self._keep] + response) ** 2 + prior @ (at.offset + step) ** 2
        hessian = scale * (self._J.T @ self._J) + np.diag(kept)
        told = without_light_peaks(at.fitted, sensed)

        def schur(jacobian: FloatArray) -> FloatArray:
            J = likelihood.deflation[:, None] * jacobian
            cross = scale * (self._J.T @ J)
            own = scale * (J.T @ J) + np.diag(prior)
            return np.asarray(own - cross.T @ np.linalg.solve(hessian, cross))

        log_evidence = likelihood.log(chi_squared) - away / 2
        log_evidence += log_occam(kept, hessian) + log_occam(prior, schur(told))
        count, sigmas = len(at.fitted.parameters), np.zeros(family.free.shape)
        contacts = family.split(at.fitted.parameters + step[:count])
        variances = np.diag(np.linalg.inv(schur(sensed)))
        sigmas[family.free] = np.sqrt(variances)[:count]
        near = len(self._near)
        log_evidence += log_prior(self._frozen) + log_prior(contacts)
        return Trial(
            log_odds=float(log_evidence) - account.log_evidence,
            contacts=contacts[near:],
            sigmas=sigmas[near:],
        )


@dataclass(frozen=True)
class _Assessed:
    """A trial on its way."""

    fitted: FittedField
    taken: FloatArray  # (n,) what the others take of its residual
    prior: (
        FloatArray  # (N,) inverse variances of its parameters, and of the log ratio where it steps
    )
    offset: FloatArray  # (N,) of the same from what is likely
    cost: float

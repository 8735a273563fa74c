"""An account of a frame: contacts fitted to all of its sheets at once, and how likely they are."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.methods.kinds import kind_of, log_prior
from tactomo_models.scene.evidence import Likelihood, log_occam
from tactomo_models.scene.field_fit import (
    MAX_DAMPING,
    Budget,
    FieldFit,
    FittedField,
    Measured,
    bounded_step,
    predicted_gain,
)
from tactomo_models.scene.parameters import PEAK, SIZE, UNIT_M, X, Y
from tactomo_models.scene.pressure import CLEARLY
from tactomo_models.scene.pressure_field import PressureField

# Of an outline of radius r on nodes a distance h apart: the standard deviation of its place, size,
# elongation and bulges as the mesh shows them, times the square of h / r, relative to r. Discs of
# 8 to 18 mm against outlines sharp to 0.2 mm, on two sensors: 0.02 to 0.25, of bulges to 0.4. With
# half, 6 % of mixed moving presses are surely wrong, with this none.
MESH_ERROR = 0.1
NEGLIGIBLE = 0.1  # of chi-squared, a third of a standard deviation: what a last step may leave
# Of the square of a failed step's length, as the prior measures it: a longer step is the same
# again. With 0.8 the solves are the same to 2 %.
SAME_STEP = 0.9

Propose = Callable[[], FloatArray]  # (K, COLUMNS) contacts, see `pressure_field.ellipses_of`


@dataclass(frozen=True)
class Frame:
    """What one frame is fitted to, and what the fit may spend."""

    measured: Measured  # the changes of each channel that has a scan
    budget: Budget  # compute time
    propose: Propose | None = None  # asked for contacts where a search starts cold

    @cached_property
    def likelihood(self) -> Likelihood:
        """The likelihood of what the data leave."""
        return Likelihood.of(self.measured)

    @property
    def fits_peaks(self) -> bool:
        """Whether any sheet tells how hard contacts press."""
        return Channel.MAGNITUDE in self.measured


@dataclass(frozen=True)
class Account:
    """A pressure field fitted to a frame."""

    fitted: FittedField
    jacobian: FloatArray  # (sum M, N + 1) of its weighted residual
    likelihood: Likelihood  # of that residual
    chi_squared: float  # what it leaves of the data
    at_minimum: bool = False

    @property
    def family(self) -> PressureField:
        """Its contacts, and which of their parameters are fitted."""
        assert isinstance(self.fitted.family, PressureField)
        return self.fitted.family

    @cached_property
    def contacts(self) -> FloatArray:
        """(K, COLUMNS) parameters of its contacts."""
        return self.family.split(self.fitted.parameters)

    @cached_property
    def is_hardly_pressed(self) -> BoolArray:
        """Which contacts (K,) the graded sheet does not tell to press."""
        return hardly_pressed(self.family, self.fitted.parameters, self.jacobian)

    @cached_property
    def unit(self) -> float:
        """What one unit of its cost is of chi-squared."""
        return self.likelihood.unit(self.chi_squared)

    @cached_property
    def _laplace(self) -> tuple[float, FloatArray]:
        """Made where asked for: of most fields on the way to a minimum nobody asks."""
        of = self.jacobian, self.chi_squared, *self.fitted.prior
        return laplace(self.likelihood, self.family, self.fitted.parameters, *of)

    @property
    def log_evidence(self) -> float:
        """Logarithm of its evidence, see `evidence`."""
        return self._laplace[0]

    @property
    def hessian(self) -> FloatArray:
        """(N + 1, N + 1) inverse covariance of its parameters and the log ratio."""
        return self._laplace[1]

    @cached_property
    def sigmas(self) -> FloatArray:
        """(K, COLUMNS) their standard uncertainties; 0 of what is not fitted."""
        sigmas = np.zeros(self.family.free.shape)
        variance = np.diag(np.linalg.inv(self.hessian))[:-1]
        sigmas[self.family.free] = np.sqrt(variance)
        return sigmas


def account_of(fit: FieldFit, fitted: FittedField, frame: Frame) -> Account:
    """The account that a fitted field is of a frame."""
    likelihood = frame.likelihood
    jacobian = fit.jacobian(fitted, frame.measured)
    chi_squared = likelihood.chi_squared(fitted.residual)
    return Account(fitted, jacobian, likelihood, chi_squared)


def outline_errors(
    fit: FieldFit, account: Account, measured: Measured
) -> dict[Channel, FloatArray]:
    """What the mesh may make of contacts' outlines: changes (M, K) of one standard deviation each.

    Where they are allowed for, an outline that only the mesh has bent is no evidence of a kind.
    """
    contacts, spacing_m = account.contacts, fit.forward.description.spacing_m
    free = np.zeros(contacts.shape, bool)
    free[:, :PEAK] = True
    outlines = replace(account.family, fixed=contacts, free=free)
    drawing = outlines.draw(outlines.join(contacts))
    radius_m = np.exp(contacts[:, [SIZE]])
    sigma = np.repeat(MESH_ERROR * (spacing_m / radius_m) ** 2, PEAK, axis=1)
    sigma[:, [X, Y]] *= radius_m / UNIT_M
    errors = {}
    for name, changes in measured.items():
        plain = replace(changes, drift=None, outline_errors=None)
        by_outline = fit.jacobian(account.fitted, {name: plain}, drawing)[:, :-1]
        per_weight = np.where(changes.weight > 0, changes.weight, 1.0)
        errors[name] = by_outline * sigma.ravel() / per_weight[:, None]
    return errors


def laplace(
    likelihood: Likelihood,
    family: PressureField,
    parameters: FloatArray,  # (N,)
    jacobian: FloatArray,  # (sum M, N + 1) of the weighted residual
    chi_squared: float,  # what is left of the data
    precision: FloatArray,  # (N + 1,) inverse variances of what is likely
    offset: FloatArray,  # (N + 1,) from what is likely
) -> tuple[float, FloatArray]:
    """Logarithm of a field's evidence, and the Hessian (N + 1, N + 1); see `evidence`."""
    told = without_light_peaks(family, parameters, jacobian)
    hessian = likelihood.information(told, chi_squared)
    hessian[np.diag_indices(len(hessian))] += precision
    log_evidence = likelihood.log(chi_squared) - float(precision @ offset**2) / 2
    log_evidence += log_occam(precision, hessian)
    log_evidence += log_prior(map(kind_of, family.split(parameters)))
    log_evidence += math.lgamma(family.count + 1)  # log K!
    return log_evidence, hessian


def without_light_peaks(
    family: PressureField, parameters: FloatArray, jacobian: FloatArray
) -> FloatArray:
    """The derivative (sum M, N + 1) where light contacts' pressures leave no trace.

    Below its onset a graded sheet answers to nothing: any pressure down there is as likely as it
    was before. Laplace's method does not see that from a peak at the onset.
    """
    light = family.index[hardly_pressed(family, parameters, jacobian), PEAK]
    if len(light):
        jacobian = jacobian.copy()
        jacobian[:, light] = 0.0
    return jacobian


def hardly_pressed(
    family: PressureField, parameters: FloatArray, jacobian: FloatArray
) -> BoolArray:
    """Which contacts (K,) press no harder than the graded sheet's onset, as far as data tell."""
    hardly = family.free[:, PEAK].copy()
    above = family.split(parameters)[hardly, PEAK] - family.onset
    power = (jacobian[:, family.index[hardly, PEAK]] ** 2).sum(axis=0)
    hardly[hardly] = above * np.sqrt(power) < CLEARLY
    return np.asarray(hardly)


def descended(
    fit: FieldFit,
    account: Account,
    frame: Frame,
    steps: int,
    *,
    holds_ratio: bool = False,
    stays_light: bool = False,
) -> Account:
    """An account nearer to its minimum, by Levenberg-Marquardt on all sheets at once.

    It is there when no more than `NEGLIGIBLE` is left to gain, as its own Jacobian predicts that.
    What was begun is finished: a budget is looked at between fits, never within one.

    Args:
        fit: what fits fields to the sheets.
        account: where to begin.
        frame: what is fitted to.
        steps: no more than these.
        holds_ratio: whether the structure sheet's ratio stays as it is.
        stays_light: whether what presses too lightly for the graded sheet still does.
    """
    for _ in range(steps):
        fitted = account.fitted
        normal, gradient = fit.normal_equations(fitted, account.jacobian)
        if holds_ratio:
            normal[-1], normal[:, -1], gradient[-1] = 0.0, 0.0, 0.0
            normal[-1, -1] = 1.0
        if predicted_gain(normal, gradient) * account.unit < NEGLIGIBLE:
            return replace(account, at_minimum=True)
        better = _stepped(fit, account, normal, gradient, frame, stays_light)
        if better is None:
            return replace(account, at_minimum=True)
        frame.budget.spend(better)
        gain = fitted.cost - better.cost
        account = account_of(fit, better, frame)
        if gain * account.unit < NEGLIGIBLE:
            return replace(account, at_minimum=True)
    return account


def _stepped(
    fit: FieldFit,
    account: Account,
    normal: FloatArray,
    gradient: FloatArray,
    frame: Frame,
    stays_light: bool,
) -> FittedField | None:
    """The field after a step downhill; None where none is worth a solve.

    The damping grows ever faster (Nielsen, "Damping parameter in Marquardt's method", IMM-REP
    1999-05): what many data tell is only shortened once the damping comes to their information.
    """
    fitted, family = account.fitted, account.family
    light = family.light(fitted.parameters) & stays_light
    damping, growth, most = fitted.damping, 5.0, np.inf
    while damping < MAX_DAMPING:
        step = bounded_step(normal, gradient, 0.1 * damping * account.fitted.prior[0])
        step = limited_step(fit, family, fitted.parameters, fitted.log_ratio, light, step)
        gain = float(-(2 * gradient + normal @ step) @ step)
        if gain * account.unit < NEGLIGIBLE:
            return None
        length = float(account.fitted.prior[0] @ step**2)
        if length <= most:
            parameters, ratio = fitted.parameters + step[:-1], fitted.log_ratio + float(step[-1])
            trial = fit.evaluate(family, parameters, ratio, frame.measured)
            frame.budget.spend(trial)
            if trial.cost < fitted.cost:
                return replace(trial, damping=max(damping / 5, 1e-3))
            most = SAME_STEP * length
        damping, growth = damping * growth, 2 * growth
    return None


def limited_step(
    fit: FieldFit,
    family: PressureField,
    parameters: FloatArray,
    log_ratio: float,
    light: BoolArray,
    step: FloatArray,
) -> FloatArray:
    """A step (N + 1,), cut where a parameter or the log ratio has its limit.

    Args:
        fit: what knows the limits of the log ratio.
        family: the contacts.
        parameters: (N,) where the step begins.
        log_ratio: likewise.
        light: (K,) contacts whose peaks stay below the graded sheet's onset.
        step: the step.
    """
    after = family.as_light(family.bounded(parameters + step[:-1]), light)
    ratio = fit.bounded_ratio(log_ratio + float(step[-1]))
    return np.append(after - parameters, ratio - log_ratio)

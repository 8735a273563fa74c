"""What a field of other contacts would come to, predicted from the Jacobian without a solve.

Voltages go by the conductivity of nodes. From the field as it was solved, other contacts are a step
of conductivities; the residual there and its derivative follow to first order, and one step of
Newton, within the limits of the parameters, leads to the end that a fit would come to:

    r(p) = r_0 + J_nodes s(p)      s: see `FieldFit.steps_to`

The evidence of that end is compared with the evidence of the field. Of a field that is solved the
same step says what is left to gain.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.methods.account import Account, Frame, laplace, limited_step
from tactomo_models.methods.kinds import Kind, as_kind
from tactomo_models.scene.drawing import Drawing
from tactomo_models.scene.field_fit import FieldFit, Step
from tactomo_models.scene.parameters import EDGE, HOLE, PEAK
from tactomo_models.scene.pressure_field import BELOW, PressureField
from tactomo_models.scene.sheet_response import GradedResponse

PEAKS = 16  # between the onset and the largest peak, that are compared with a contact's change
RINGS = 8  # of a contact, over which a pressure that falls is averaged
MAX_LIMITED = 4  # times that parameters are held at their limits, before what is left is taken


@dataclass(frozen=True)
class Prediction:
    """The end of a fit."""

    log_evidence: float
    every: FloatArray  # (K, COLUMNS) all contacts
    log_ratio: float
    gain: float  # what the last step takes off chi-squared, by the unit of where it was asked
    own: IntArray  # (m,) which were asked about
    family: PressureField = field(repr=False)
    information: Callable[[], FloatArray] = field(repr=False)  # (N + 1, N + 1) inverse covariance

    @property
    def contacts(self) -> FloatArray:
        """(m, COLUMNS) contacts that were asked about."""
        return np.asarray(self.every[self.own])

    @property
    def sigmas(self) -> FloatArray:
        """(m, COLUMNS) their standard uncertainties; 0 of what is not fitted."""
        sigmas = np.zeros(self.family.free.shape)
        sigmas[self.family.free] = np.sqrt(np.diag(np.linalg.inv(self.information()))[:-1])
        return np.asarray(sigmas[self.own])


def predict(
    fit: FieldFit,
    bare: PressureField,
    account: Account,
    asks: Sequence[tuple[int, Kind]],
    frame: Frame,
) -> list[Prediction]:
    """What a fit would come to with one contact of another kind, for each contact and kind asked.

    Args:
        fit: what fits fields to the sheets.
        bare: a field without contacts.
        account: the field, at its minimum.
        asks: contacts, and what each may be instead.
        frame: the data.
    """
    begun = [_Begun.of(fit, bare, account, k, kind, frame) for k, kind in asks]
    steps = fit.steps_to(account.fitted, [each.drawing for each in begun], frame.measured)
    return [
        _of_kind(fit, account, k, each, step, frame)
        for (k, _), each, step in zip(asks, begun, steps, strict=True)
    ]


@dataclass(frozen=True)
class _Begun:
    """Contacts with one of another kind, to start from."""

    family: PressureField
    each: FloatArray  # (K, COLUMNS) all contacts
    own: IntArray  # (m,) what it is instead
    drawing: Drawing  # of them all, where those alone are fitted

    @classmethod
    def of(
        cls, fit: FieldFit, field: PressureField, account: Account, k: int, kind: Kind, frame: Frame
    ) -> _Begun:
        each, own = with_kind(fit, field, account, k, kind)
        family = field.of(each, fits_peaks=frame.fits_peaks)
        is_own = _among(family.count, own)
        alone = replace(family, free=family.free & is_own[:, None])
        return cls(family, each, own, alone.draw(alone.join(each)))


def _of_kind(
    fit: FieldFit, account: Account, k: int, begun: _Begun, step: Step, frame: Frame
) -> Prediction:
    family, each, own = begun.family, begun.each, begun.own
    old, light = account.family, account.is_hardly_pressed[k]
    is_own = _among(family.count, own)
    jacobian = np.empty((len(step.residual), len(family.join(each)) + 1))
    kept = np.delete(old.index, k, axis=0)
    jacobian[:, family.index[~is_own][family.free[~is_own]]] = account.jacobian[:, kept[kept >= 0]]
    jacobian[:, family.index[own][family.free[own]]] = step.by_parameters
    jacobian[:, -1] = account.jacobian[:, -1] + step.by_ratio
    residual, log_ratio = account.fitted.residual + step.residual, account.fitted.log_ratio
    at = _At(
        family, family.bounded(family.join(each)), log_ratio, residual, jacobian, is_own & light
    )
    return _end(fit, at, frame, own, account.unit)


def with_kind(
    fit: FieldFit, field: PressureField, account: Account, k: int, kind: Kind
) -> tuple[FloatArray, IntArray]:
    """All contacts (K, COLUMNS) with one of another kind, to start from; which it is now (m,)."""
    is_light = bool(account.is_hardly_pressed[k])
    contacts = start_of(fit, field, account.contacts[k], kind, is_light=is_light)
    each = np.vstack([account.contacts[:k], contacts, account.contacts[k + 1 :]])
    return each, np.arange(k, k + len(contacts))


def at_end(
    fit: FieldFit, account: Account, frame: Frame, own: IntArray | None = None
) -> Prediction:
    """What a fit comes to where it goes on, and some of its contacts; all if None."""
    fitted = account.fitted
    own = np.arange(account.family.count) if own is None else own
    is_below = _among(account.family.count, own) & account.is_hardly_pressed
    at = _At(
        account.family,
        fitted.parameters,
        fitted.log_ratio,
        fitted.residual,
        account.jacobian,
        is_below,
    )
    return _end(fit, at, frame, own, account.unit)


def _among(count: int, own: IntArray) -> BoolArray:
    is_own = np.zeros(count, bool)
    is_own[own] = True
    return is_own


def start_of(
    fit: FieldFit, field: PressureField, contact: FloatArray, kind: Kind, *, is_light: bool
) -> FloatArray:
    """What presses (m, COLUMNS) where a contact is of a kind and changes the graded sheet as much.

    What presses too lightly for the graded sheet presses no harder than its onset.
    """
    contacts = as_kind(contact, kind)
    if is_light:
        contacts[:, PEAK] = np.minimum(contacts[:, PEAK], BELOW * field.onset)
        return contacts
    graded = next((r for r in fit.responses.values() if isinstance(r, GradedResponse)), None)
    if graded is None or not len(contacts):
        return contacts
    peaks = np.linspace(field.onset, field.limits[1, PEAK], PEAKS)
    changes = _mean_changes(graded, contacts[0], field.unit_kpa * peaks)
    asked = _mean_changes(graded, contact, field.unit_kpa * contact[PEAK, None])
    contacts[:, PEAK] = np.interp(asked, changes, peaks)
    return contacts


def _mean_changes(graded: GradedResponse, contact: FloatArray, peaks_kpa: FloatArray) -> FloatArray:
    """|Relative change| of the graded sheet, mean over a contact (COLUMNS,) of each peak (n,)."""
    q_squared = (np.arange(RINGS) + 0.5) / RINGS  # rings of equal area, see `pressure_field`
    pressed = q_squared[q_squared > contact[HOLE] / 4]
    pressure = peaks_kpa[:, None] * (1 - pressed) ** contact[EDGE]
    return np.asarray(np.abs(graded.relative_change(pressure)[0]).sum(axis=1) / RINGS)


@dataclass(frozen=True)
class _At:
    """A field on the way to its minimum."""

    family: PressureField
    parameters: FloatArray  # (N,)
    log_ratio: float
    residual: FloatArray  # (sum M,) weighted
    jacobian: FloatArray  # (sum M, N + 1) its derivative
    is_below: BoolArray  # (K,) contacts whose peaks stay below the graded sheet's onset


def _end(fit: FieldFit, at: _At, frame: Frame, own: IntArray, unit: float) -> Prediction:
    family, likelihood, J = at.family, frame.likelihood, at.jacobian
    precision, offset = fit.prior(family, at.parameters, at.log_ratio)
    normal = J.T @ J
    normal[np.diag_indices(len(normal))] += precision
    gradient = J.T @ at.residual + precision * offset
    step = _newton(fit, at, normal, gradient)
    gain = -float((2 * gradient + normal @ step) @ step) * unit
    parameters = at.parameters + step[:-1]
    chi_squared = likelihood.chi_squared(at.residual + J @ step)
    found, _ = laplace(likelihood, family, parameters, J, chi_squared, precision, offset + step)
    log_ratio = at.log_ratio + float(step[-1])

    def information() -> FloatArray:
        """As uncertain as the sheet tells where a peak is just above the onset."""
        return likelihood.information(J, chi_squared) + np.diag(precision)

    return Prediction(found, family.split(parameters), log_ratio, gain, own, family, information)


def _newton(fit: FieldFit, at: _At, normal: FloatArray, gradient: FloatArray) -> FloatArray:
    """The step (N + 1,) to the minimum, as far as the limits of parameters and log ratio let it."""
    step = np.asarray(-np.linalg.solve(normal, gradient), np.float64)
    held = np.zeros(len(gradient), bool)
    light = at.is_below | at.family.light(at.parameters)
    for taken in range(1, MAX_LIMITED + 1):
        limited = limited_step(fit, at.family, at.parameters, at.log_ratio, light, step)
        beyond = ~held & (np.abs(limited - step) > 1e-12)
        step, held = limited, held | beyond
        if not beyond.any() or held.all() or taken == MAX_LIMITED:
            break
        free = ~held
        pull = gradient[free] + normal[np.ix_(free, held)] @ step[held]
        step[free] = -np.linalg.solve(normal[np.ix_(free, free)], pull)
    return step

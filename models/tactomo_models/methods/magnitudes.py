"""How hard areas are pressed whose outlines are given: a conductivity change each.

Each contact's magnitude is one unknown: K unknowns from the magnitude channel's voltages, a small
and nearly linear least-squares problem whose covariance says how far each may be trusted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tactomo_models.arrays import FloatArray
from tactomo_models.scans.changes import WRONG_WAY, Changes
from tactomo_models.scene.areas import Areas

BAD_MISFIT = 2.0  # the data are not explained: what is shown may be wrong
LINEAR_ERROR = 0.6  # of a magnitude in a linear image's outline, share of itself: two in three fit


@dataclass(frozen=True)
class Tangent:
    """The magnitude channel's voltages around given conductivity changes of K areas.

    Attributes:
        change: (K,) where it touches.
        voltages: (M,) relative voltage changes there.
        jacobian: (M, K) their derivative by the areas' changes.
    """

    change: FloatArray
    voltages: FloatArray
    jacobian: FloatArray


@dataclass(frozen=True)
class Magnitudes:
    """Relative conductivity changes of K areas, signed, with their standard uncertainties.

    Attributes:
        change: (K,) relative conductivity changes.
        sigma: (K,) standard uncertainties.
        misfit: root mean square of the noise-weighted residual.
    """

    change: FloatArray
    sigma: FloatArray
    misfit: float


def step(tangent: Tangent, measured: Changes) -> Magnitudes:
    """One step of Gauss-Newton."""
    change_limits = (-0.9, 20.0)  # relative conductivity changes that a fit may propose
    J = tangent.jacobian * measured.weight[:, None]
    residual = measured.weight * (tangent.voltages - measured.change)
    covariance = np.linalg.inv(J.T @ J + 1e-9 * np.eye(J.shape[1]))
    change = np.clip(tangent.change - covariance @ (J.T @ residual), *change_limits)
    misfit = float(np.sqrt(np.mean((residual + J @ (change - tangent.change)) ** 2)))
    # A model that does not explain the data to their noise knows its unknowns less well, too.
    variance = np.diag(covariance @ (J.T @ (measured.variance_inflation[:, None] * J)) @ covariance)
    sigma = np.sqrt(variance) * max(1.0, misfit)
    return Magnitudes(change, sigma, misfit)


def bare_tangent(jacobian_by_node: FloatArray, areas: Areas) -> Tangent:
    """Tangent at the bare sheet: no forward solve.

    Args:
        jacobian_by_node: (P, M) derivative of the relative voltage changes, a row for each node.
        areas: the K areas.
    """
    voltages = jacobian_by_node.shape[1]
    columns = np.empty((voltages, len(areas)))
    for k, share in enumerate(areas.on_nodes):
        inside = np.flatnonzero(share)
        columns[:, k] = share[inside] @ jacobian_by_node[inside]
    return Tangent(np.zeros(len(areas)), np.zeros(voltages), columns)


def linear_magnitudes(tangent: Tangent, measured: Changes) -> Magnitudes:
    """Fit each area's conductivity change in one step, for areas that a linear image shows.

    Its outline is a guess, and a magnitude goes by the area: that is most of the uncertainty.

    Args:
        tangent: at the bare sheet, of K areas.
        measured: the magnitude channel's changes.
    """
    fitted = step(tangent, measured)
    sigma = np.hypot(fitted.sigma, LINEAR_ERROR * np.abs(fitted.change))
    return replace(fitted, sigma=sigma)


def known_magnitudes(
    fitted: Magnitudes | None, sign: float, count: int
) -> tuple[FloatArray, FloatArray]:
    """Magnitudes (count,) and their standard uncertainties (count,); NaN where none is fitted.

    Args:
        fitted: the fit of as many areas; None where there is none.
        sign: of the conductivity change under pressure: what goes the other way is 0.
        count: how many areas there are.
    """
    if fitted is None:
        return np.full(count, np.nan), np.full(count, np.nan)
    return np.maximum(sign * fitted.change, 0.0), fitted.sigma


def leaves_unexplained(
    fitted: Magnitudes | None, measured: Changes, sign: float, bad_misfit: float = BAD_MISFIT
) -> bool:
    """Tell whether the areas leave the magnitude channel's changes unexplained.

    They do where there is a change and no area for it, and where an area's conductivity goes the
    way that no pressure takes it: what is shown for that is a magnitude of 0.

    Args:
        fitted: the areas' magnitudes; None where there is no area.
        measured: the magnitude channel's changes.
        sign: of the conductivity change under pressure.
        bad_misfit: from which the data are not explained.
    """
    if fitted is None:
        return measured.misfit > bad_misfit
    wrong_way = sign * fitted.change < -WRONG_WAY * fitted.sigma
    return fitted.misfit > bad_misfit or bool(wrong_way.any())

"""How hard each area is pressed: one relative conductivity change of the magnitude channel each.

Once the structure channel has given the shapes, each contact's magnitude is one unknown: K
unknowns from the magnitude channel's voltages, a small and nearly linear least-squares problem
whose covariance says how far each may be trusted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tactomo_models.areas import Areas
from tactomo_models.forward import ForwardModel

FloatArray = NDArray[np.float64]

SURE_HOLE = 3.0  # standard uncertainties between a rim's change and that of what is inside it
MOST_IN_HOLE = 0.6  # of the rim's change: with more than that inside it is no ring
TANGENT_REACH = 0.02  # change of conductivity over which the voltages are as good as linear
LINEAR_ERROR = 0.6  # of a magnitude in a linear image's outline, share of itself: two in three fit
CHANGE_LIMITS = (-0.9, 20.0)  # relative conductivity changes that a fit may propose


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
        tangent: what they were computed with; it serves again while the areas stay.
    """

    change: FloatArray
    sigma: FloatArray
    misfit: float
    tangent: Tangent


def fit_magnitudes(
    forward: ForwardModel,
    areas: Areas,
    data: FloatArray,
    weight: FloatArray,
    spread: FloatArray,
    start: Magnitudes | None = None,
    *,
    same_areas: bool = False,
    solves: int = 3,
) -> Magnitudes:
    """Fit each area's conductivity change by Gauss-Newton.

    Args:
        forward: the model of the sheet.
        areas: the K areas, at least one.
        data: (M,) relative voltage changes of the magnitude channel.
        weight: (M,) their inverse standard deviations.
        spread: (M,) factor on variances, see `ShapeFit.covariance`.
        start: an earlier fit of as many areas.
        same_areas: the earlier fit was of these very areas: where its tangent still holds there
            is nothing to solve.
        solves: forward solves allowed.
    """
    change = np.zeros(len(areas)) if start is None else start.change
    if start is not None and same_areas:
        tangent = start.tangent
    else:
        tangent, solves = _touch(forward, areas, change), solves - 1
    fitted = _step(tangent, data, weight, spread)
    while solves > 0 and np.abs(fitted.change - tangent.change).max() > TANGENT_REACH:
        tangent, solves = _touch(forward, areas, fitted.change), solves - 1
        fitted = _step(tangent, data, weight, spread)
    # Where an area is taken too large, its change comes out too small.
    by_area = fitted.change * np.nan_to_num(areas.sigmas[:, 2] / areas.areas_m2)
    return replace(fitted, sigma=np.hypot(fitted.sigma, by_area))


class MagnitudeFollower:
    """Fits magnitudes frame after frame, each time from where the last one ended.

    Args:
        forward: the model of the sheet.
    """

    def __init__(self, forward: ForwardModel) -> None:
        self._forward = forward
        self.forget()

    def forget(self) -> None:
        """Drop the warm start."""
        self._areas: Areas | None = None
        self._last: Magnitudes | None = None

    def fit(
        self,
        areas: Areas,
        data: FloatArray,
        weight: FloatArray,
        spread: FloatArray,
        *,
        solves: int,
    ) -> Magnitudes | None:
        """Fit; see `fit_magnitudes`. None where there is no area."""
        last, same = self._last, self._areas is areas
        self._areas, self._last = areas, None
        if len(areas):
            start = last if last and len(last.change) == len(areas) else None
            self._last = fit_magnitudes(
                self._forward, areas, data, weight, spread, start, same_areas=same, solves=solves
            )
        return self._last


def _step(tangent: Tangent, data: FloatArray, weight: FloatArray, spread: FloatArray) -> Magnitudes:
    """One step of Gauss-Newton."""
    J = tangent.jacobian * weight[:, None]
    residual = weight * (tangent.voltages - data)
    covariance = np.linalg.inv(J.T @ J + 1e-9 * np.eye(J.shape[1]))
    change = np.clip(tangent.change - covariance @ (J.T @ residual), *CHANGE_LIMITS)
    misfit = float(np.sqrt(np.mean((residual + J @ (change - tangent.change)) ** 2)))
    # A model that does not explain the data to their noise knows its unknowns less well, too.
    variance = np.diag(covariance @ (J.T @ (spread[:, None] * J)) @ covariance)
    sigma = np.sqrt(variance) * max(1.0, misfit)
    return Magnitudes(change, sigma, misfit, tangent)


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


def linear_magnitudes(
    tangent: Tangent, data: FloatArray, weight: FloatArray, spread: FloatArray
) -> Magnitudes:
    """Fit each area's conductivity change in one step, for areas that a linear image shows.

    Its outline is a guess, and a magnitude goes by the area: that is most of the uncertainty.

    Args:
        tangent: at the bare sheet, of K areas.
        data: (M,) relative voltage changes of the magnitude channel.
        weight: (M,) their inverse standard deviations.
        spread: (M,) factor on variances, see `ShapeFit.covariance`.
    """
    fitted = _step(tangent, data, weight, spread)
    sigma = np.hypot(fitted.sigma, LINEAR_ERROR * np.abs(fitted.change))
    return replace(fitted, sigma=sigma)


def _touch(forward: ForwardModel, areas: Areas, change: FloatArray) -> Tangent:
    where = np.flatnonzero(areas.on_nodes.any(axis=0))
    solution = forward.solve(change @ areas.on_nodes)
    bare = forward.bare_voltages
    jacobian = forward.jacobian(solution, where, areas.on_nodes[:, where].T)
    return Tangent(
        change, (solution.voltages - bare) / np.abs(bare), jacobian / np.abs(bare)[:, None]
    )


def without_holes(
    forward: ForwardModel,
    areas: Areas,
    inner: Areas,
    data: FloatArray,
    weight: FloatArray,
    spread: FloatArray,
) -> Areas:
    """Take out of each area the inner part on which nothing presses, where that is certain.

    The saturated channel sees a ring as a disc: what is inside a good conductor is hidden. The
    magnitude channel, whose contrast is mild, looks inside.

    Args:
        forward: the model of the sheet.
        areas: K areas.
        inner: the inner parts of the same areas.
        data: (M,) relative voltage changes of the magnitude channel.
        weight: (M,) their inverse standard deviations.
        spread: (M,) factor on variances, see `ShapeFit.covariance`.

    Returns:
        The same areas if none is hollow.
    """
    count = len(areas)
    rims = areas.on_nodes - inner.on_nodes
    parts = np.vstack([rims, inner.on_nodes])
    apart = Areas(parts, parts, parts[:, :2], np.ones(2 * count), np.full((2 * count, 3), np.nan))
    fitted = fit_magnitudes(forward, apart, data, weight, spread)
    J = fitted.tangent.jacobian * weight[:, None]
    inverse = np.linalg.inv(J.T @ J + 1e-9 * np.eye(2 * count))
    covariance = inverse @ (J.T @ (spread[:, None] * J)) @ inverse
    difference = np.hstack([np.eye(count), -np.eye(count)])
    rim, hole = np.split(fitted.change, 2)
    sigma = np.sqrt(np.einsum("ki,ij,kj->k", difference, covariance, difference))
    # The rim changes, the inner part hardly, and the difference is no accident.
    hollow = (np.sign(rim) * (rim - hole) > SURE_HOLE * sigma) & (hole / rim < MOST_IN_HOLE)
    if not hollow.any():
        return areas
    share = hollow[:, None]
    return Areas(
        on_map=areas.on_map - share[:, :, None] * inner.on_map,
        on_nodes=areas.on_nodes - share * inner.on_nodes,
        centres_m=areas.centres_m,
        areas_m2=areas.areas_m2 - hollow * inner.areas_m2,
        sigmas=areas.sigmas,
    )

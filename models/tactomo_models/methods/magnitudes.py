"""How hard each area is pressed: one relative conductivity change of the magnitude channel each.

Once the structure channel has given the shapes, each contact's magnitude is one unknown: K
unknowns from the magnitude channel's voltages, a small and nearly linear least-squares problem
whose covariance says how far each may be trusted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tactomo_models.arrays import FloatArray
from tactomo_models.physics.forward import ForwardModel
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
        tangent: what they were computed with; it serves again while the areas stay.
    """

    change: FloatArray
    sigma: FloatArray
    misfit: float
    tangent: Tangent


def fit_magnitudes(
    forward: ForwardModel,
    on_nodes: FloatArray,
    measured: Changes,
    start: Magnitudes | None = None,
    *,
    same_areas: bool = False,
    solves: int = 3,
) -> Magnitudes:
    """Fit each area's conductivity change by Gauss-Newton.

    Args:
        forward: the model of the sheet.
        on_nodes: (K, P) share of each pressable node that each of at least one area covers.
        measured: the magnitude channel's changes.
        start: an earlier fit of as many areas.
        same_areas: the earlier fit was of these very areas: where its tangent still holds there
            is nothing to solve.
        solves: forward solves allowed.
    """
    tangent_reach = 0.02  # change of conductivity over which the voltages are as good as linear
    change = np.zeros(len(on_nodes)) if start is None else start.change
    if start is not None and same_areas:
        tangent = start.tangent
    else:
        tangent, solves = _touch(forward, on_nodes, change), solves - 1
    fitted = _step(tangent, measured)
    while solves > 0 and np.abs(fitted.change - tangent.change).max() > tangent_reach:
        tangent, solves = _touch(forward, on_nodes, fitted.change), solves - 1
        fitted = _step(tangent, measured)
    return fitted


class WarmStartedMagnitudes:
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

    def fit(self, areas: Areas, measured: Changes, *, solves: int) -> Magnitudes | None:
        """Fit; see `fit_magnitudes`. None where there is no area."""
        last, same = self._last, self._areas is areas
        self._areas, self._last = areas, None
        if len(areas):
            start = last if last and len(last.change) == len(areas) else None
            fitted = fit_magnitudes(
                self._forward, areas.on_nodes, measured, start, same_areas=same, solves=solves
            )
            # Where an area is taken too large, its change comes out too small.
            by_area = fitted.change * np.nan_to_num(areas.sigmas[:, 2] / areas.areas_m2)
            self._last = replace(fitted, sigma=np.hypot(fitted.sigma, by_area))
        return self._last


def _step(tangent: Tangent, measured: Changes) -> Magnitudes:
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


def linear_magnitudes(tangent: Tangent, measured: Changes) -> Magnitudes:
    """Fit each area's conductivity change in one step, for areas that a linear image shows.

    Its outline is a guess, and a magnitude goes by the area: that is most of the uncertainty.

    Args:
        tangent: at the bare sheet, of K areas.
        measured: the magnitude channel's changes.
    """
    fitted = _step(tangent, measured)
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


def _touch(forward: ForwardModel, on_nodes: FloatArray, change: FloatArray) -> Tangent:
    where = np.flatnonzero(on_nodes.any(axis=0))
    solution = forward.solve(change @ on_nodes)
    bare = forward.bare_voltages
    jacobian = forward.jacobian(solution, where, on_nodes[:, where].T)
    return Tangent(
        change, (solution.voltages - bare) / np.abs(bare), jacobian / np.abs(bare)[:, None]
    )


def without_holes(forward: ForwardModel, areas: Areas, inner: Areas, measured: Changes) -> Areas:
    """Take out of each area the inner part on which nothing presses, where that is certain.

    The saturated channel sees a ring as a disc: what is inside a good conductor is hidden. The
    magnitude channel, whose contrast is mild, looks inside.

    Args:
        forward: the model of the sheet.
        areas: K areas.
        inner: the inner parts of the same areas.
        measured: the magnitude channel's changes.

    Returns:
        The same areas if none is hollow.
    """
    sure_hole = 3.0  # standard uncertainties between a rim's change and that of what is inside it
    max_in_hole = 0.6  # of the rim's change: with more than that inside it is no ring
    count = len(areas)
    parts = np.vstack([areas.on_nodes - inner.on_nodes, inner.on_nodes])
    fitted = fit_magnitudes(forward, parts, measured)
    J = fitted.tangent.jacobian * measured.weight[:, None]
    inverse = np.linalg.inv(J.T @ J + 1e-9 * np.eye(2 * count))
    covariance = inverse @ (J.T @ (measured.variance_inflation[:, None] * J)) @ inverse
    difference = np.hstack([np.eye(count), -np.eye(count)])
    rim, hole = np.split(fitted.change, 2)
    sigma = np.sqrt(np.einsum("ki,ij,kj->k", difference, covariance, difference))
    # The rim changes, the inner part hardly, and the difference is no accident.
    hollow = (np.sign(rim) * (rim - hole) > sure_hole * sigma) & (hole / rim < max_in_hole)
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

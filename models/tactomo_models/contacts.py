"""From a shape to contacts: separate areas, their place and size, and each one's magnitude.

Once the structure channel has given the shapes, each contact's magnitude is one unknown: K
unknowns from the magnitude channel's voltages, a small and nearly linear least-squares problem
whose covariance says how far each may be trusted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

from tactomo_models.forward import ForwardModel
from tactomo_models.pressure import PressureRange
from tactomo_models.shape_fit import Shape

FloatArray = NDArray[np.float64]
Image = NDArray[np.float32]

SMALLEST_AREA_M2 = 20e-6  # below this, a spot is a trace of the fit, not a contact
FARTHEST_STEP_M = 0.025  # a contact that moved more than this between frames is a new one
SURE_HOLE = 3.0  # standard uncertainties between a rim's change and that of what is inside it
MOST_IN_HOLE = 0.6  # of the rim's change: with more than that inside it is no ring
MOST_MISSED = 5  # frames that a contact may be gone and still be the same when it comes back
TANGENT_REACH = 0.02  # change of conductivity over which the voltages are as good as linear
LINEAR_ERROR = 0.6  # of a magnitude in a linear image's outline, share of itself: two in three fit
CHANGE_LIMITS = (-0.9, 20.0)  # relative conductivity changes that a fit may propose


@dataclass(frozen=True)
class Contact:
    """One pressed area.

    Attributes:
        id: its identity over time, counted up from 1.
        x_m, y_m: its centroid.
        area_m2: its area.
        magnitude: relative conductivity change of the magnitude channel, without its sign;
            NaN if unknown.
        magnitude_sigma: standard uncertainty of the magnitude.
        pressure_kpa: see `pressure_range`; NaN if unknown, the range's top if above.
        x_sigma_m, y_sigma_m: standard uncertainties of the centroid; NaN if unknown.
        area_sigma_m2: that of the area; NaN if unknown.
        pressure_sigma_kpa: standard uncertainty of the pressure; NaN but within the range.
        force_n: pressure times area; NaN if unknown.
        force_sigma_n: standard uncertainty of the force; NaN if unknown.
        pressure_range: where the pressure lies, seen from what the magnitude channel answers to.
    """

    id: int
    x_m: float
    y_m: float
    area_m2: float
    magnitude: float = float("nan")
    magnitude_sigma: float = float("nan")
    pressure_kpa: float = float("nan")
    x_sigma_m: float = float("nan")
    y_sigma_m: float = float("nan")
    area_sigma_m2: float = float("nan")
    pressure_sigma_kpa: float = float("nan")
    force_n: float = float("nan")
    force_sigma_n: float = float("nan")
    pressure_range: PressureRange = PressureRange.UNKNOWN


@dataclass(frozen=True)
class Areas:
    """Separate pressed areas.

    Attributes:
        on_map: (K, nodes_y, nodes_x) share of each map node that each area covers.
        on_nodes: (K, P) the same at the pressable nodes.
        centres_m: (K, 2) centroids.
        areas_m2: (K,).
        sigmas: (K, 3) standard uncertainties of x, y and area; NaN where unknown.
    """

    on_map: FloatArray
    on_nodes: FloatArray
    centres_m: FloatArray
    areas_m2: FloatArray
    sigmas: FloatArray

    def __len__(self) -> int:
        return len(self.areas_m2)


class AreaFinder:
    """Splits an image of what is pressed into separate areas."""

    def __init__(self, forward: ForwardModel) -> None:
        description = forward.description
        self._nodes = forward.bare.points[:, forward.bare.pressable]
        self._node_m2 = forward.node_areas_m2
        self._x, self._y = np.meshgrid(description.map_x_m, description.map_y_m)
        self._cell_m2 = (description.map_x_m[1] - description.map_x_m[0]) * (
            description.map_y_m[1] - description.map_y_m[0]
        )
        x, y = self._nodes
        column = np.abs(x[:, None] - description.map_x_m).argmin(axis=1)
        row = np.abs(y[:, None] - description.map_y_m).argmin(axis=1)
        self._nearest = (row, column)  # map node next to each pressable node

    @property
    def map_places(self) -> tuple[FloatArray, FloatArray]:
        """X and y (nodes_y, nodes_x) of the map's nodes, metres."""
        return self._x, self._y

    def on_nodes(self, image: FloatArray | Image) -> FloatArray:
        """What an image (nodes_y, nodes_x) shows at the pressable nodes, (P,)."""
        return np.asarray(image[self._nearest], np.float64)

    def find(self, pressed: FloatArray | Image, pressed_nodes: FloatArray) -> Areas:
        """Find connected areas above one half; what lies around each goes to the nearest.

        Args:
            pressed: (nodes_y, nodes_x) share pressed, 0 to 1.
            pressed_nodes: (P,) the same at the pressable nodes.
        """
        label, count = ndimage.label(pressed > 0.5, structure=np.ones((3, 3)))
        if count == 0:
            none = np.zeros((0, *pressed.shape))
            on_nodes = np.zeros((0, len(pressed_nodes)))
            return Areas(none, on_nodes, np.zeros((0, 2)), np.zeros(0), np.zeros((0, 3)))
        nearest = ndimage.distance_transform_edt(
            label == 0, return_distances=False, return_indices=True
        )
        owner = label[tuple(nearest)]
        mine = owner[None] == np.arange(1, count + 1)[:, None, None]
        on_map = mine * pressed
        areas = on_map.sum(axis=(1, 2)) * self._cell_m2
        keep = areas >= SMALLEST_AREA_M2
        on_map, areas = on_map[keep], areas[keep]
        weight = np.maximum(on_map.sum(axis=(1, 2)), 1e-12)
        centres = np.stack(
            [(on_map * axis).sum(axis=(1, 2)) / weight for axis in (self._x, self._y)], axis=1
        )
        on_nodes = mine[keep][:, *self._nearest] * pressed_nodes
        return Areas(on_map, on_nodes, centres, areas, np.full((len(areas), 3), np.nan))

    def inner_parts(self, areas: Areas, coverage: FloatArray, on_map: FloatArray) -> Areas:
        """What of each area lies within shapes that are drawn smaller.

        Args:
            areas: K areas.
            coverage: (P,) share pressed by the smaller shapes.
            on_map: (nodes_y, nodes_x) the same.
        """
        inside = np.minimum(areas.on_nodes, (areas.on_nodes > 0) * coverage)
        parts = np.minimum(areas.on_map, (areas.on_map > 0) * on_map)
        size = parts.sum(axis=(1, 2)) * self._cell_m2
        return replace(areas, on_map=parts, on_nodes=inside, areas_m2=size)

    def with_sigmas(self, areas: Areas, shape: Shape, covariance: FloatArray) -> Areas:
        """Say how far the places and sizes of a shape's areas may be trusted.

        Args:
            areas: those of the shape.
            shape: what they were found in.
            covariance: (n, n) of its parameters.
        """
        edge = shape.moving
        slope = shape.family.slope(shape.parameters, edge) * self._node_m2[edge, None]
        sigmas = np.full((len(areas), 3), np.nan)
        for k, inside in enumerate(areas.on_nodes[:, edge] > 0):
            by_area = slope[inside].sum(axis=0)
            off = self._nodes[:, edge[inside]] - areas.centres_m[k, :, None]
            by_centre = off @ slope[inside] / areas.areas_m2[k]
            gradient = np.vstack([by_centre, by_area])
            sigmas[k] = np.sqrt(np.einsum("ij,jk,ik->i", gradient, covariance, gradient))
        return replace(areas, sigmas=sigmas)


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


class Tracker:
    """Gives contacts an identity over time: the assignment that moves them least.

    Rules that a controller can rely on:

    - A contact keeps its identity while it moves less than 25 mm from one frame to the next.
    - It keeps it through a gap: what comes back within 5 frames and 25 mm is the same contact, not
      a new one. So a frame that misses a contact costs nothing.
    - Where two contacts merge, the one whose centre is nearer to that of both together lives on;
      if they part again within 5 frames, each has its own identity back.
    - An identity that is gone for longer is never used again.
    """

    def __init__(self) -> None:
        self._centres = np.zeros((0, 2))
        self._ids: list[int] = []
        self._missed: list[int] = []  # frames since each was last seen
        self._next = 1

    def update(self, centres_m: FloatArray) -> list[int]:
        """Identities of the contacts at `centres_m` (K, 2) in the next frame."""
        ids = [0] * len(centres_m)
        distance = np.linalg.norm(self._centres[:, None] - centres_m[None], axis=2)
        # Too far costs alike: such a pair is made only where nothing better is left, and dropped.
        # What has been missed comes second to what was there.
        cost = np.minimum(distance, FARTHEST_STEP_M)
        cost += np.where(np.array(self._missed, int) > 0, FARTHEST_STEP_M, 0.0)[:, None]
        found = set()
        for old, new in zip(*linear_sum_assignment(cost), strict=True):
            if distance[old, new] < FARTHEST_STEP_M:
                ids[new] = self._ids[old]
                found.add(old)
        for index, known in enumerate(ids):
            if not known:
                ids[index] = self._next
                self._next += 1
        kept = [
            old
            for old in range(len(self._ids))
            if old not in found and self._missed[old] < MOST_MISSED
        ]
        self._missed = [0] * len(ids) + [self._missed[old] + 1 for old in kept]
        self._centres = np.vstack([centres_m, self._centres[kept]])
        self._ids = ids + [self._ids[old] for old in kept]
        return ids

    def clear(self) -> None:
        """Forget all contacts; identities are not used again."""
        self._centres, self._ids, self._missed = np.zeros((0, 2)), [], []

"""Contacts as they are published: each pressed area with its identity over time and pressure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from tactomo_models.areas import Areas
from tactomo_models.pressure import PressureCurve, PressureRange, pressures_of

FloatArray = NDArray[np.float64]
Image = NDArray[np.float32]

TOUCHED = 0.05  # share of a node that a contact covers, from which it is touched
FARTHEST_STEP_M = 0.025  # a contact that moved more than this between frames is a new one
MOST_MISSED = 5  # frames that a contact may be gone and still be the same when it comes back


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


def contacts_of(
    areas: Areas,
    ids: Sequence[int],
    size: FloatArray,
    sigma: FloatArray,
    curve: PressureCurve | None,
) -> tuple[Contact, ...]:
    """Make contacts of K areas.

    Args:
        areas: where they are.
        ids: the identity of each.
        size: (K,) magnitudes; NaN where unknown.
        sigma: (K,) their standard uncertainties.
        curve: the sensor's; None where it has none.
    """
    pressures = pressures_of(curve, size, sigma, areas.areas_m2, areas.sigmas[:, 2])
    return tuple(
        Contact(
            id=ids[k],
            x_m=float(areas.centres_m[k, 0]),
            y_m=float(areas.centres_m[k, 1]),
            area_m2=float(areas.areas_m2[k]),
            magnitude=float(size[k]),
            magnitude_sigma=float(sigma[k]),
            pressure_kpa=float(pressures.kpa[k]),
            x_sigma_m=float(areas.sigmas[k, 0]),
            y_sigma_m=float(areas.sigmas[k, 1]),
            area_sigma_m2=float(areas.sigmas[k, 2]),
            pressure_sigma_kpa=float(pressures.sigma_kpa[k]),
            force_n=float(pressures.force_n[k]),
            force_sigma_n=float(pressures.force_sigma_n[k]),
            pressure_range=pressures.ranges[k],
        )
        for k in range(len(areas))
    )


def map_of(areas: Areas, values: FloatArray) -> Image:
    """Map on which each area carries its own value; areas of unknown value stay 0."""
    fused = np.einsum("k,kyx->yx", np.nan_to_num(values), areas.on_map)
    return np.asarray(fused, dtype=np.float32)


def pressure_map(areas: Areas, contacts: Sequence[Contact]) -> Image:
    """Each contact's pressure on its area; NaN, and not 0, where it is touched but unknown."""
    values = np.array([contact.pressure_kpa for contact in contacts])
    fused = map_of(areas, values)
    fused[(areas.on_map[np.isnan(values)] > TOUCHED).any(axis=0)] = np.nan
    return fused

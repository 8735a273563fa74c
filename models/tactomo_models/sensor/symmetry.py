"""The symmetries of a sensor: turns and mirror images that take every electrode to another one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.sensor.pattern import scan_positions

# Four turns, each also of the mirror image.
_TURNS = tuple(
    turn @ mirror
    for mirror in (np.eye(2), np.diag([-1.0, 1.0]))
    for turn in (np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), k) for k in range(4))
)


@dataclass(frozen=True)
class Symmetry:
    """One turn or mirror image, as what it does to data and maps of a scene."""

    matrix: FloatArray  # (2, 2) what it does to a place
    scan: IntArray  # (M,) which voltage of the scene as it was each voltage of the turned scene is
    sign: FloatArray  # (M,) by what that is multiplied: pairs may change direction
    nodes: IntArray  # (nodes_y * nodes_x,) the same for the nodes of a map


def symmetries(description: SensorDescription) -> list[Symmetry]:
    """All symmetries of a sensor's sheet, electrodes, pattern and map, the identity first.

    A square sheet has eight, an oblong one four at most; of a stretched one nothing is known.
    """
    turns = _TURNS if description.stretching is None else _TURNS[:1]
    found = (_symmetry(description, matrix) for matrix in turns)
    return [symmetry for symmetry in found if symmetry is not None]


def _symmetry(description: SensorDescription, matrix: FloatArray) -> Symmetry | None:
    nodes = _nodes(description, matrix)
    electrodes = _goes_to(description.electrode_centres_m, matrix)
    if nodes is None or electrodes is None:
        return None
    place = scan_positions(description.pairs)
    scan = np.empty(len(place), np.intp)
    sign = np.empty(len(place))
    for index, (drive, measure) in enumerate(
        zip(electrodes[description.pairs.drive], electrodes[description.pairs.measure], strict=True)
    ):
        turned = _as_measured(place, tuple(drive.tolist()), tuple(measure.tolist()))
        if turned is None:
            return None
        scan[turned[0]], sign[turned[0]] = index, turned[1]
    return Symmetry(matrix, scan, sign, nodes)


def _as_measured(
    place: dict[tuple[int, ...], int], drive: tuple[int, ...], measure: tuple[int, ...]
) -> tuple[int, float] | None:
    """Position and sign of a voltage, whichever way its pairs are connected."""
    for first, by_drive in ((drive, 1.0), (drive[::-1], -1.0)):
        for second, by_measure in ((measure, 1.0), (measure[::-1], -1.0)):
            index = place.get((*first, *second))
            if index is not None:
                return index, by_drive * by_measure
    return None


def _nodes(description: SensorDescription, matrix: FloatArray) -> IntArray | None:
    x, y = np.meshgrid(description.map_x_m, description.map_y_m)
    on_sheet = description.on_sheet(x, y).ravel()
    goes_to = _goes_to(np.stack([x.ravel(), y.ravel()], axis=1), matrix)
    return None if goes_to is None or (on_sheet[goes_to] != on_sheet).any() else np.argsort(goes_to)


def _goes_to(places: FloatArray, matrix: FloatArray) -> IntArray | None:
    """Number of the place that each of the places (n, 2) is taken to; None where there is none."""
    # A micrometre is beyond rounding, and below any distance of places.
    distance, to = cKDTree(places).query(places @ matrix.T, distance_upper_bound=1e-6)
    return to if np.isfinite(distance).all() else None

"""Outline, electrodes and pattern of an EIT model: EIDORS' fwd_model, pyEIT's mesh and protocol."""

from __future__ import annotations

from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
import shapely

from tactomo_models.archive import read_arrays
from tactomo_models.array_files import Arrays
from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.errors import DataError
from tactomo_models.imported.model import Model, Pattern, no_unit
from tactomo_models.sensor.named_pattern import NamedPattern
from tactomo_models.sensor.pattern import combined

Drives = list[tuple[tuple[int, int], list[tuple[int, int]]]]
"""Of each drive: its source and sink, and its measuring pairs, plus and minus, in order."""

PYEIT: Final = ("node", "element", "el_pos")
NEXT: Final = (
    "save an EIDORS model by `save('model.mat', 'fmdl')`, or of pyEIT's mesh and protocol "
    "node, element, el_pos, ex_mat and meas_mat by numpy.savez"
)


def read_model(path: Path, unit_mm: float | None = None) -> Model:
    """Read an EIDORS model (.mat) or the arrays of a pyEIT one (.npz).

    Args:
        path: the file.
        unit_mm: millimetres of one unit of the file.

    Raises:
        OSError: the file cannot be read.
        DataError: the file is damaged, holds no such model, or is in three dimensions.
    """
    held = read_arrays(path)
    if unit_mm is None:
        raise no_unit("an EIT model", "a disc of radius 1 takes the radius")
    try:
        if all(key in held for key in PYEIT):
            nodes, elements = held["node"][:, :3], np.asarray(held["element"], np.intp)
            electrodes = [np.atleast_1d(each) for each in np.asarray(held["el_pos"], np.intp)]
            drives, current_a = _pyeit_drives(held), 1e-4
        else:
            nodes, elements, electrodes, drives, current_a = _eidors(path, held)
        if not np.isfinite(nodes).all():
            raise ValueError("its nodes have places that are no numbers")
        if elements.shape[1] != 3 or (nodes[:, 2:] != nodes[:1, 2:]).any():
            raise DataError(
                f"{path} is a model in three dimensions, and a sheet has two; give a model of the "
                "sheet's plane, of triangles"
            )
        polygon = shapely.union_all(shapely.polygons(nodes[:, :2][elements]))
        if polygon.geom_type != "Polygon" or polygon.is_empty:
            raise DataError(f"{path}: its triangles are not one sheet; describe each as its own")
        extents = [nodes[each, :2] for each in electrodes]
        sizes = np.array([np.hypot(*np.ptp(each, axis=0)) for each in extents])
        holes = []
        for hole in map(shapely.Polygon, polygon.interiors):
            round_it = [n for n, each in enumerate(extents) if _surrounds(each, hole)]
            sizes[round_it] = 2 * np.sqrt(hole.area / np.pi)  # an electrode inside: a pad
            holes += [] if round_it else [hole.exterior]
        polygon = shapely.Polygon(polygon.exterior, holes)
        centres = np.array([each.mean(axis=0) for each in extents]).reshape(-1, 2)
        pattern = _pattern(path, drives, len(electrodes), current_a) if drives else None
    except (IndexError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise DataError(f"{path}: no model that can be read ({error}); {NEXT}") from error
    return Model(polygon, centres, sizes, unit_mm, pattern)


def _surrounds(nodes: FloatArray, hole: shapely.Polygon) -> bool:
    """Whether an electrode's nodes (n, 2) lie all round a hole, as EIDORS meshes one inside."""
    return bool(shapely.MultiPoint(nodes).convex_hull.area > 0.9 * hole.area) and bool(
        np.all(shapely.distance(hole.exterior, shapely.points(nodes)) < 1e-6 * hole.length)
    )


def _pyeit_drives(held: Arrays) -> Drives:
    if "ex_mat" not in held or "meas_mat" not in held:
        return []
    measured = np.asarray(held["meas_mat"], int)
    return [
        ((int(source), int(sink)), [(int(n), int(m)) for n, m in pairs])
        for (source, sink), pairs in zip(held["ex_mat"], measured, strict=True)
    ]


def _eidors(path: Path, held: Arrays) -> tuple[FloatArray, IntArray, list[IntArray], Drives, float]:
    prefix = next((key.removesuffix("elems") for key in held if key.endswith("elems")), None)
    if prefix is None:
        raise DataError(f"{path} holds no model of EIDORS or pyEIT; {NEXT}")
    nodes, elements = held[f"{prefix}nodes"], np.asarray(held[f"{prefix}elems"], np.intp) - 1
    electrodes = [
        np.asarray(each, np.intp).ravel() - 1 for each in _of(held, f"{prefix}electrode", "nodes")
    ]
    stimulations = _of(held, f"{prefix}stimulation", "stim_pattern")
    measured = _of(held, f"{prefix}stimulation", "meas_pattern")
    drives: Drives = []
    for current, rows in zip(stimulations, measured, strict=True):
        drives.append((_pair(path, current.ravel()), [_pair(path, row) for row in rows]))
    largest = max((float(np.abs(each).max()) for each in stimulations), default=1e-4)
    return nodes, elements, electrodes, drives, min(largest, 1.0)


def _of(held: Arrays, array: str, field: str) -> list[FloatArray]:
    """Return a field of each struct of an array."""
    if f"{array}.{field}" in held:
        return [held[f"{array}.{field}"]]
    found: list[FloatArray] = []
    while (key := f"{array}({len(found) + 1}).{field}") in held:
        found.append(held[key])
    return found


def _pair(path: Path, weights: FloatArray) -> tuple[int, int]:
    """Return the electrodes of weights that are 1 and -1, or as far apart."""
    used = np.flatnonzero(weights)
    if len(used) != 2 or weights[used].sum() != 0:
        raise DataError(
            f"{path}: a current or a voltage of {len(used)} electrodes; a description has pairs: "
            "one plus, one minus"
        )
    return int(weights.argmax()), int(weights.argmin())


def _pattern(path: Path, drives: Drives, electrodes: int, current_a: float) -> Pattern:
    """Return one list of drives and one of measuring pairs, which give the file's voltages."""
    drive = np.array([pair for pair, _ in drives], np.intp)
    asked = [(*pair, *each) for pair, pairs in drives for each in pairs]
    listed = sorted({each for _, pairs in drives for each in pairs}, key=lambda pair: pair[::-1])
    note = ""
    order: TopologicalSorter[tuple[int, int]] = TopologicalSorter(dict.fromkeys(listed, ()))
    for _, pairs in drives:
        for before, after in pairwise(pairs):
            order.add(after, before)
    try:
        measure = np.array(list(order.static_order()), np.intp)
    except CycleError:
        measure = np.array(listed, np.intp)
    scan = combined(drive, measure)
    ours = [tuple(each) for each in np.hstack([scan.drive, scan.measure]).tolist()]
    if set(ours) != set(asked):
        extra = next(iter(set(asked) ^ set(ours)))
        raise DataError(
            f"{path}: drive {list(extra[:2])} with measuring pair {list(extra[2:])}: a description "
            "measures every pair that shares no electrode with the drive, and no other"
        )
    if ours != asked:
        offsets = [int(each[0, 1] - each[0, 0]) % electrodes for each in (drive, measure)]
        named = NamedPattern(electrodes, offsets[0], min(offsets[1], electrodes - offsets[1]), True)
        note = f"Voltages in files of this model are in another order: --pattern {named}"
    return Pattern(drive, measure, current_a, note)

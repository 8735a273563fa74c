"""The bare sheet's Green's function, without a solve of the whole sheet for each of its columns.

The sheet is cut into boxes by separators. Nodes of two boxes see each other through the separators
alone, so that with A in blocks of boxes (i) and separators (s)

    G = diag(A_ii^-1) + W C^-1 W^T,   W_i = -A_ii^-1 A_is,   W_s = 1,   C = A_ss + sum_i A_si W_i

and what has to be kept are small matrices: made in a quarter of a second where solving for every
column takes four, and a block between the nodes of a press is a millisecond's product of them.

Source: Przemieniecki, "Matrix structural analysis of substructures", AIAA J. 1 (1963).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import DTypeLike, NDArray

from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.inner_loop import LIBRARY, at


class PackedGreensFunction:
    """The whole function in half its memory: it is symmetric, and a block of it is a look-up.

    Args:
        lower: (S (S + 1) / 2,) potentials at nodes for unit currents into others, row by row, each
            up to its own node.
    """

    def __init__(self, lower: NDArray[Any]) -> None:
        self.lower = lower

    def between(self, rows: IntArray, columns: IntArray) -> FloatArray:
        """Potentials (r, c) at some of the nodes for unit currents into others, by their places."""
        found = np.empty((len(rows), len(columns)))
        by_precision = (
            at(self.lower if self.lower.dtype == dtype else None)
            for dtype in (np.float32, np.float64)
        )
        rows, columns = (np.ascontiguousarray(each, np.int64) for each in (rows, columns))
        of_block = len(rows), at(rows), len(columns), at(columns)
        LIBRARY.block_of(*by_precision, *of_block, at(found))
        return found


class GreensFunction:
    """Potentials at nodes of a sheet for unit currents into others.

    Args:
        system: (n, n) sparse, symmetric positive definite; the first of its unknowns are nodes.
        nodes: (S,) those to look at.
        points: (2, S) where they are.
    """

    def __init__(self, system: sp.csc_matrix, nodes: IntArray, points: FloatArray) -> None:
        own = system[nodes][:, nodes].tocsr()
        outside = np.setdiff1d(np.arange(system.shape[0]), nodes)
        coupling = system[outside][:, nodes].tocsc()
        box = _boxes(points)
        separates = _separators(own, box)
        separates[np.diff(coupling.indptr) > 0] = True  # all that lies outside is one more box
        separators = np.flatnonzero(separates)
        condensed = own[separators][:, separators].toarray()
        condensed -= _onto_rim(system[outside][:, outside], coupling[:, separators])
        self._separators = separators
        self._parts: list[_Box] = []
        for number in np.unique(box[~separates]):
            members = np.flatnonzero((box == number) & ~separates)
            inverse = np.linalg.inv(own[members][:, members].toarray())
            towards = own[members][:, separators].tocsc()
            seen = np.flatnonzero(np.diff(towards.indptr))
            edge = towards[:, seen].toarray()
            part = _Box(members, seen, inverse, -inverse @ edge)
            condensed[np.ix_(seen, seen)] += edge.T @ part.weight
            self._parts.append(part)
        inverse = np.linalg.inv(condensed)
        self._between = (inverse + inverse.T) / 2

    @cached_property
    def _in_order(self) -> IntArray:
        """(S,) where each node stands among the members of all boxes and the separators."""
        return np.argsort(
            np.concatenate([*(part.members for part in self._parts), self._separators])
        )

    @cached_property
    def _within(self) -> sp.csr_matrix:
        """(S, S) what a box sees of itself."""
        order, size = self._in_order, len(self._separators)
        blocks = [*(part.inverse for part in self._parts), sp.csr_matrix((size, size))]
        return sp.block_diag(blocks, "csr")[order][:, order].tocsr()

    @cached_property
    def _weights(self) -> sp.csr_matrix:
        """(S, separators) by which each node sees the separators."""
        size = len(self._separators)
        weights = [_columns_at(part.weight, part.seen, size) for part in self._parts]
        return sp.vstack([*weights, sp.identity(size, format="csr")]).tocsr()[self._in_order]

    def between(self, rows: IntArray, columns: IntArray) -> FloatArray:
        """Potentials (r, c) at some of the nodes for unit currents into others, by their places."""
        here, there = self._weights[rows], self._weights[columns]
        used = np.unique(np.concatenate([here.indices, there.indices]))
        onto = self._between[np.ix_(used, used)] @ there[:, used].toarray().T
        return np.asarray(self._within[rows][:, columns].toarray() + here[:, used] @ onto)

    def packed(self, dtype: DTypeLike = np.float64) -> PackedGreensFunction:
        """All of it, of which a block is a look-up: up to hundreds of megabytes."""
        size = len(self._in_order)
        onto = np.empty((len(self._separators), size))
        onto[:, self._separators] = self._between
        for part in self._parts:
            onto[:, part.members] = self._between[:, part.seen] @ part.weight.T
        lower = np.empty(size * (size + 1) // 2, dtype)

        def keep(places: IntArray, rows: FloatArray) -> None:
            for place, row in zip(places.tolist(), rows, strict=True):
                start = place * (place + 1) // 2
                lower[start : start + place + 1] = row[: place + 1]

        keep(self._separators, onto)
        for part in self._parts:
            rows = part.weight @ onto[part.seen]
            rows[:, part.members] += part.inverse
            keep(part.members, rows)
        return PackedGreensFunction(lower)


@dataclass(frozen=True)
class _Box:
    """Nodes that see others through the separators around them alone."""

    members: IntArray  # (m,) places of the nodes
    seen: IntArray  # (k,) separators around them
    inverse: FloatArray  # (m, m) A_ii^-1
    weight: FloatArray  # (m, k) W_i


def _boxes(points: FloatArray) -> IntArray:
    """Number of the box of an even grid that each of the points (2, n) is in."""
    low, high = points.min(axis=1, keepdims=True), points.max(axis=1, keepdims=True)
    width, height = (high - low).ravel()
    # Some 220 nodes to a box: fewer mean longer separators, more mean larger inverses.
    side = np.sqrt(width * height * 220 / points.shape[1])
    column, row = np.floor((points - low) / side).astype(np.intp)
    return np.asarray(row * (column.max() + 1) + column)


def _separators(system: sp.csr_matrix, box: IntArray) -> BoolArray:
    """Tell which nodes have a neighbour in a box of a higher number."""
    row, column = system.nonzero()
    separates = np.zeros(len(box), bool)
    separates[row[box[row] < box[column]]] = True
    return separates


def _onto_rim(
    outside: sp.csc_matrix,  # (m, m) stiffness of the unknowns outside
    coupling: sp.csc_matrix,  # (m, s) of them with nodes that are kept
) -> FloatArray:
    """What eliminating all outside takes from the stiffness of the nodes that it is coupled to."""
    seen = np.flatnonzero(np.diff(coupling.indptr))
    edge = coupling[:, seen].toarray()
    factor = spla.splu(outside.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    taken = np.zeros((coupling.shape[1], coupling.shape[1]))
    taken[np.ix_(seen, seen)] = edge.T @ factor.solve(edge)
    return taken


def _columns_at(values: FloatArray, places: IntArray, size: int) -> sp.csr_matrix:
    """Sparse (n, size) with the columns (n, k) at their places."""
    count = len(values)
    first = np.arange(count + 1) * len(places)
    return sp.csr_matrix((values.ravel(), np.tile(places, count), first), (count, size))

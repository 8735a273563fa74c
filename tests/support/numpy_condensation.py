"""Static condensation in NumPy: pressed areas as seen from their rims.

Inside a pressed area no current enters or leaves, so its inner nodes can be eliminated, whatever
their conductivity: what is left is a dense matrix on the nodes of its rim. They are eliminated
layer by layer from the middle outwards. A layer couples with its two neighbours alone, so the
system is block tridiagonal and each step is a Cholesky factorisation as large as a layer is long.

Source: George, "Nested dissection of a regular finite element mesh", SIAM J. Numer. Anal. 10
(1973), for elimination by separators; the block recursion is the textbook one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf
from scipy.sparse.csgraph import connected_components
from tactomo_models.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class Condensed:
    """Pressed areas as seen from their rims."""

    rims: list[FloatArray]  # per area the (r, r) stiffness that is left on its rim
    # per area and layer that was eliminated, from the rim inwards: its Cholesky factor L and L^-1
    # E, where E couples it with the next layer outwards
    inner: list[list[tuple[FloatArray, FloatArray]]]

    def times(self, potentials: FloatArray) -> FloatArray:
        """Currents (r, k) into all rims, by the potentials (r, k) there."""
        each = zip(self.rims, self._by_area(potentials), strict=True)
        return _joined([rim @ of_rim for rim, of_rim in each])

    def inwards(self, potentials: FloatArray) -> FloatArray:
        """Potentials (n, k) of all nodes in the order of the layers, by the rims' (r, k)."""
        found = []
        for layer, inner in zip(self._by_area(potentials), self.inner, strict=True):
            found.append(layer)
            for lower, coupling in inner:
                layer = dtrsm(-1.0, lower, coupling @ layer, lower=1, trans_a=1)
                found.append(layer)
        return np.concatenate(found)

    def _by_area(self, potentials: FloatArray) -> list[FloatArray]:
        each, start = [], 0  # `np.split` takes longer than all that is done with them
        for rim in self.rims:
            each.append(potentials[start : start + len(rim)])
            start += len(rim)
        return each


class Condensation:
    """How pressed areas are condensed: all that does not depend on their conductivity."""

    def __init__(
        self,
        neighbours: IntArray,  # (n, most) of each node, filled up with -1
        rim: BoolArray,  # (n,) nodes that are not to be eliminated, one at least in each area
        corners: IntArray,  # (t, 3) nodes of each triangle
    ) -> None:
        area, depth = _areas(neighbours), _depths(neighbours, rim)
        # (n,) nodes area by area and, in each, by layers from the rim inwards
        self.order = np.lexsort((depth, area))
        place = np.empty_like(self.order)
        place[self.order] = np.arange(len(place))
        self.corners = place[corners]  # (t, 3) of the triangles, by their places in that order
        # (n,) of the nodes in that order: 0 on a rim, 1 for its neighbours, and so on
        self.depth = depth[self.order]
        first = np.append(True, (np.diff(self.depth) != 0) | (np.diff(area[self.order]) != 0))
        self._is_rim = self.depth[first] == 0
        self._lay_out(np.append(np.flatnonzero(first), len(rim)), first.cumsum() - 1)

    def _lay_out(self, start: IntArray, layer: IntArray) -> None:
        """Where each entry of the triangles' stiffness goes.

        Each layer has a block of its own, and right above it one (outer, own) that couples it
        with the next layer outwards.
        """
        self._size = np.diff(start)
        self._outer = np.where(self._is_rim, 0, np.append(0, self._size[:-1]))
        rows = np.repeat(self.corners, 3, axis=1).ravel()
        columns = np.tile(self.corners, (1, 3)).ravel()
        self._once = np.flatnonzero(layer[rows] <= layer[columns])
        rows, columns = rows[self._once], columns[self._once]
        of = layer[columns]
        self._offset = np.append(0, ((self._outer + self._size) * self._size).cumsum())
        row = rows - (start[of] - self._outer[of])
        self._place = self._offset[of] + row * self._size[of] + columns - start[of]

    def condense(self, stiffness: FloatArray) -> Condensed:
        """Eliminate the inner nodes.

        Args:
            stiffness: (t, 3, 3) of each triangle.

        Raises:
            numpy.linalg.LinAlgError: a conductivity is not above 0.
        """
        entries = stiffness.ravel()[self._once]
        flat = np.asarray(np.bincount(self._place, entries, self._offset[-1]), np.float64)
        rims: list[FloatArray] = []
        inner: list[list[tuple[FloatArray, FloatArray]]] = [[]]
        given = np.zeros(())  # by the next layer inwards
        for layer in reversed(range(len(self._size))):
            block = flat[self._offset[layer] : self._offset[layer + 1]]
            block = block.reshape(-1, self._size[layer])
            coupling, own = block[: self._outer[layer]], block[self._outer[layer] :]
            own -= given
            if self._is_rim[layer]:
                rims.insert(0, own)
                inner.insert(0, [])
                given = np.zeros(())
                continue
            lower, failed = dpotrf(own.T, lower=1, overwrite_a=1)
            if failed:
                raise np.linalg.LinAlgError("a conductivity of zero or less has no solution")
            coupled = dtrsm(1.0, lower, coupling.T, lower=1, overwrite_b=1)
            inner[0].insert(0, (lower, coupled))
            given = coupled.T @ coupled
        return Condensed(rims, inner[1:])


def _joined(each: list[FloatArray]) -> FloatArray:
    return each[0] if len(each) == 1 else np.concatenate(each)


def _depths(neighbours: IntArray, rim: BoolArray) -> IntArray:
    """Steps from each node to the nearest rim."""
    depth = np.where(rim, 0, -1)
    front = np.flatnonzero(rim)
    while len(front):
        reached = neighbours[front]
        reached = reached[reached >= 0]
        reached = reached[depth[reached] < 0]
        depth[reached] = level = depth[front[0]] + 1
        front = np.flatnonzero(depth == level)
    return depth


def _areas(neighbours: IntArray) -> IntArray:
    """Number of the connected area that each node belongs to."""
    there = neighbours >= 0
    first = np.append(0, there.sum(axis=1).cumsum())
    graph = sp.csr_matrix(
        (np.ones(first[-1]), neighbours[there], first), (len(neighbours), len(neighbours))
    )
    return np.asarray(connected_components(graph, connection="strong")[1])

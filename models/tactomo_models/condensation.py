"""Static condensation: pressed areas as seen from their rims.

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
from numpy.typing import NDArray
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf
from scipy.sparse.csgraph import connected_components

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True)
class Layers:
    """Nodes of pressed areas, area by area, and in each by layers from the rim inwards.

    Attributes:
        order: (n,) which node comes next.
        layer: (n,) layer of each node in that order.
        start: (l + 1,) where each layer starts in that order; the last is n.
        depth: (l,) of each layer: 0 for a rim, 1 for its neighbours, and so on.
    """

    order: IntArray
    layer: IntArray
    start: IntArray
    depth: IntArray


def layers_of(neighbours: IntArray, rim: NDArray[np.bool_]) -> Layers:
    """Sort the nodes of pressed areas into layers.

    Args:
        neighbours: (n, most) of each node, filled up with -1.
        rim: (n,) nodes that are not to be eliminated, one at least in each area.
    """
    depth = np.where(rim, 0, -1)
    front = np.flatnonzero(rim)
    while len(front):
        reached = neighbours[front]
        reached = reached[reached >= 0]
        reached = reached[depth[reached] < 0]
        depth[reached] = level = depth[front[0]] + 1
        front = np.flatnonzero(depth == level)
    there = neighbours >= 0
    graph = sp.csr_matrix(
        (np.ones(there.sum()), neighbours[there], np.append(0, there.sum(axis=1).cumsum())),
        (len(rim), len(rim)),
    )
    _, area = connected_components(graph, connection="strong")
    order = np.lexsort((depth, area))
    depth = depth[order]
    starts = np.append(True, (np.diff(depth) != 0) | (np.diff(area[order]) != 0))
    start = np.flatnonzero(starts)
    return Layers(order, starts.cumsum() - 1, np.append(start, len(order)), depth[start])


@dataclass(frozen=True)
class Condensed:
    """Pressed areas as seen from their rims.

    Attributes:
        rims: per area the (r, r) stiffness that is left on its rim.
        inner: per area and layer that was eliminated, from the rim inwards: its Cholesky factor L
            and L^-1 E, where E couples it with the next layer outwards.
    """

    rims: list[FloatArray]
    inner: list[list[tuple[FloatArray, FloatArray]]]

    def times(self, potentials: FloatArray) -> FloatArray:
        """Currents (r, k) into all rims, by the potentials (r, k) there."""
        each = zip(self.rims, self._by_area(potentials), strict=True)
        return np.concatenate([rim @ of_rim for rim, of_rim in each])

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
        return np.split(potentials, np.cumsum([len(rim) for rim in self.rims[:-1]]))


def condense(stiffness: FloatArray, corners: IntArray, layers: Layers) -> Condensed:
    """Eliminate the inner nodes of pressed areas.

    Args:
        stiffness: (t, 3, 3) of each triangle.
        corners: (t, 3) its corners, by their place in the layers' order.
        layers: of the nodes.

    Raises:
        numpy.linalg.LinAlgError: a conductivity is not above 0.
    """
    own, coupling = _blocks(stiffness, corners, layers)
    rims: list[FloatArray] = []
    inner: list[list[tuple[FloatArray, FloatArray]]] = [[]]
    for layer in reversed(range(len(own))):
        if layers.depth[layer] == 0:
            rims.insert(0, own[layer])
            inner.insert(0, [])
            continue
        lower, failed = dpotrf(own[layer].T, lower=1, overwrite_a=1)
        if failed:
            raise np.linalg.LinAlgError("a conductivity of zero or less has no solution")
        coupled = dtrsm(1.0, lower, coupling[layer].T, lower=1, overwrite_b=1)
        own[layer - 1] -= coupled.T @ coupled
        inner[0].insert(0, (lower, coupled))
    return Condensed(rims, inner[1:])


def _blocks(
    stiffness: FloatArray, corners: IntArray, layers: Layers
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Assemble each layer's own block, and (outer, own) what couples it with the next outwards."""
    size = np.diff(layers.start)
    outer = np.where(layers.depth > 0, np.append(0, size[:-1]), 0)
    rows, columns = np.repeat(corners, 3, axis=1).ravel(), np.tile(corners, (1, 3)).ravel()
    row_layer, column_layer = layers.layer[rows], layers.layer[columns]
    once = row_layer <= column_layer
    rows, columns, row_layer, of = (a[once] for a in (rows, columns, row_layer, column_layer))
    # A layer's coupling block lies right above its own, so that they share the columns.
    first = layers.start[of] - outer[of]
    offset = np.append(0, ((outer + size) * size).cumsum())
    place = offset[of] + (rows - first) * size[of] + columns - layers.start[of]
    flat = np.asarray(np.bincount(place, stiffness.ravel()[once], offset[-1]), np.float64)
    both = [flat[a:b].reshape(-1, m) for a, b, m in zip(offset, offset[1:], size, strict=False)]
    return (
        [block[m:] for block, m in zip(both, outer, strict=True)],
        [block[:m] for block, m in zip(both, outer, strict=True)],
    )

"""A pressed sheet solved and differentiated in NumPy: what `inner_loop.c` is held to.

The theory stands in `physics.forward` and `numpy_condensation`. Found anew in each solve, and slow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy_condensation import Condensation
from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.physics.bare_sheet import scan_voltages
from tactomo_models.physics.forward import ForwardModel


@dataclass(frozen=True)
class NumpySolution:
    """The same as `compiled_sheet.Solution`."""

    voltages: FloatArray
    nodes: IntArray
    potentials: FloatArray
    rim: IntArray
    injected: FloatArray
    mixed: FloatArray | None


@dataclass(frozen=True)
class _PressedAreas:
    """What a solve needs to know of the areas that are pressed, however strongly they are.

    With S and S0 the areas' stiffness on their rims, pressed and bare, the potentials there are
    u = u0 + G i, and the currents injected there i = -(S - S0) u.
    """

    triangles: IntArray  # (t,) indexed triangles that change
    condensation: Condensation  # of their corners onto the rims
    # (n,) positions of the corners in `BareSheet.support`, in the condensation's order
    nodes: IntArray
    rim: IntArray  # (r,) positions of those on rims
    potentials: FloatArray  # (r, L - 1) u0
    green: FloatArray  # (r, r) G
    both: FloatArray  # (r, r + L - 1) G and u0 side by side
    bare_both: FloatArray  # (r, r + L - 1) S0 G and S0 u0


class NumpyForwardModel:
    """Solves the sheet of a forward model.

    Args:
        model: which knows the sheet's triangles, nodes and electrode pairs.
    """

    def __init__(self, model: ForwardModel) -> None:
        self._bare, self._description = model.bare, model.description
        self._corner_support, self._corner_pressable = (
            model._corner_support,
            model._corner_pressable,
        )
        self._triangles_of, self._triangle_count = model._triangles_of, model._triangle_count
        self._neighbours, self._closed = model._neighbours, model._closed
        self._gradient, self._stiffness = model._gradient, model._stiffness
        self._area, self._bare_conductivity = model._area, model._bare_conductivity
        self._pair_matrix, self._products = model._pair_matrix, model._products
        self._product_of, self._sign = model._product_of, model._sign

    def solve(
        self, change: FloatArray, *, mix_resistivities: bool = False, within: IntArray | None = None
    ) -> NumpySolution:
        """See `ForwardModel.solve`."""
        where = np.flatnonzero(change) if within is None else within
        mixed = change if mix_resistivities else None
        if len(where) == 0:
            nowhere = np.zeros(0, np.intp)
            none = self._bare.potentials[nowhere]
            voltages = scan_voltages(self._description, self._bare.transfer)
            return NumpySolution(voltages, nowhere, none, nowhere, none, mixed)
        triangles = self._around(where)
        areas = self._explored(triangles)
        at_corners = self._at_corners(triangles, change)
        conductivity = at_corners.sum(axis=1) / 3
        if mix_resistivities:
            better = self._better(triangles, at_corners)
            conductivity[better] = 3 / (1 / at_corners[better]).sum(axis=1)
        condensed = areas.condensation.condense(
            conductivity[:, None, None] * self._stiffness[triangles]
        )
        added = condensed.times(areas.both) - areas.bare_both  # (S - S0) (G, u0)
        rim = len(areas.rim)
        system = added[:, :rim]
        system[np.diag_indices(rim)] += 1.0
        injected = np.asarray(np.linalg.solve(system, -added[:, rim:]), np.float64)
        transfer = self._bare.transfer.copy()
        transfer[:-1, :-1] += areas.potentials.T @ injected
        return NumpySolution(
            voltages=scan_voltages(self._description, transfer),
            nodes=areas.nodes,
            potentials=condensed.inwards(areas.potentials + areas.green @ injected),
            rim=areas.rim,
            injected=injected,
            mixed=mixed,
        )

    def _at_corners(self, triangles: IntArray, change: FloatArray) -> FloatArray:
        """Conductivity (t, 3) of triangles as their corners have it."""
        bare = self._bare_conductivity[triangles, None]
        return np.asarray(bare + np.append(change, 0.0)[self._corner_pressable[triangles]])

    def _better(self, triangles: IntArray, at_corners: FloatArray) -> BoolArray:
        """Tell which triangles (t,) conduct nowhere worse than the bare sheet."""
        return np.asarray((at_corners >= self._bare_conductivity[triangles, None]).all(axis=1))

    def _explored(self, triangles: IntArray) -> _PressedAreas:
        count = len(self._bare.support)
        nodes, corners = _renumbered(self._corner_support[triangles], count)
        here = np.bincount(corners.ravel())
        rim = ~self._closed[nodes] | (here < self._triangle_count[nodes])
        neighbours = _positions(nodes, count + 1)[self._neighbours[nodes]]
        condensation = Condensation(neighbours, rim, corners)
        nodes, depth = nodes[condensation.order], condensation.depth
        near, on_rim = nodes[depth <= 1], depth[depth <= 1] == 0
        # S0 needs no condensation: the bare sheet's u0 and G balance at inner nodes already, so
        # that the law itself, at rims and by their neighbours, does what S0 does.
        law = _rim_law(
            self._bare_conductivity[triangles, None, None] * self._stiffness[triangles],
            condensation.corners,
            depth,
        )
        potentials = self._bare.potentials[near]
        both = np.concatenate([self._bare.green.between(near, near[on_rim]), potentials], axis=1)
        rim = np.count_nonzero(on_rim)
        return _PressedAreas(
            triangles=triangles,
            condensation=condensation,
            nodes=nodes,
            rim=near[on_rim],
            potentials=potentials[on_rim],
            green=both[on_rim, :rim],
            both=both[on_rim],
            bare_both=law @ both,
        )

    def _around(self, nodes: IntArray) -> IntArray:
        """Indexed triangles with any of these pressable nodes as a corner."""
        found = np.zeros(len(self._area) + 1, bool)
        found[self._triangles_of[nodes]] = True
        return np.flatnonzero(found[:-1])

    def potentials(self, solution: NumpySolution, nodes: IntArray) -> FloatArray:
        """Potentials (n, L - 1) of a pressed sheet at n positions in `BareSheet.support`."""
        position = _positions(solution.nodes, len(self._bare.support))[nodes]
        outside = position < 0
        potentials = np.empty((len(nodes), self._bare.potentials.shape[1]))
        potentials[~outside] = solution.potentials[position[~outside]]
        others = nodes[outside]
        moved = self._bare.green.between(others, solution.rim) @ solution.injected
        potentials[outside] = self._bare.potentials[others] + moved
        return potentials

    def jacobian(
        self, solution: NumpySolution, where: IntArray, onto: FloatArray | None = None
    ) -> FloatArray:
        """See `ForwardModel.jacobian`."""
        triangles = self._around(where)
        nodes, corners = _renumbered(self._corner_support[triangles], len(self._bare.support))
        fields = self.potentials(solution, nodes) @ self._pair_matrix.T  # (nodes, pairs)
        gradient = self._gradient[triangles] @ fields[corners]  # (t, 2, pairs)
        node, share = self._shares(where, triangles, solution.mixed)
        onto = np.eye(len(where)) if onto is None else onto
        onto = np.append(onto, np.zeros((1, onto.shape[1])), axis=0)
        weight = (share[:, :, None] * onto[node]).sum(axis=1)  # (t, K)
        x, y = gradient.transpose(1, 2, 0)
        one, other = self._products
        summed = (x[one] * x[other] + y[one] * y[other]) @ weight
        return np.asarray(summed[self._product_of] * self._sign[:, None])

    def _shares(
        self, where: IntArray, triangles: IntArray, mixed: FloatArray | None
    ) -> tuple[IntArray, FloatArray]:
        """Where triangles' corners stand among nodes, and minus the area that goes with each.

        Returns:
            (t, 3) places in `where`, its length for other nodes; (t, 3) areas by which the
            conductivities of triangles go with those of their corners.
        """
        position = np.full(len(self._bare.pressable) + 1, len(where))  # the last: not pressable
        position[where] = np.arange(len(where))
        node = position[self._corner_pressable[triangles]]
        share = np.repeat(-self._area[triangles, None] / 3, 3, axis=1)
        if mixed is not None:  # d sigma / d sigma_i = (sigma / sigma_i)^2 / 3
            at_corners = self._at_corners(triangles, mixed)
            inverse = 1 / at_corners
            weighted = inverse / inverse.mean(axis=1)[:, None]
            weighted[~self._better(triangles, at_corners)] = 1.0
            share *= weighted**2
        return node, share


def _rim_law(stiffness: FloatArray, corners: IntArray, depth: IntArray) -> FloatArray:
    """Rows of the rims' nodes, by them and their neighbours inside, of triangles assembled."""
    # Full, although most are zero: a sparse matrix takes longer to make than this to multiply.
    rim, near = depth == 0, depth <= 1
    triangle, corner = np.nonzero(rim[corners])
    rows = (rim.cumsum() - 1)[corners[triangle, corner]]
    columns = (near.cumsum() - 1)[corners[triangle]]
    shape = np.count_nonzero(rim), np.count_nonzero(near)
    place = (rows[:, None] * shape[1] + columns).ravel()
    values = stiffness[triangle, corner].ravel()
    law = np.bincount(place, values, shape[0] * shape[1]).reshape(shape)
    return np.asarray(law, np.float64)


def _positions(members: IntArray, count: int) -> IntArray:
    """Where each number below `count` stands among `members`; -1 for those that do not."""
    position = np.full(count, -1)
    position[members] = np.arange(len(members))
    return position


def _renumbered(numbers: IntArray, count: int) -> tuple[IntArray, IntArray]:
    """The different ones of numbers below `count`, ascending, and each one's place there."""
    there = np.zeros(count, bool)
    there[numbers] = True
    different = np.flatnonzero(there)
    return different, _positions(different, count)[numbers]

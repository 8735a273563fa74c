"""The forward model: voltages of a pressed sheet by the complete electrode model.

The problem is solved once for the bare sheet, keeping the Green's function between the nodes that
can be pressed. To all that lies outside, a pressed area is what it does on its rim: its inner
nodes are condensed onto it (see `condensation`), and the currents that the rims then inject into
the bare sheet follow from a dense system on their nodes (Woodbury identity). The cost goes by the
pressed area, not by the size of the sheet.

Everything is relative to a sheet of unit conductance: conductivities are ratios to the bare
sheet's, transfer resistances are in units of the bare sheet's resistance per square.

Source: Somersalo, Cheney & Isaacson, "Existence and uniqueness for electrode models for electric
current computed tomography", SIAM J. Appl. Math. 52 (1992); Jacobian: the paper, equation 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.inner_loop import LIBRARY
from tactomo_models.physics.bare_sheet import BareSheet, scan_voltages, volts_per_unit
from tactomo_models.physics.compiled_sheet import CompiledSheet
from tactomo_models.physics.condensation import Condensation
from tactomo_models.sensor.description import SensorDescription

_STRIP = 256  # triangles, or spots, at once: what that takes stays in the cache


@dataclass(frozen=True)
class Probes:
    """Where the field is looked at: C spots, each an average over its neighbourhood."""

    bare: FloatArray  # (2 C, L - 1) field of the bare sheet there, x components first
    gradient: sp.csr_matrix  # (2 C, S) of potentials at the support nodes, averaged


@dataclass(frozen=True)
class Solution:
    """Voltages of one pressed sheet, with what its potentials and derivatives follow from."""

    voltages: FloatArray  # (M,) in scan order, relative (multiply by `ForwardModel.volts_per_unit`)
    # (n,) positions in `BareSheet.support` of the corners of all triangles that changed
    nodes: IntArray
    potentials: FloatArray  # (n, L - 1) potentials there
    rim: IntArray  # (r,) positions in `BareSheet.support` of those that other triangles touch, too
    # (r, L - 1) currents that, injected there into the bare sheet, make the pressed sheet's
    # potentials on the rims and everywhere outside
    injected: FloatArray
    # (P,) changes at the pressable nodes whose resistivities were mixed; None where conductivities
    # were
    mixed: FloatArray | None = None


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


class ForwardModel:
    """Voltages and their derivatives for relative conductivities on the pressable nodes.

    Args:
        description: the sensor.
        bare: its sheet, solved.

    Attributes:
        bare_voltages: (M,) of the unpressed sheet, in scan order; see `volts_per_unit`.
        at_rest: (P,) conductivity of the unpressed sheet at the pressable nodes.
    """

    def __init__(self, description: SensorDescription, bare: BareSheet) -> None:
        self.description = description
        self.bare = bare
        self.volts_per_unit = volts_per_unit(description)
        self.bare_voltages = scan_voltages(description, bare.transfer)
        self._index_pairs()
        self._index_triangles()
        self._index_nodes()
        self._compiled = self._compile() if LIBRARY is not None else None

    def _compile(self) -> CompiledSheet:
        pairs = self.description.pairs
        arrays = {
            "corner_support": self._corner_support,
            "corner_pressable": self._corner_pressable,
            "triangles_of": self._triangles_of,
            "neighbours": self._neighbours,
            "triangle_count": self._triangle_count,
            "closed": self._closed,
            "gradient": self._gradient,
            "stiffness": self._stiffness,
            "area": self._area,
            "conductivity": self._bare_conductivity,
            "transfer": self.bare.transfer,
            "electrodes": np.concatenate([pairs.drive, pairs.measure], axis=1),
            "pair": self._different_pairs,
            "product": self._products.T,
            "product_of": self._product_of,
            "sign": self._sign,
        }
        return CompiledSheet(self.bare, arrays)

    def _index_pairs(self) -> None:
        """The different electrode pairs, and which two of them each voltage belongs to."""
        pairs = self.description.pairs
        both = np.concatenate([pairs.drive, pairs.measure])
        different, pair = np.unique(np.sort(both, axis=1), axis=0, return_inverse=True)
        self._different_pairs = different
        matrix = np.zeros((len(different), self.description.electrode_count))
        np.put_along_axis(matrix, different, [[1.0, -1.0]], axis=1)
        self._pair_matrix = matrix[:, :-1]  # the last electrode's potential is 0
        forwards = np.where(both[:, 0] < both[:, 1], 1.0, -1.0)
        self._sign = np.prod(np.split(forwards, 2), axis=0)
        # By reciprocity drive and measurement may change places: half of the products suffice.
        self._products, self._product_of = np.unique(
            np.sort(np.split(pair, 2), axis=0), axis=1, return_inverse=True
        )

    def _index_triangles(self) -> None:
        """Corners, gradients and stiffness of the triangles that touch a pressable node."""
        bare = self.bare
        nodes = bare.points.shape[1]
        touched = np.flatnonzero(np.isin(bare.triangles, bare.pressable).any(axis=0))
        corners = bare.triangles[:, touched]  # (3, t)
        p = bare.points[:, corners]  # (2, 3, t)
        edge = np.roll(p, -2, axis=1) - np.roll(p, -1, axis=1)  # opposite each corner
        twice = edge[0, 1] * edge[1, 2] - edge[1, 1] * edge[0, 2]
        gradient = np.stack([-edge[1], edge[0]]) / twice  # (2, 3, t) of each corner's hat function
        self._corner_support = _positions(bare.support, nodes)[corners].T  # (t, 3)
        self._corner_pressable = _positions(bare.pressable, nodes)[corners].T  # -1 elsewhere
        self._area = np.abs(twice) / 2
        self._gradient = np.ascontiguousarray(gradient.transpose(2, 0, 1))  # (t, 2, 3)
        self._stiffness = self._area[:, None, None] * np.einsum(
            "tdi,tdj->tij", self._gradient, self._gradient
        )
        uneven = np.ones(nodes) if bare.conductivity is None else bare.conductivity
        self.at_rest = uneven[bare.pressable]
        # Conductivity of a triangle is the mean of its corners'.
        self._bare_conductivity = uneven[corners].mean(axis=0)

    def _index_nodes(self) -> None:
        """Triangles around each pressable node; neighbours of each support node."""
        triangles, nodes = len(self._area), len(self.bare.support)
        triangle, corner = np.nonzero(self._corner_pressable >= 0)
        node = self._corner_pressable[triangle, corner]
        self._triangles_of = _lists(node, triangle, len(self.bare.pressable), fill=triangles)
        self._triangle_count = np.bincount(self._corner_support.ravel(), minlength=nodes)
        ones = np.ones_like(self._stiffness)  # neighbours may have a stiffness of 0 between them
        row, column = _assembled(ones, self._corner_support, nodes).nonzero()
        self._neighbours = _lists(row, column, nodes, fill=nodes)
        law = _assembled(
            self._bare_conductivity[:, None, None] * self._stiffness, self._corner_support, nodes
        )
        # Nodes where the bare sheet's currents balance among these triangles. Elsewhere an
        # electrode, or a triangle that cannot be pressed, is part of the balance.
        left = np.abs(law @ self.bare.potentials).max(axis=1)
        self._last_areas: _PressedAreas | None = None
        self._last_touched: tuple[IntArray, tuple[IntArray, IntArray, IntArray]] | None = None
        self._closed = left < 1e-9 * (abs(law) @ np.abs(self.bare.potentials)).max(axis=1)

    def solve(
        self, change: FloatArray, *, mix_resistivities: bool = False, within: IntArray | None = None
    ) -> Solution:
        """Solve for a pressed sheet.

        Args:
            change: (P,) conductivity minus the bare sheet's at the pressable nodes.
            mix_resistivities: a triangle's resistivity, not its conductivity, is the mean of its
                corners'. Across the edge of what conducts far better than the sheet, current
                meets the two in series: there this keeps an edge where its nodes put it, whatever
                the contrast (to 0.3 mm of 3 mm triangles; otherwise it is off by up to 0.9 mm).
                Triangles with a corner that conducts worse than the sheet mix conductivities.
            within: pressable nodes outside of which nothing changes; those that change if None.
                Solves that share them share what is found out about them.

        Raises:
            numpy.linalg.LinAlgError: a conductivity is not above 0.
        """
        where = np.flatnonzero(change) if within is None else within
        if len(where) == 0:
            nowhere = np.zeros(0, np.intp)
            none = self.bare.potentials[nowhere]
            return Solution(self.bare_voltages, nowhere, none, nowhere, none)
        mixed = change if mix_resistivities else None
        if self._compiled is not None:
            found = self._compiled.areas(where)
            voltages, potentials, injected = self._compiled.solve(found, change, mix_resistivities)
            return Solution(voltages, found.nodes, potentials, found.rim, injected, mixed)
        triangles = self._around(where)
        areas = self._areas(triangles)
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
        transfer = self.bare.transfer.copy()
        transfer[:-1, :-1] += areas.potentials.T @ injected
        return Solution(
            voltages=scan_voltages(self.description, transfer),
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

    def _areas(self, triangles: IntArray) -> _PressedAreas:
        """What was found out for the last solve, where the same triangles change again."""
        last = self._last_areas
        if last is None or not np.array_equal(last.triangles, triangles):
            self._last_areas = last = self._explored(triangles)
        return last

    def _explored(self, triangles: IntArray) -> _PressedAreas:
        count = len(self.bare.support)
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
        potentials = self.bare.potentials[near]
        both = np.concatenate([self.bare.green.between(near, near[on_rim]), potentials], axis=1)
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

    def potentials(self, solution: Solution, nodes: IntArray) -> FloatArray:
        """Potentials (n, L - 1) of a pressed sheet at n positions in `BareSheet.support`."""
        position = _positions(solution.nodes, len(self.bare.support))[nodes]
        outside = position < 0
        potentials = np.empty((len(nodes), self.bare.potentials.shape[1]))
        potentials[~outside] = solution.potentials[position[~outside]]
        others = nodes[outside]
        moved = self.bare.green.between(others, solution.rim) @ solution.injected
        potentials[outside] = self.bare.potentials[others] + moved
        return potentials

    def jacobian(
        self,
        solution: Solution,  # where to differentiate
        where: IntArray,  # (n,) pressable nodes
        # (n, K) derivative of these nodes' conductivities by K parameters: sooner done here than
        # with the (M, n) derivative by nodes
        onto: FloatArray | None = None,
    ) -> FloatArray:
        """Derivative of the voltages with respect to conductivity.

        Returns:
            (M, K), or (M, n) by the nodes' relative conductivity (the paper's equation 2).
        """
        if self._compiled is not None and onto is not None:
            areas = self._compiled.areas(where)
            inside = solution.nodes is areas.nodes
            found = solution.potentials if inside else self.potentials(solution, areas.nodes)
            return self._compiled.jacobian(areas, found, solution.mixed, onto)
        triangles, nodes, corners = self._touched(where)
        fields = self.potentials(solution, nodes) @ self._pair_matrix.T  # (nodes, pairs)
        gradient = self._gradient[triangles] @ fields[corners]  # (t, 2, pairs)
        node, share = self._shares(where, triangles, solution.mixed)
        if onto is None:
            pressable = node < len(where)
            places = node[pressable], pressable.nonzero()[0]
            by_triangle = sp.csr_matrix((share[pressable], places), (len(where), len(triangles)))
            summed = (by_triangle @ self._field_products(gradient).T).T
        else:
            onto = np.append(onto, np.zeros((1, onto.shape[1])), axis=0)
            weight = (share[:, :, None] * onto[node]).sum(axis=1)  # (t, K)
            summed = np.zeros((self._products.shape[1], onto.shape[1]))
            for start in range(0, len(triangles), _STRIP):
                strip = slice(start, start + _STRIP)
                summed += self._field_products(gradient[strip]) @ weight[strip]
        return np.asarray(summed[self._product_of] * self._sign[:, None])

    def _touched(self, where: IntArray) -> tuple[IntArray, IntArray, IntArray]:
        """Indexed triangles around pressable nodes, the different ones of their corners, and which.

        Sheets that are differentiated at the very same nodes share what was found.
        """
        if self._last_touched is None or self._last_touched[0] is not where:
            triangles = self._around(where)
            corners = _renumbered(self._corner_support[triangles], len(self.bare.support))
            self._last_touched = where, (triangles, *corners)
        return self._last_touched[1]

    def _shares(
        self, where: IntArray, triangles: IntArray, mixed: FloatArray | None
    ) -> tuple[IntArray, FloatArray]:
        """Where triangles' corners stand among nodes, and minus the area that goes with each.

        Returns:
            (t, 3) places in `where`, its length for other nodes; (t, 3) areas by which the
            conductivities of triangles go with those of their corners.
        """
        position = np.full(len(self.bare.pressable) + 1, len(where))  # the last: not pressable
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

    def _field_products(self, gradient: FloatArray) -> FloatArray:
        """Products (q, t) of the fields (t, 2, pairs) of two pairs each."""
        x, y = np.ascontiguousarray(gradient.transpose(1, 2, 0))
        one, other = self._products
        product = x[one]
        product *= x[other]
        across = y[one]
        across *= y[other]
        product += across
        return np.asarray(product)

    @property
    def node_areas_m2(self) -> FloatArray:
        """(P,) share of the sheet's area that belongs to each pressable node."""
        return np.asarray(np.append(self._area, 0.0)[self._triangles_of].sum(axis=1) / 3)

    def probes(self, x_m: FloatArray, y_m: FloatArray, radius_m: float) -> Probes:
        """Prepare to look at the field around C points, each weighted by a cone of that radius."""
        corners = self.bare.points[:, self.bare.support[self._corner_support]]  # (2, t, 3)
        middle_x, middle_y = corners.mean(axis=2)
        strips = []
        for start in range(0, len(x_m), _STRIP):
            strip = slice(start, start + _STRIP), None
            distance = np.hypot(x_m[strip] - middle_x, y_m[strip] - middle_y)
            strips.append(sp.csr_matrix(np.clip(1 - distance / radius_m, 0, None) * self._area))
        weight = sp.vstack(strips)
        weight = sp.diags(1 / weight.sum(axis=1).A1) @ weight
        triangles, nodes = len(self._area), len(self.bare.support)
        rows = np.repeat(np.arange(triangles), 3)
        by_axis = [
            sp.csr_matrix(
                (self._gradient[:, axis].ravel(), (rows, self._corner_support.ravel())),
                (triangles, nodes),
            )
            for axis in (0, 1)
        ]
        mean = sp.vstack([weight @ gradient for gradient in by_axis]).tocsr()
        return Probes(mean @ self.bare.potentials, mean)

    def spot_sensitivity(self, probes: Probes, solution: Solution) -> FloatArray:
        """Derivative (M, C) of the voltages by the conductivity of one square metre at each spot.

        Unlike `jacobian` it looks anywhere, at the price of resolution: it is for finding where a
        contact is missing in a solution, not for fitting it.
        """
        moved = self.bare.green.rows(solution.rim).T @ solution.injected  # G is symmetric
        field = self._pair_matrix @ (probes.bare + probes.gradient @ moved).T
        x, y = np.split(field, 2, axis=1)  # (pairs, C) each
        one, other = self._products
        product = x[one] * x[other] + y[one] * y[other]
        return np.asarray(product[self._product_of] * -self._sign[:, None])

    def bare_jacobian(self) -> FloatArray:
        """Jacobian of the unpressed sheet, (M, P)."""
        unpressed = self.solve(np.zeros(len(self.bare.pressable)))
        return self.jacobian(unpressed, np.arange(len(self.bare.pressable)))


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


def _assembled(stiffness: FloatArray, corners: IntArray, nodes: int) -> sp.csr_matrix:
    """Sum the (t, 3, 3) of triangles into one matrix on all nodes."""
    rows, columns = np.repeat(corners, 3, axis=1), np.tile(corners, (1, 3))
    return sp.csr_matrix((stiffness.ravel(), (rows.ravel(), columns.ravel())), (nodes, nodes))


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


def _lists(owner: IntArray, member: IntArray, owners: int, fill: int) -> IntArray:
    """Members of each owner as (owners, most), filled up with `fill`."""
    order = np.argsort(owner, kind="stable")
    count = np.bincount(owner, minlength=owners)
    slot = np.arange(len(owner)) - np.repeat(count.cumsum() - count, count)
    lists = np.full((owners, count.max(initial=0)), fill)
    lists[owner[order], slot] = member[order]
    return lists

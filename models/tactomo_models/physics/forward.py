"""The forward model: voltages of a pressed sheet by the complete electrode model.

The problem is solved once for the bare sheet, keeping the Green's function between the nodes that
can be pressed. To all that lies outside, a pressed area is what it does on its rim. Inside it no
current enters or leaves, so its inner nodes are eliminated: layer by layer from the middle
outwards, since a layer couples with its two neighbours alone. With S and S0 the areas' stiffness on
their rims, pressed and bare, G and u0 the bare sheet's Green's function and potentials there, the
rims inject currents i into the bare sheet (Woodbury identity):

    (1 + (S - S0) G) i = -(S - S0) u0        u = u0 + G i

The cost goes by the pressed area, not by the size of the sheet.

Everything is relative to a sheet of unit conductance: conductivities are ratios to the bare
sheet's, transfer resistances are in units of the bare sheet's resistance per square.

Source: Somersalo, Cheney & Isaacson, "Existence and uniqueness for electrode models for electric
current computed tomography", SIAM J. Appl. Math. 52 (1992); Jacobian: the paper, equation 2;
elimination by layers: George, "Nested dissection of a regular finite element mesh", SIAM J. Numer.
Anal. 10 (1973).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import shapely

from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.physics.bare_sheet import BareSheet, scan_voltages, volts_per_unit
from tactomo_models.physics.compiled_sheet import (
    CompiledAreas,
    CompiledData,
    CompiledSheet,
    Pressed,
    Solution,
)
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.sensor.sheet import Ring

_STRIP = 256  # spots at once: what that takes stays in the cache


@dataclass(frozen=True)
class Probes:
    """Where the field is looked at: C spots, each an average over its neighbourhood."""

    bare: FloatArray  # (2 C, L - 1) field of the bare sheet there, x components first
    gradient: sp.csr_matrix  # (2 C, S) of potentials at the support nodes, averaged


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
        self._compiled = self._compile()

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
            "at_rest": self.at_rest,
            "potentials": self.bare.potentials,
            "transfer": self.bare.transfer,
            "bare_voltages": self.bare_voltages,
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
        self._closed = left < 1e-9 * (abs(law) @ np.abs(self.bare.potentials)).max(axis=1)

    def solve(self, change: FloatArray, *, mix_resistivities: bool = False) -> Solution:
        """Solve for a pressed sheet.

        Args:
            change: (P,) conductivity minus the bare sheet's at the pressable nodes.
            mix_resistivities: a triangle's resistivity, not its conductivity, is the mean of its
                corners'. Across the edge of what conducts far better than the sheet, current
                meets the two in series: there this keeps an edge where its nodes put it, whatever
                the contrast (to 0.3 mm of 3 mm triangles; otherwise it is off by up to 0.9 mm).
                Triangles with a corner that conducts worse than the sheet mix conductivities.

        Raises numpy.linalg.LinAlgError where a conductivity is not above 0.
        """
        areas = self._compiled.areas(np.flatnonzero(change))
        return self._compiled.solve(areas, None, None, change, mix_resistivities=mix_resistivities)[
            0
        ]

    def evaluate(self, pressed: Pressed, data: CompiledData) -> tuple[Solution, FloatArray]:
        """Solve for what is pressed and compare its relative voltage changes with data.

        Args:
            pressed: what presses, and what that does to the sheet.
            data: what was measured.

        Returns:
            The solution, and the weighted residual (M,) of the data.

        Raises numpy.linalg.LinAlgError where a conductivity is not above 0.
        """
        return self._compiled.solve(self._compiled.areas(pressed.where), pressed, data)

    def slopes(
        self,
        solution: Solution,  # that of `evaluate`
        pressed: Pressed,  # what presses on p nodes
        data: CompiledData,  # what was measured
        by_share: FloatArray,  # (p, N) derivatives of the shares by N parameters
        by_pressure: FloatArray,  # (p, N) those of the pressures
    ) -> FloatArray:
        """Derivative of the weighted residual of what is pressed.

        Returns:
            (M, N + 1), by the parameters and the log ratio.
        """
        areas, potentials = self._around(solution, pressed.where)
        return self._compiled.slopes(
            areas, solution, potentials, pressed, data, by_share, by_pressure
        )

    def _around(self, solution: Solution, where: IntArray) -> tuple[CompiledAreas, FloatArray]:
        """Areas around pressable nodes, and a solution's potentials (n, L - 1) there."""
        areas = solution.areas
        if areas.where is where or np.array_equal(areas.where, where):
            return areas, solution.potentials
        areas = self._compiled.areas(where)
        return areas, self.potentials(solution, areas.nodes)

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
        areas, potentials = self._around(solution, where)
        return self._compiled.jacobian(areas, solution, potentials, onto)

    @property
    def node_areas_m2(self) -> FloatArray:
        """(P,) share of the sheet's area that belongs to each pressable node."""
        return np.asarray(np.append(self._area, 0.0)[self._triangles_of].sum(axis=1) / 3)

    def newtons_per_kpa(self, region_m: Ring | None = None) -> FloatArray:
        """Newtons (P,) on a region, or on the whole sheet, of 1 kPa at each pressable node."""
        of_each = 1e3 * self.node_areas_m2
        if region_m is None:
            return of_each
        x, y = self.bare.points[:, self.bare.pressable]
        return np.asarray(of_each * shapely.intersects_xy(shapely.Polygon(region_m), x, y))

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


def _assembled(stiffness: FloatArray, corners: IntArray, nodes: int) -> sp.csr_matrix:
    """Sum the (t, 3, 3) of triangles into one matrix on all nodes."""
    rows, columns = np.repeat(corners, 3, axis=1), np.tile(corners, (1, 3))
    return sp.csr_matrix((stiffness.ravel(), (rows.ravel(), columns.ravel())), (nodes, nodes))


def _positions(members: IntArray, count: int) -> IntArray:
    """Where each number below `count` stands among `members`; -1 for those that do not."""
    position = np.full(count, -1)
    position[members] = np.arange(len(members))
    return position


def _lists(owner: IntArray, member: IntArray, owners: int, fill: int) -> IntArray:
    """Members of each owner as (owners, most), filled up with `fill`."""
    order = np.argsort(owner, kind="stable")
    count = np.bincount(owner, minlength=owners)
    slot = np.arange(len(owner)) - np.repeat(count.cumsum() - count, count)
    lists = np.full((owners, count.max(initial=0)), fill)
    lists[owner[order], slot] = member[order]
    return lists

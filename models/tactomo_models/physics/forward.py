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
from scipy.spatial import Delaunay

from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.physics.bare_sheet import BareSheet, scan_voltages, volts_per_unit
from tactomo_models.physics.compiled_sheet import CompiledSheet, Solution, positions
from tactomo_models.physics.mesh import assembled, hat_gradients, stiffnesses
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.sensor.sheet import Ring


@dataclass(frozen=True)
class Probes:
    """Where the field is looked at: C spots, each an average over its neighbourhood."""

    nodes: IntArray  # (C,) of the support nodes
    bare: FloatArray  # (2 C, L - 1) field of the bare sheet there, x components first
    gradient: sp.csr_matrix  # (2 C, C) of potentials at these nodes, averaged


class ForwardModel(CompiledSheet):
    """Voltages and their derivatives for relative conductivities on the pressable nodes.

    Args:
        description: the sensor.
        bare: its sheet, solved.

    Attributes:
        bare_voltages: (M,) of the unpressed sheet, in scan order; see `volts_per_unit`.
        at_rest: (P,) conductivity of the unpressed sheet at the pressable nodes.
        triangle_areas_m2: (t,) area of each triangle that pressing changes.
    """

    def __init__(self, description: SensorDescription, bare: BareSheet) -> None:
        self.description = description
        self.volts_per_unit = volts_per_unit(description)
        self.bare_voltages = scan_voltages(description, bare.transfer)
        self.bare = bare
        self._index_pairs()
        self._index_triangles()
        self._index_nodes()
        pairs = description.pairs
        arrays = {
            "corner_support": self._corner_support,
            "corner_pressable": self._corner_pressable,
            "triangles_of": self._triangles_of,
            "neighbours": self._neighbours,
            "triangle_count": self._triangle_count,
            "closed": self._closed,
            "gradient": self._gradient,
            "stiffness": self._stiffness,
            "area": self.triangle_areas_m2,
            "conductivity": self._bare_conductivity,
            "at_rest": self.at_rest,
            "potentials": bare.potentials,
            "transfer": bare.transfer,
            "bare_voltages": self.bare_voltages,
            "electrodes": np.concatenate([pairs.drive, pairs.measure], axis=1),
            "pair": self._different_pairs,
            "product": self._products.T,
            "product_of": self._product_of,
            "sign": self._sign,
        }
        super().__init__(bare, arrays)

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
        voltages = np.arange(len(self._sign))
        of_each = -self._sign, (self._product_of, voltages)
        # (Q, M) adds up what goes with each of Q products, see `spot_sensitivity`
        self.by_product = sp.csr_matrix(of_each, (self._products.shape[1], len(voltages)))

    def _index_triangles(self) -> None:
        """Corners, gradients and stiffness of the triangles that touch a pressable node."""
        bare = self.bare
        nodes = bare.points.shape[1]
        touched = np.flatnonzero(np.isin(bare.triangles, bare.pressable).any(axis=0))
        corners = bare.triangles[:, touched]  # (3, t)
        stretch = None if bare.stretch is None else bare.stretch[touched]
        gradient, self.triangle_areas_m2 = hat_gradients(bare.points[:, corners], stretch)
        self._corner_support = positions(bare.support, nodes)[corners].T  # (t, 3)
        self._corner_pressable = positions(bare.pressable, nodes)[corners].T  # -1 elsewhere
        self._gradient = np.ascontiguousarray(gradient.transpose(2, 0, 1))  # (t, 2, 3)
        self._stiffness = stiffnesses(gradient, self.triangle_areas_m2)
        uneven = np.ones(nodes) if bare.conductivity is None else bare.conductivity
        self.at_rest = uneven[bare.pressable]
        # Conductivity of a triangle is the mean of its corners'.
        self._bare_conductivity = uneven[corners].mean(axis=0)

    def _index_nodes(self) -> None:
        """Triangles around each pressable node; neighbours of each support node."""
        triangles, nodes = len(self.triangle_areas_m2), len(self.bare.support)
        triangle, corner = np.nonzero(self._corner_pressable >= 0)
        node = self._corner_pressable[triangle, corner]
        self._triangles_of = _lists(node, triangle, len(self.bare.pressable), fill=triangles)
        self._triangle_count = np.bincount(self._corner_support.ravel(), minlength=nodes)
        ones = np.ones_like(self._stiffness)  # neighbours may have a stiffness of 0 between them
        row, column = assembled(ones, self._corner_support, nodes).nonzero()
        self._neighbours = _lists(row, column, nodes, fill=nodes)
        law = assembled(
            self._bare_conductivity[:, None, None] * self._stiffness, self._corner_support, nodes
        )
        # Nodes where the bare sheet's currents balance among these triangles. Elsewhere an
        # electrode, or a triangle that cannot be pressed, is part of the balance.
        left = np.abs(law @ self.bare.potentials).max(axis=1)
        self._closed = left < 1e-9 * (abs(law) @ np.abs(self.bare.potentials)).max(axis=1)

    @property
    def pressable_triangles(self) -> tuple[IntArray, FloatArray]:
        """Nodes (n, 3) of the triangles whose corners can all be pressed; stiffness (n, 3, 3)."""
        whole = (self._corner_pressable >= 0).all(axis=1)
        return self._corner_pressable[whole], self._stiffness[whole]

    @property
    def node_areas_m2(self) -> FloatArray:
        """(P,) share of the sheet's area that belongs to each pressable node."""
        return np.asarray(
            np.append(self.triangle_areas_m2, 0.0)[self._triangles_of].sum(axis=1) / 3
        )

    def newtons_per_kpa(self, region_m: Ring | None = None) -> FloatArray:
        """Newtons (P,) on a region, or on the whole sheet, of 1 kPa at each pressable node."""
        of_each = 1e3 * self.node_areas_m2
        if region_m is None:
            return of_each
        x, y = self.bare.points[:, self.bare.pressable]
        return np.asarray(of_each * shapely.intersects_xy(shapely.Polygon(region_m), x, y))

    def probes(self, spots: IntArray) -> Probes:
        """Prepare to look at the field at C of the pressable nodes, by differences between them."""
        description, places = self.description, self.bare.points[:, self.bare.pressable[spots]]
        corners = Delaunay(places.T).simplices  # (T, 3)
        middle = places[:, corners].mean(axis=2)
        corners = corners[description.on_sheet(*middle)]  # none across a notch or a hole
        stretch = None
        if description.stretching is not None:
            stretch = description.stretching.stretch_of(middle.T[:, None])
        gradient, area = hat_gradients(places[:, corners.T], stretch)
        triangle, spot, count = np.arange(len(corners)), corners.ravel(), len(spots)
        of_each = np.repeat(area, 3), (spot, np.repeat(triangle, 3))
        share = sp.csr_matrix(of_each, (count, len(corners)))
        share = sp.diags(1 / np.maximum(share.sum(axis=1).A1, 1e-30)) @ share
        slopes = (
            sp.csr_matrix((each.T.ravel(), (np.repeat(triangle, 3), spot)), (len(corners), count))
            for each in gradient
        )
        mean = sp.vstack([share @ slope for slope in slopes]).tocsr()
        nodes = positions(self.bare.support, self.bare.points.shape[1])[self.bare.pressable[spots]]
        return Probes(nodes, mean @ self.bare.potentials[nodes], mean)

    def spot_sensitivity(self, probes: Probes, solution: Solution) -> FloatArray:
        """Derivative of voltages by the conductivity of one square metre at each of C spots.

        Of voltages (Q, C) whose drive and measurement may change places: all of them have
        `by_product.T` times these. Unlike `jacobian` it looks anywhere, at the price of resolution:
        it is for finding where a contact is missing in a solution, not for fitting it.
        """
        moved = self.bare.green.between(probes.nodes, solution.rim) @ solution.injected
        field = self._pair_matrix @ (probes.bare + probes.gradient @ moved).T
        x, y = np.split(field, 2, axis=1)  # (pairs, C) each
        one, other = self._products
        return np.asarray(x[one] * x[other] + y[one] * y[other])

    def bare_jacobian(self) -> FloatArray:
        """Jacobian of the unpressed sheet, (M, P)."""
        unpressed = self.solve(np.zeros(len(self.bare.pressable)))
        return self.jacobian(unpressed, np.arange(len(self.bare.pressable)))


def _lists(owner: IntArray, member: IntArray, owners: int, fill: int) -> IntArray:
    """Members of each owner as (owners, most), filled up with `fill`."""
    order = np.argsort(owner, kind="stable")
    count = np.bincount(owner, minlength=owners)
    slot = np.arange(len(owner)) - np.repeat(count.cumsum() - count, count)
    lists = np.full((owners, count.max(initial=0)), fill)
    lists[owner[order], slot] = member[order]
    return lists

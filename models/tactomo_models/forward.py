"""The forward model: voltages of a pressed sheet by the complete electrode model.

The problem is solved once for the bare sheet, keeping the Green's function between the nodes that
can be pressed. A contact then changes the conductivity in a few triangles only, and its voltages
follow from a dense system on the nodes of those triangles (Woodbury identity): the cost goes by
the pressed area, not by the size of the sheet.

Everything is relative to a sheet of unit conductance: conductivities are ratios to the bare
sheet's, transfer resistances are in units of the bare sheet's resistance per square.

Source: Somersalo, Cheney & Isaacson, "Existence and uniqueness for electrode models for electric
current computed tomography", SIAM J. Appl. Math. 52 (1992); Jacobian: the paper, equation 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg as spla
import skfem
from numpy.typing import NDArray
from skfem.helpers import dot, grad
from threadpoolctl import threadpool_limits

from tactomo_models.description import SensorDescription
from tactomo_models.mesh import SheetMesh, mesh_sheet

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
_BLOCK = 256  # right-hand sides solved at once: bounds the memory of a build


@dataclass(frozen=True)
class BareSheet:
    """What is computed once for a mesh: everything a pressed sheet's voltages follow from.

    Attributes:
        points: (2, N) mesh nodes, metres.
        triangles: (3, T) nodes of each triangle.
        pressable: (P,) mesh nodes whose conductivity may change.
        support: (S,) nodes of all triangles that touch a pressable node.
        green: (S, S) potential at a support node for a unit current into another.
        potentials: (S, L - 1) potential at the support nodes for a unit current into electrode
            l and out of the last one.
        transfer: (L, L) electrode potentials for the same currents; the last row and column are 0.
        map_weights: (nodes_y * nodes_x, P) interpolation of pressable nodes onto the map.
    """

    points: FloatArray
    triangles: IntArray
    pressable: IntArray
    support: IntArray
    green: FloatArray
    potentials: FloatArray
    transfer: FloatArray
    map_weights: sp.csr_matrix


def solve_bare_sheet(
    description: SensorDescription,
    sheet: SheetMesh,
    conductivity: FloatArray | None = None,
    impedance: FloatArray | None = None,
) -> BareSheet:
    """Assemble and solve the complete electrode model of an unpressed sheet.

    Args:
        description: the sensor.
        sheet: its mesh of N nodes.
        conductivity: (N,) of an uneven sheet, relative to the description's; 1 if None.
        impedance: (L,) contact impedances, relative to the description's; 1 if None.
    """
    mesh = sheet.mesh
    # The integral of a linear conductivity over a triangle is that of its corners' mean.
    nodal = np.ones(mesh.p.shape[1]) if conductivity is None else conductivity
    factor, fields = _factorise(description, sheet, nodal[mesh.t].mean(axis=0), impedance)
    inside = description.on_sheet(mesh.p[0], mesh.p[1], description.sheet.frame_width_m)
    pressable = np.flatnonzero(inside)
    touched = np.isin(mesh.t, pressable).any(axis=0)
    support = np.unique(mesh.t[:, touched])
    with threadpool_limits(1):
        green = _green(factor, support, len(fields))
    return BareSheet(
        points=mesh.p,
        triangles=mesh.t.astype(np.intp),
        pressable=pressable,
        support=support,
        green=green,
        potentials=fields[support],
        transfer=_transfer(description, fields),
        map_weights=_map_weights(description, mesh)[:, pressable].tocsr(),
    )


def transfer_resistances(
    description: SensorDescription,
    sheet: SheetMesh,
    conductivity: FloatArray,
    impedance: FloatArray | None = None,
) -> FloatArray:
    """Solve a sheet of any conductivity directly: a fraction of a second, no Green's function.

    Args:
        description: the sensor.
        sheet: its mesh of T triangles.
        conductivity: (T,) of each triangle, relative to the bare sheet's.
        impedance: (L,) contact impedances, relative to the description's; 1 if None.

    Returns:
        (L, L) electrode potentials for a unit current into each electrode and out of the last;
        see `scan_voltages`.
    """
    return _transfer(description, _factorise(description, sheet, conductivity, impedance)[1])


def scan_voltages(description: SensorDescription, transfer: FloatArray) -> FloatArray:
    """Voltages (M,) in scan order that transfer resistances (L, L) lead to, relative.

    Multiply by `volts_per_unit` for volts.
    """
    drive, measure = description.pairs.drive.T, description.pairs.measure.T
    into = transfer[measure[0], drive[0]] - transfer[measure[1], drive[0]]
    out_of = transfer[measure[0], drive[1]] - transfer[measure[1], drive[1]]
    return np.asarray(into - out_of)


def volts_per_unit(description: SensorDescription) -> float:
    """Volts of a relative voltage of 1: the drive current over the bare sheet's conductance."""
    return description.pattern.current_a / description.sheet_conductance_s


def _factorise(
    description: SensorDescription,
    sheet: SheetMesh,
    conductivity: FloatArray,
    impedance: FloatArray | None,
) -> tuple[spla.SuperLU, FloatArray]:
    """Factor of the system, and its solutions (unknowns, L - 1) for a current into each electrode.

    The last electrode is what the currents leave by: its potential is 0 and no unknown.
    """
    system = _assemble(description, sheet, conductivity, impedance)
    unknown = description.electrode_count - 1
    injected = np.zeros((system.shape[0], unknown))
    injected[-unknown:] = np.eye(unknown)
    with threadpool_limits(1):  # SuperLU's panels are too small to share: more threads only spin
        factor = spla.splu(system, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        return factor, factor.solve(injected)


def _transfer(description: SensorDescription, fields: FloatArray) -> FloatArray:
    electrodes = description.electrode_count
    transfer = np.zeros((electrodes, electrodes))
    transfer[:-1, :-1] = fields[1 - electrodes :]
    return transfer


@skfem.BilinearForm  # type: ignore[untyped-decorator]
def _conduction(u: Any, v: Any, w: Any) -> Any:
    return w["conductivity"] * dot(grad(u), grad(v))


def _assemble(
    description: SensorDescription,
    sheet: SheetMesh,
    conductivity: FloatArray,
    impedance: FloatArray | None,
) -> sp.csc_matrix:
    """Symmetric positive definite system of node potentials and all but the last electrode's."""
    mesh = sheet.mesh
    nodes, electrodes = mesh.p.shape[1], description.electrode_count
    basis = skfem.Basis(mesh, skfem.ElementTriP1())
    stiffness = _conduction.assemble(basis, conductivity=conductivity[:, None])
    # Contact impedance, made relative to the sheet: an extra length of conductor, in metres.
    contact_m = np.full(
        electrodes,
        description.electrodes.contact_impedance_ohm_m * description.sheet_conductance_s,
    )
    if impedance is not None:
        contact_m *= impedance
    rows, columns, values = [], [], []  # of the electrodes' terms
    lengths = np.zeros(electrodes)
    for index, facets in enumerate(sheet.electrode_facets):
        ends = mesh.facets[:, facets]
        length = np.linalg.norm(mesh.p[:, ends[0]] - mesh.p[:, ends[1]], axis=0)
        lengths[index] = length.sum()
        for i, j in ((0, 0), (1, 1), (0, 1), (1, 0)):
            rows.append(ends[i])
            columns.append(ends[j])
            values.append(length * (1 / 3 if i == j else 1 / 6) / contact_m[index])
        for end in ends:
            potential = np.full_like(end, nodes + index)
            rows += [end, potential]
            columns += [potential, end]
            values += [-length / 2 / contact_m[index]] * 2
    potentials = nodes + np.arange(electrodes)
    rows.append(potentials)
    columns.append(potentials)
    values.append(lengths / contact_m)
    size = nodes + electrodes
    terms = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    stiffness.resize(size, size)
    return (stiffness + sp.csr_matrix(terms, (size, size)))[:-1, :-1].tocsc()


def _green(factor: spla.SuperLU, support: IntArray, size: int) -> FloatArray:
    green = np.empty((len(support), len(support)))
    for start in range(0, len(support), _BLOCK):
        block = support[start : start + _BLOCK]
        unit = np.zeros((size, len(block)))
        unit[block, np.arange(len(block))] = 1.0
        green[:, start : start + len(block)] = factor.solve(unit)[support]
    return (green + green.T) / 2


def _map_weights(description: SensorDescription, mesh: skfem.MeshTri) -> sp.csr_matrix:
    """Linear interpolation from mesh nodes to map nodes; rows off the sheet are empty."""
    x, y = np.meshgrid(description.map_x_m, description.map_y_m)
    # A hair inside, so that points on the rim are not lost to rounding or to the disc's facets.
    points = np.stack([x.ravel(), y.ravel()]) * (1 - 1e-9)
    on = np.flatnonzero(_inside_mesh(mesh, points))
    weights = skfem.Basis(mesh, skfem.ElementTriP1()).probes(points[:, on]).tocsr()
    weights.data[weights.data < 1e-7] = 0  # a trace of other corners; rounding puts some below 0
    weights.eliminate_zeros()
    rows = sp.csr_matrix((np.ones(len(on)), (on, np.arange(len(on)))), (x.size, len(on)))
    return (rows @ weights).tocsr()


def _inside_mesh(mesh: skfem.MeshTri, points: FloatArray) -> NDArray[np.bool_]:
    rim = mesh.p[:, mesh.boundary_nodes()]
    hull = scipy.spatial.Delaunay(rim.T)
    return np.asarray(hull.find_simplex(points.T) >= 0)


@dataclass(frozen=True)
class Solution:
    """Voltages of one pressed sheet, with what their derivatives need.

    Attributes:
        voltages: (M,) in scan order, relative (multiply by `ForwardModel.volts_per_unit`).
        nodes: (n,) positions in `BareSheet.support` where potentials are known.
        potentials: (n, L - 1) potentials there.
    """

    voltages: FloatArray
    nodes: IntArray
    potentials: FloatArray


class ForwardModel:
    """Voltages and their derivatives for relative conductivities on the pressable nodes."""

    def __init__(self, description: SensorDescription, bare: BareSheet) -> None:
        self.description = description
        self.bare = bare
        electrodes = description.electrode_count
        # Pairs recur in many voltages; fields are formed once for each of them.
        self._pairs, index = np.unique(
            np.sort(np.concatenate([description.pairs.drive, description.pairs.measure]), axis=1),
            axis=0,
            return_inverse=True,
        )
        self._pair_matrix = _pair_matrix(self._pairs, electrodes)[:, :-1]
        both = np.concatenate([description.pairs.drive, description.pairs.measure])
        sign = np.where(both[:, 0] < both[:, 1], 1.0, -1.0)
        count = description.measurements
        self._of_drive, self._of_measure = index[:count], index[count:]
        self._pair_sign = sign[:count] * sign[count:]
        self.volts_per_unit = volts_per_unit(description)
        self.bare_voltages = scan_voltages(description, bare.transfer)
        self._index_triangles()

    def _index_triangles(self) -> None:
        """Positions, gradients and areas of the triangles that touch a pressable node."""
        bare = self.bare
        nodes = bare.points.shape[1]
        in_support = np.full(nodes, -1)
        in_support[bare.support] = np.arange(len(bare.support))
        in_pressable = np.full(nodes, -1)
        in_pressable[bare.pressable] = np.arange(len(bare.pressable))
        touched = np.flatnonzero((in_pressable[bare.triangles] >= 0).any(axis=0))
        corners = bare.triangles[:, touched]  # (3, t)
        p = bare.points[:, corners]  # (2, 3, t)
        edge = np.roll(p, -2, axis=1) - np.roll(p, -1, axis=1)  # opposite each corner
        twice = edge[0, 1] * edge[1, 2] - edge[1, 1] * edge[0, 2]
        gradient = np.stack([-edge[1], edge[0]]) / twice  # (2, 3, t) of each corner's hat function
        self._corner_support = in_support[corners].T  # (t, 3)
        self._corner_pressable = in_pressable[corners].T
        self._area = np.abs(twice) / 2
        self._gradient = np.ascontiguousarray(gradient.transpose(2, 0, 1))  # (t, 2, 3)
        self._stiffness = self._area[:, None, None] * np.einsum(
            "tdi,tdj->tij", self._gradient, self._gradient
        )
        triangles = len(touched)
        rows = self._corner_pressable.ravel()
        columns = np.repeat(np.arange(triangles), 3)
        on = rows >= 0
        # Conductivity of a triangle is the mean of its corners'.
        self._mean = sp.csr_matrix(
            (np.full(on.sum(), 1 / 3), (columns[on], rows[on])), (triangles, len(bare.pressable))
        )
        self._mean_transposed = self._mean.T.tocsr()

    def solve(self, change: FloatArray, also: NDArray[np.bool_] | None = None) -> Solution:
        """Solve for a pressed sheet.

        Args:
            change: (P,) conductivity minus 1 at the pressable nodes.
            also: (P,) nodes where derivatives will be asked for although nothing changed there.
        """
        triangles, nodes, local = self._changed(change, also)
        u0 = self.bare.potentials[nodes]
        if len(nodes) == 0:
            return Solution(self.bare_voltages, nodes, u0)
        delta = (self._mean[triangles] @ change)[:, None, None] * self._stiffness[triangles]
        n = len(nodes)
        rows = np.repeat(local, 3, axis=1).ravel()
        columns = np.tile(local, (1, 3)).ravel()
        update = sp.csr_matrix((delta.ravel(), (rows, columns)), (n, n))
        system = update.T @ self.bare.green[np.ix_(nodes, nodes)]  # (G D)' = D' G
        system[np.diag_indices(n)] += 1.0
        potentials = np.linalg.solve(system.T, u0)
        transfer = self.bare.transfer.copy()
        transfer[:-1, :-1] -= u0.T @ (update @ potentials)
        return Solution(scan_voltages(self.description, transfer), nodes, potentials)

    def _changed(
        self, change: FloatArray, also: NDArray[np.bool_] | None
    ) -> tuple[IntArray, IntArray, IntArray]:
        """Triangles that change, the support nodes they need, and their corners among those."""
        moved = change != 0
        if also is not None:
            moved = moved | also
        triangles = np.flatnonzero(self._mean @ moved.astype(float))
        nodes, local = np.unique(self._corner_support[triangles], return_inverse=True)
        return triangles, nodes, local.reshape(-1, 3)

    def jacobian(self, solution: Solution, where: IntArray) -> FloatArray:
        """Derivative of the voltages with respect to the conductivity of pressable nodes.

        Args:
            solution: where to differentiate.
            where: (n,) pressable nodes; the solution must know the potentials around them.

        Returns:
            (M, n), relative volts per relative conductivity (the paper's equation 2).
        """
        by_node = self._mean_transposed[where]  # (n, t)
        triangles = np.flatnonzero(by_node.getnnz(axis=0))
        position = np.full(len(self.bare.support), -1)
        position[solution.nodes] = np.arange(len(solution.nodes))
        corners = position[self._corner_support[triangles]]
        fields = solution.potentials @ self._pair_matrix.T  # (n, pairs)
        gradient = self._gradient[triangles] @ fields[corners]  # (t, 2, pairs)
        product = gradient.transpose(0, 2, 1) @ gradient  # (t, pairs, pairs)
        product *= -self._area[triangles, None, None]
        pairs = len(self._pairs)
        summed = by_node[:, triangles] @ product.reshape(len(triangles), pairs * pairs)
        chosen = summed.reshape(len(where), pairs, pairs)[:, self._of_measure, self._of_drive]
        return np.asarray(chosen * self._pair_sign).T

    def bare_jacobian(self) -> FloatArray:
        """Jacobian of the unpressed sheet, (M, P)."""
        nodes = np.arange(len(self.bare.support))
        solution = Solution(self.bare_voltages, nodes, self.bare.potentials)
        return self.jacobian(solution, np.arange(len(self.bare.pressable)))


def _pair_matrix(pairs: IntArray, electrodes: int) -> FloatArray:
    """(n, electrodes): +1 at the first electrode of each pair, -1 at the second."""
    matrix = np.zeros((len(pairs), electrodes))
    rows = np.arange(len(pairs))
    matrix[rows, pairs[:, 0]] = 1.0
    matrix[rows, pairs[:, 1]] = -1.0
    return matrix


def build_forward_model(
    description: SensorDescription, spacing_m: float | None = None, refinements: int = 3
) -> ForwardModel:
    """Mesh, assemble and solve the bare sheet: seconds; see `artifact` to keep the result."""
    sheet = mesh_sheet(description, spacing_m, refinements)
    return ForwardModel(description, solve_bare_sheet(description, sheet))

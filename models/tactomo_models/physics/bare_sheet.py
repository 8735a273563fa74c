"""The bare sheet, solved by finite elements under the complete electrode model.

From that follow its Green's function between the nodes that can be pressed, the transfer
resistances between its electrodes, and the voltages of a scan.

Source: Somersalo, Cheney & Isaacson, "Existence and uniqueness for electrode models for electric
current computed tomography", SIAM J. Appl. Math. 52 (1992).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
import skfem
from numpy.typing import DTypeLike
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.physics.greens import GreensFunction, PackedGreensFunction
from tactomo_models.physics.mesh import SheetMesh, assembled, hat_gradients, stiffnesses
from tactomo_models.sensor.description import SensorDescription

NEAREST = 24  # triangles by their middles, among which a place's own is: refined ones are smaller
MAX_SHORT = 0.05  # of the map's spacing: see `_map_weights`


@dataclass(frozen=True)
class BareSheet:
    """What is computed once for a mesh: everything a pressed sheet's voltages follow from."""

    points: FloatArray  # (2, N) mesh nodes, metres
    triangles: IntArray  # (3, T) nodes of each triangle
    pressable: IntArray  # (P,) mesh nodes whose conductivity may change
    support: IntArray  # (S,) nodes of all triangles that touch a pressable node
    # (S, S) potential at a support node for a unit current into another; as a `GreensFunction`
    # where few presses are solved and a quick start is worth more
    green: PackedGreensFunction | GreensFunction
    # (S, L - 1) potential at the support nodes for a unit current into electrode l and out of the
    # last one
    potentials: FloatArray
    # (L, L) electrode potentials for the same currents; the last row and column are 0
    transfer: FloatArray
    # (nodes_y * nodes_x, P) interpolation of pressable nodes onto the map
    map_weights: sp.csr_matrix
    # (N,) of an uneven sheet, relative to the description's; 1 if None
    conductivity: FloatArray | None = None
    stretch: FloatArray | None = None  # (T, 2, 2) see `SheetMesh`


def solve_bare_sheet(
    description: SensorDescription,  # the sensor
    sheet: SheetMesh,  # its mesh of N nodes
    # (N,) of an uneven sheet, relative to the description's; 1 if None
    conductivity: FloatArray | None = None,
    # (L,) contact impedances, relative to the description's; 1 if None
    impedance: FloatArray | None = None,
    *,
    # leave the Green's function in pieces: a tenth of the time and memory, but a newly pressed area
    # then costs a millisecond more
    quick: bool = False,
    # a sheet of the same mesh, before its electrodes were moved: what can be pressed, and where
    # that is on the map, is as on that one. Found anew if None
    drawn_on: BareSheet | None = None,
    green_dtype: DTypeLike = np.float64,  # what a Green's function that is whole is kept in
) -> BareSheet:
    """Assemble and solve the complete electrode model of an unpressed sheet."""
    mesh = sheet.mesh
    # The integral of a linear conductivity over a triangle is that of its corners' mean.
    nodal = np.ones(mesh.p.shape[1]) if conductivity is None else conductivity
    system = assemble_sheet(description, sheet, nodal[mesh.t].mean(axis=0), impedance)
    if drawn_on is None:
        inside = description.on_sheet(mesh.p[0], mesh.p[1], description.sheet.frame_width_m)
        pressable = np.flatnonzero(inside)
        map_weights = _map_weights(description, mesh)[:, pressable].tocsr()
    else:
        pressable, map_weights = drawn_on.pressable, drawn_on.map_weights
    touched = np.isin(mesh.t, pressable).any(axis=0)
    support = np.unique(mesh.t[:, touched])
    fields = electrode_fields(description, system)
    with threadpool_limits(1):
        green = GreensFunction(system, support, mesh.p[:, support])
        kept = green if quick else green.packed(green_dtype)
    return BareSheet(
        points=mesh.p,
        triangles=mesh.t.astype(np.intp),
        pressable=pressable,
        support=support,
        green=kept,
        potentials=fields[support],
        transfer=transfer_of(description, fields),
        map_weights=map_weights,
        conductivity=conductivity,
        stretch=sheet.stretch,
    )


def transfer_resistances(
    description: SensorDescription,  # the sensor
    sheet: SheetMesh,  # its mesh of T triangles
    conductivity: FloatArray,  # (T,) of each triangle, relative to the bare sheet's
    # (L,) contact impedances, relative to the description's; 1 if None
    impedance: FloatArray | None = None,
) -> FloatArray:
    """Solve a sheet of any conductivity directly: a fraction of a second, no Green's function.

    Returns:
        (L, L) electrode potentials for a unit current into each electrode and out of the last;
        see `scan_voltages`.
    """
    system = assemble_sheet(description, sheet, conductivity, impedance)
    return transfer_of(description, electrode_fields(description, system))


def scan_voltages(description: SensorDescription, transfer: FloatArray) -> FloatArray:
    """Voltages (M,) in scan order that transfer resistances (L, L) lead to, relative.

    Multiply by `volts_per_unit` for volts.
    """
    drive, measure = description.pairs.drive.T, description.pairs.measure.T
    into = transfer[measure[0], drive[0]] - transfer[measure[1], drive[0]]
    out_of = transfer[measure[0], drive[1]] - transfer[measure[1], drive[1]]
    return np.asarray(into - out_of)


def exchanged(transfer: FloatArray, order: Sequence[int]) -> FloatArray:
    """Transfer resistances (L, L) where the device's lead i is on electrode order[i].

    Potentials are against the last lead's electrode, by which the currents leave.
    """
    moved = transfer[np.ix_(order, order)]
    return np.asarray(moved - moved[-1:] - moved[:, -1:] + moved[-1, -1])


def volts_per_unit(description: SensorDescription) -> float:
    """Volts of a relative voltage of 1: the drive current over the bare sheet's conductance."""
    return description.pattern.current_a / description.sheet_conductance_s


def electrode_fields(description: SensorDescription, system: sp.csc_matrix) -> FloatArray:
    """Solutions (unknowns, L - 1) of a sheet's system for a current into each electrode.

    The last electrode is what the currents leave by: its potential is 0 and no unknown.
    """
    unknown = description.electrode_count - 1
    injected = np.zeros((system.shape[0], unknown))
    injected[-unknown:] = np.eye(unknown)
    with threadpool_limits(1):  # SuperLU's panels are too small to share: more threads only spin
        factor = spla.splu(system, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        return np.asarray(factor.solve(injected))


def transfer_of(description: SensorDescription, fields: FloatArray) -> FloatArray:
    """Transfer resistances (L, L) that a sheet's fields (unknowns, L - 1) end in."""
    electrodes = description.electrode_count
    transfer = np.zeros((electrodes, electrodes))
    transfer[:-1, :-1] = fields[1 - electrodes :]
    return transfer


def assemble_sheet(
    description: SensorDescription,  # the sensor
    sheet: SheetMesh,  # its mesh of N nodes and T triangles
    conductivity: FloatArray,  # (T,) of each triangle, relative to the description's
    # (L,) contact impedances, relative to the description's; 1 if None
    impedance: FloatArray | None = None,
) -> sp.csc_matrix:
    """Assemble the complete electrode model.

    On a surface that stretches the sheet this is the surface's: with the metric g of a triangle, a
    conductivity of sqrt(det g) / g there, and edges and areas as long and as large as they are.

    Returns:
        (N + L - 1, N + L - 1), symmetric positive definite, of the potentials of the nodes and of
        all electrodes but the last.
    """
    mesh, terms = sheet.mesh, electrode_terms(description, sheet, impedance)
    gradient, area = hat_gradients(mesh.p[:, mesh.t], sheet.stretch)
    stiffness = stiffnesses(gradient, conductivity * area)
    return terms + assembled(stiffness, mesh.t.T, terms.shape[0]).tocsc()


def electrode_terms(
    description: SensorDescription, sheet: SheetMesh, impedance: FloatArray | None = None
) -> sp.csc_matrix:
    """What electrodes add to the sheet alone; arguments and shape as of `assemble_sheet`."""
    mesh = sheet.mesh
    nodes, electrodes = mesh.p.shape[1], description.electrode_count
    # Contact impedance, made relative to the sheet: an extra length of conductor, in metres.
    contact_m = np.full(
        electrodes, description.electrodes.contact_impedance_ohm_m * description.sheet_conductance_s
    )
    if impedance is not None:
        contact_m *= impedance
    rows, columns, values = [], [], []  # of the electrodes' terms
    lengths = np.zeros(electrodes)
    for index, edges in enumerate(sheet.electrode_edges):
        *ends, triangles = edges.T
        edge = mesh.p[:, ends[0]] - mesh.p[:, ends[1]]
        if sheet.stretch is not None:
            edge = np.einsum("fij,jf->if", sheet.stretch[triangles], edge)
        length = np.linalg.norm(edge, axis=0)
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
    for index, pad, triangles, shares in sheet.pads:
        # It meets the sheet all over; in all as a rim electrode as long as its circumference.
        radius_m = pad.radius_m
        stretch = None if sheet.stretch is None else sheet.stretch[triangles]
        _, area = hat_gradients(mesh.p[:, mesh.t[:, triangles]], stretch)
        weight = shares * area[:, None, None] * 2 / radius_m / contact_m[index]
        corners = mesh.t[:, triangles].T  # (n, 3)
        rows.append(np.repeat(corners, 3, axis=1).ravel())
        columns.append(np.tile(corners, 3).ravel())
        values.append(weight.ravel())
        potential = np.full(corners.size, nodes + index)
        rows += [corners.ravel(), potential]
        columns += [potential, corners.ravel()]
        values += [-weight.sum(axis=2).ravel()] * 2
        # Of the mesh as it is, moved or stretched: else current would leave the sheet elsewhere.
        lengths[index] = weight.sum() * contact_m[index]
    potentials = nodes + np.arange(electrodes)
    rows.append(potentials)
    columns.append(potentials)
    values.append(lengths / contact_m)
    size = nodes + electrodes
    terms = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sp.csc_matrix(terms, (size, size))[:-1, :-1]


def _map_weights(description: SensorDescription, mesh: skfem.MeshTri) -> sp.csr_matrix:
    """Linear interpolation from mesh nodes to map nodes; rows off the sheet are empty."""
    x, y = np.meshgrid(description.map_x_m, description.map_y_m)
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    # On the chord of an arc, or where the rim is drawn simpler than the outline, the nearest
    # triangle ends short of a point on the sheet; that one's nearest place stands for the point.
    short_m = MAX_SHORT * description.spacing_m
    corners = mesh.p[:, mesh.t]  # (2, 3, T)
    _, near = cKDTree(corners.mean(axis=1).T).query(points, NEAREST)
    a, b, c = (corners[:, k, near] for k in range(3))  # (2, points, NEAREST)
    off = points.T[:, :, None] - a
    (ux, uy), (vx, vy) = b - a, c - a
    twice = ux * vy - uy * vx
    second, third = (off[0] * vy - off[1] * vx) / twice, (ux * off[1] - uy * off[0]) / twice
    hats = np.stack([1 - second - third, second, third])  # (3, points, NEAREST)
    best = hats.min(axis=0).argmax(axis=1)
    rows = np.arange(len(points))
    hats = np.clip(hats[:, rows, best], 0, None)
    hats[hats < 1e-7] = 0  # a trace of other corners
    hats /= hats.sum(axis=0)
    nodes = mesh.t[:, near[rows, best]]  # (3, points)
    at = (mesh.p[:, nodes] * hats).sum(axis=1)
    on = np.flatnonzero(np.linalg.norm(at - points.T, axis=0) < short_m)
    weights = (hats[:, on].T.ravel(), (np.repeat(on, 3), nodes[:, on].T.ravel()))
    found = sp.csr_matrix(weights, (len(points), mesh.p.shape[1]))
    found.eliminate_zeros()
    return found

"""Triangle meshes of a sheet: regular inside, along its rim, refined where electrodes end.

The field is singular at an electrode's ends and at corners that point into the sheet, so triangles
there are halved a few times, as are those at the rim of a pad. Boundary nodes are moved onto the
ends of electrodes on the rim: the complete electrode model converges at its full order only where
an electrode is a whole number of edges.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import shapely
import skfem
from scipy.spatial import Delaunay
from scipy.spatial.distance import pdist

from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.errors import DescriptionError
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.sensor.outline import Pad, RimElectrode

MIN_DEPTH = 0.35
"""Of a regular node of a polygon inside the rim, over the nodes' distance. Rim edges are twice as
long, so that no node lies in the circle about one and triangles follow the rim."""
STRAIGHT = 0.02
"""Distance from the outline, over the nodes', by which a corner of the rim may be left out."""
ROUNDS = 12  # of halving rim edges that are not in the mesh: where the sheet is narrow
SINGULAR_DEG = 240.0
"""Angle of the sheet at a corner, above which triangles there are halved, too: the field is as
r^(180/angle - 1). At the 270 degrees of an L that takes its voltages' errors from 0.41 to 0.25 %
rms, and the largest of one from 3.0 to 1.9 %."""
STRETCH_PIECES = 2  # along a triangle's side, at whose middles a surface's metric is looked up
PAD_ROUNDS = 8  # of halving triangles at the rims of pads, at most
PAD_HALVINGS = 4  # of triangles, to find the share of each under a pad


@dataclass(frozen=True)
class SheetMesh:
    """A meshed sheet."""

    mesh: skfem.MeshTri  # scikit-fem triangles, coordinates in metres
    # per electrode, the (n, 3) edges of the rim that it covers: both ends, and whose edge it is of
    # all triangles
    electrode_edges: tuple[IntArray, ...]
    # per pad, its electrode's number; (n,) triangles that it touches, and (n, 3, 3) integrals of
    # the products of their hat functions over what it covers, of the triangle's area
    pads: tuple[tuple[int, Pad, IntArray, FloatArray], ...] = ()
    # (T, 2, 2) how a surface stretches each triangle, see `Triangles.stretch_of`; None where none
    # does
    stretch: FloatArray | None = None


def mesh_sheet(
    description: SensorDescription,  # the sensor
    # distance of the regular nodes; the map's own spacing if None, so that every map node of a
    # rectangle or polygon is a mesh node, but for those next to the rim
    spacing_m: float | None = None,
    # how often triangles at electrodes' ends and inward corners are halved; more often where
    # electrodes or the gaps between them are narrower than the nodes' distance
    refinements: int = 3,
) -> SheetMesh:
    """Mesh a sheet.

    Raises DescriptionError where no triangles follow a polygon's rim.
    """
    shape = description.sheet.shape
    generate = {"rectangle": _rectangle, "disc": _disc, "polygon": _polygon}[shape]
    mesh = generate(description, spacing_m)
    ends, halvings = _rim_ends(description), refinements
    if shape == "rectangle":  # the other rims begin with a node at every end
        halvings = max(halvings, _needed_refinements(mesh, ends, description))
    singular = np.concatenate([ends, description.sheet.outline.inward_corners(SINGULAR_DEG)])
    for _ in range(halvings):
        mesh = mesh.refined(_triangles_near(mesh, singular))
        if shape == "disc":
            mesh = _on_circle(mesh, description.width_m / 2)
    if shape == "rectangle":
        mesh = _snap(mesh, ends)
    for _ in range(PAD_ROUNDS):
        coarse = _triangles_at_pads(mesh, description, 0.5 ** (refinements - 1))
        if not len(coarse):
            break
        mesh = mesh.refined(coarse)
    return with_electrodes(mesh, description)


def _rim_ends(description: SensorDescription) -> FloatArray:
    """Both ends (2 n, 2) of each electrode on the rim: of pads, which lie inside, none."""
    is_on_rim = [isinstance(each, RimElectrode) for each in description.placed_electrodes]
    return description.electrode_ends_m[is_on_rim].reshape(-1, 2)


def _grid(description: SensorDescription, spacing_m: float | None) -> tuple[FloatArray, FloatArray]:
    if spacing_m is None:
        return description.map_x_m, description.map_y_m
    x, y = (
        np.linspace(-side / 2, side / 2, round(side / spacing_m) + 1)
        for side in (description.width_m, description.height_m)
    )
    return x, y


def _rectangle(description: SensorDescription, spacing_m: float | None) -> skfem.MeshTri:
    x, y = _grid(description, spacing_m)
    nx, ny = len(x), len(y)
    points = np.stack([np.tile(x, ny), np.repeat(y, nx)])
    row, column = np.divmod(np.arange((nx - 1) * (ny - 1)), nx - 1)
    triangles = _halves(np.arange(nx * ny).reshape(ny, nx), row, column)
    return skfem.MeshTri(points, np.ascontiguousarray(triangles.T))


def _halves(nodes: IntArray, row: IntArray, column: IntArray) -> IntArray:
    """Triangles (2 n, 3) of squares of regular nodes, of which each has a row and a column.

    Their diagonals alternate, so that the mesh prefers no direction: with diagonals by chance,
    single presses without noise on an insole were told with elongations off by 0.03 and places by
    0.1 mm.
    """
    a, b = nodes[row, column], nodes[row, column + 1]
    c, d = nodes[row + 1, column + 1], nodes[row + 1, column]
    even = ((row + column) % 2 == 0)[:, None]
    first = np.where(even, np.stack([a, b, c], axis=1), np.stack([a, b, d], axis=1))
    second = np.where(even, np.stack([a, c, d], axis=1), np.stack([b, c, d], axis=1))
    return np.concatenate([first, second])


def _disc(description: SensorDescription, spacing_m: float | None) -> skfem.MeshTri:
    radius = description.width_m / 2
    rings = round(radius / (spacing_m or description.spacing_m))
    # The rim's nodes come in equal steps between electrode ends; the rings inside need not know.
    ends = np.sort(np.arctan2(*_rim_ends(description).T[::-1]))
    ends = ends if len(ends) else np.zeros(1)
    gaps = np.diff(np.append(ends, ends[0] + 2 * np.pi))
    pieces = np.maximum(1, np.round(gaps * rings)).astype(int)
    rim = np.concatenate(
        [e + g * np.arange(p) / p for e, g, p in zip(ends, gaps, pieces, strict=True)]
    )
    radii, angles = [np.zeros(1)], [np.zeros(1)]
    for ring in range(1, rings):
        count = max(6, round(2 * np.pi * ring))
        radii.append(np.full(count, radius * ring / rings))
        angles.append(2 * np.pi * (np.arange(count) + 0.5 * (ring % 2)) / count)
    radii.append(np.full(len(rim), radius))
    angles.append(rim)
    r, a = np.concatenate(radii), np.concatenate(angles)
    points = np.stack([r * np.cos(a), r * np.sin(a)], axis=1)
    triangles = Delaunay(points).simplices.T
    return skfem.MeshTri(np.ascontiguousarray(points.T), np.ascontiguousarray(triangles))


def _polygon(description: SensorDescription, spacing_m: float | None) -> skfem.MeshTri:
    """Regular nodes inside, nodes along the rim, and the triangles between them."""
    outline = description.sheet.outline
    x, y = _grid(description, spacing_m)
    step_m = max(x[1] - x[0], y[1] - y[0])
    shape = len(y), len(x)
    x, y = (each.ravel() for each in np.meshgrid(x, y))
    deep = outline.depth(x, y) > MIN_DEPTH * step_m
    inner = np.stack([x[deep], y[deep]], axis=1)
    rings = [
        _rim_nodes(description, ring, 2 * MIN_DEPTH * step_m)
        for ring in range(len(outline.lengths_m))
    ]
    # Of nodes in a square rounding would choose the triangles, and not all of them would fit.
    shaken = inner + 1e-7 * step_m * np.random.default_rng(0).uniform(-1, 1, inner.shape)
    for _ in range(ROUNDS):
        rim = np.concatenate(rings)
        triangles = Delaunay(np.concatenate([rim, shaken])).simplices
        edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        size = len(rim) + len(inner)
        there = np.unique(edges @ [size, 1])
        first, missing = 0, 0
        for number, ring in enumerate(rings):
            places = first + np.arange(len(ring))
            wanted = np.sort(np.stack([places, np.roll(places, -1)], axis=1), axis=1)
            lost = np.flatnonzero(~np.isin(wanted @ [size, 1], there))
            middle = (ring[lost] + np.roll(ring, -1, axis=0)[lost]) / 2
            rings[number] = np.insert(ring, lost + 1, middle, axis=0)
            first, missing = first + len(ring), missing + len(lost)
        if not missing:
            break
    else:
        raise DescriptionError(
            f"{description.name}: {missing} edges of outline_m or holes_m are too near each other "
            "to be meshed: leave out details smaller than an electrode"
        )
    points = np.concatenate([rim, inner])
    triangles = _regular(triangles, len(rim), deep.reshape(shape))
    corners = points[triangles]
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]) / 2
    # Of nodes in a line rounding makes triangles without an area.
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    meshed = shapely.Polygon(rings[0], rings[1:])
    shapely.prepare(meshed)
    inside = shapely.contains_xy(meshed, *corners.mean(axis=1).T) & (area > 1e-7 * longest**2)
    triangles = triangles[inside]
    used, renumbered = np.unique(triangles, return_inverse=True)
    return skfem.MeshTri(
        np.ascontiguousarray(points[used].T),
        np.ascontiguousarray(renumbered.reshape(triangles.shape).T),
    )


def _regular(triangles: IntArray, rim: int, deep: BoolArray) -> IntArray:
    """The same triangles (n, 3), but for squares of regular nodes: these are halved in turn.

    Args:
        triangles: of nodes along the rim, so many, and of regular ones after them, row by row.
        rim: number of nodes along the rim.
        deep: (rows, columns) which regular nodes are meshed.
    """
    nodes = np.full(deep.shape, -1)
    nodes[deep] = rim + np.arange(np.count_nonzero(deep))
    is_whole = deep[:-1, :-1] & deep[:-1, 1:] & deep[1:, :-1] & deep[1:, 1:]
    places = np.concatenate([np.full((rim, 2), -9), np.argwhere(deep)])
    corners = places[triangles]  # (n, 3, 2) rows and columns
    low, high = corners.min(axis=1), corners.max(axis=1)
    is_half = (low >= 0).all(axis=1) & (high - low == 1).all(axis=1)
    is_half[is_half] = is_whole[tuple(low[is_half].T)]
    squares = np.unique(low[is_half], axis=0)
    return np.concatenate([triangles[~is_half], _halves(nodes, *squares.T)])


def _rim_nodes(description: SensorDescription, ring: int, step_m: float) -> FloatArray:
    """Nodes (n, 2) along a ring: at its corners and electrodes' ends, and between them."""
    outline = description.sheet.outline
    length_m = outline.lengths_m[ring]
    whole = [outline.polygon.exterior, *outline.polygon.interiors][ring]
    corners = shapely.get_coordinates(whole.simplify(STRAIGHT * step_m / (2 * MIN_DEPTH)))[:-1]
    along = shapely.line_locate_point(whole, shapely.points(corners))
    ends = (
        np.array(
            [
                each.ends_m()
                for each in description.placed_electrodes
                if isinstance(each, RimElectrode) and each.ring == ring
            ]
        ).ravel()
        % length_m
    )
    # A corner next to an electrode's end is left to the end: a longer way round is no shorter.
    apart = np.abs(along[:, None] - ends) % length_m
    if len(ends):
        corners_kept = np.minimum(apart, length_m - apart).min(axis=1) > 1e-6
        along, corners = along[corners_kept], corners[corners_kept]
    fixed, order = np.unique(np.append(along, ends), return_index=True)
    places = np.concatenate([corners, outline.at(ring, ends).reshape(-1, 2)])[order]
    nodes = []
    gaps = np.diff(np.append(fixed, fixed[0] + length_m))
    for place, after, gap in zip(places, np.roll(places, -1, axis=0), gaps, strict=True):
        pieces = max(1, int(np.ceil(gap / step_m - 1e-9)))
        nodes.append(place + (after - place) * np.arange(pieces)[:, None] / pieces)
    return np.concatenate(nodes)


def _triangles_near(mesh: skfem.MeshTri, points: FloatArray) -> IntArray:
    """Triangles within one and a half of their own size of any of the points (n, 2)."""
    corners = mesh.p[:, mesh.t]  # (2, 3, triangles)
    size = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=0).max(axis=0)
    distance = np.linalg.norm(corners.mean(axis=1)[:, :, None] - points.T[:, None, :], axis=0)
    return np.flatnonzero((distance < 1.5 * size[:, None]).any(axis=1))


def _triangles_at_pads(
    mesh: skfem.MeshTri, description: SensorDescription, largest: float
) -> IntArray:
    """Triangles at the rim of a pad that are longer than such a share of the pad's radius."""
    corners = mesh.p[:, mesh.t]  # (2, 3, triangles)
    size = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=0).max(axis=0)
    found = np.zeros(len(size), bool)
    for electrode in description.placed_electrodes:
        if isinstance(electrode, Pad):
            centre = np.array(electrode.centre_m)[:, None]
            off = np.abs(np.linalg.norm(corners.mean(axis=1) - centre, axis=0) - electrode.radius_m)
            found |= (off < size / 2) & (size > largest * electrode.radius_m)
    return np.flatnonzero(found)


def _on_circle(mesh: skfem.MeshTri, radius_m: float) -> skfem.MeshTri:
    points = mesh.p.copy()
    rim = mesh.boundary_nodes()
    points[:, rim] *= radius_m / np.linalg.norm(points[:, rim], axis=0)
    return skfem.MeshTri(points, mesh.t)


def _needed_refinements(
    mesh: skfem.MeshTri, ends: FloatArray, description: SensorDescription
) -> int:
    """Halvings after which rim edges at electrode ends are half as long as the narrowest gap.

    The nearest rim node of each end then lies on its own side and belongs to no other end.
    """
    half = np.array([description.width_m, description.height_m]) / 2
    gaps = pdist(np.vstack([ends, half * [[-1, -1], [1, -1], [1, 1], [-1, 1]]]))
    narrowest = gaps[gaps > 1e-9 * description.width_m].min()  # an end may lie on a corner
    edge = mesh.p[:, mesh.facets[:, mesh.boundary_facets()]]
    longest = np.linalg.norm(edge[:, 0] - edge[:, 1], axis=0).max()
    return int(np.ceil(np.log2(2 * longest / narrowest) - 1e-9))


def _snap(mesh: skfem.MeshTri, ends: FloatArray) -> skfem.MeshTri:
    """Move the nearest boundary node onto each end (n, 2) of an electrode on the rim."""
    points = mesh.p.copy()
    rim = mesh.boundary_nodes()
    for end in ends:
        nearest = rim[np.argmin(np.linalg.norm(points[:, rim] - end[:, None], axis=0))]
        points[:, nearest] = end
    return skfem.MeshTri(points, mesh.t)


def hat_gradients(
    corners: FloatArray,  # (2, 3, T) of triangles
    stretch: FloatArray | None = None,  # (T, 2, 2) of a surface that they lie on
) -> tuple[FloatArray, FloatArray]:
    """Gradients (2, 3, T) of the hat functions of triangles' corners, and areas (T,)."""
    edge = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)  # opposite each corner
    twice = edge[0, 1] * edge[1, 2] - edge[1, 1] * edge[0, 2]
    gradient, area = np.stack([-edge[1], edge[0]]) / twice, np.abs(twice) / 2
    if stretch is None:
        return gradient, area
    on_surface = np.einsum("tij,jct->ict", np.linalg.inv(stretch), gradient)
    return on_surface, area * np.linalg.det(stretch)


def stiffnesses(
    gradient: FloatArray,  # (2, 3, T) of the hat functions, see `hat_gradients`
    weight: FloatArray,  # (T,) area of each triangle times its conductivity
) -> FloatArray:
    """Stiffness matrices (T, 3, 3) of triangles."""
    return np.asarray(weight[:, None, None] * np.einsum("dit,djt->tij", gradient, gradient))


def assembled(stiffness: FloatArray, corners: IntArray, nodes: int) -> sp.csr_matrix:
    """Sum the (t, 3, 3) of triangles into one matrix on all nodes."""
    rows, columns = np.repeat(corners, 3, axis=1), np.tile(corners, (1, 3))
    return sp.csr_matrix((stiffness.ravel(), (rows.ravel(), columns.ravel())), (nodes, nodes))


def with_electrodes(mesh: skfem.MeshTri, description: SensorDescription) -> SheetMesh:
    """Find what each electrode covers, on a mesh with nodes at the electrodes' ends."""
    outline = description.sheet.outline
    facets = mesh.boundary_facets()
    edges = np.vstack([mesh.facets[:, facets], mesh.f2t[0, facets]]).T
    middle = mesh.p[:, edges[:, :2]].mean(axis=2)  # (2, edges)
    rings, along = outline.locate(middle.T)
    found, pads = [], []
    for number, electrode in enumerate(description.placed_electrodes):
        if isinstance(electrode, Pad):
            found.append(edges[:0])
            pads.append((number, electrode, *_under(mesh, electrode)))
            continue
        length_m = outline.lengths_m[electrode.ring]
        off = np.abs((along - electrode.middle_m + length_m / 2) % length_m - length_m / 2)
        # A hair less than half: an edge may begin where the electrode ends.
        on = (rings == electrode.ring) & (off < (1 - 1e-9) * electrode.length_m / 2)
        found.append(edges[on])
    stretch = None
    if description.stretching is not None:
        hats = np.stack(part_middles(STRETCH_PIECES))
        places = np.einsum("dct,cq->tqd", mesh.p[:, mesh.t], hats)
        stretch = description.stretching.stretch_of(places)
    return SheetMesh(mesh, tuple(found), tuple(pads), stretch)


def part_middles(pieces: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Hat functions at the middles of a triangle's equal parts, so many along each side."""
    i, j = np.divmod(np.arange(pieces * pieces), pieces)
    i, j = i[i + j < pieces], j[i + j < pieces]
    down = i + j < pieces - 1  # small triangles the other way up lie between those
    first = np.concatenate([i + 1 / 3, i[down] + 2 / 3]) / pieces
    second = np.concatenate([j + 1 / 3, j[down] + 2 / 3]) / pieces
    return 1 - first - second, first, second


def _under(mesh: skfem.MeshTri, pad: Pad) -> tuple[IntArray, FloatArray]:
    """Triangles that a pad touches, and what it covers of them; see `SheetMesh.pads`."""
    hats = np.stack(part_middles(2**PAD_HALVINGS))  # (3, q)
    corners = mesh.p[:, mesh.t]  # (2, 3, T)
    centre = np.array(pad.centre_m)
    size = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=0).max(axis=0)
    off = np.linalg.norm(corners.mean(axis=1) - centre[:, None], axis=0)
    near = np.flatnonzero(off < pad.radius_m + size)
    places = np.einsum("dct,cq->tdq", corners[:, :, near], hats)
    under = np.linalg.norm(places - centre[:, None], axis=1) < pad.radius_m  # (n, q)
    near, under = near[under.any(axis=1)], under[under.any(axis=1)]
    shares = np.einsum("tq,aq,bq->tab", under.astype(float), hats, hats) / hats.shape[1]
    _, area = hat_gradients(corners[:, :, near])
    covered = (under.mean(axis=1) * area).sum()
    return near, shares * np.pi * pad.radius_m**2 / covered

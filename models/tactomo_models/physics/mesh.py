"""Triangle meshes of a sheet: regular inside, refined where electrodes end.

The field is singular at an electrode's ends, so triangles there are halved a few times. Boundary
nodes are moved onto those ends: the complete electrode model converges at its full order only
where an electrode is a whole number of edges.
"""

from dataclasses import dataclass

import numpy as np
import skfem
from scipy.spatial import Delaunay
from scipy.spatial.distance import pdist

from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.sensor.description import SensorDescription


@dataclass(frozen=True)
class SheetMesh:
    """A meshed sheet."""

    mesh: skfem.MeshTri  # scikit-fem triangles, coordinates in metres
    electrode_facets: tuple[IntArray, ...]  # per electrode, the boundary facets it covers


def mesh_sheet(
    description: SensorDescription,  # the sensor
    # distance of the regular nodes; the map's own spacing if None, so that every map node of a
    # rectangle is a mesh node
    spacing_m: float | None = None,
    # how often triangles at the electrodes' ends are halved; more often where electrodes or the
    # gaps between them are narrower than the nodes' distance
    refinements: int = 3,
) -> SheetMesh:
    """Mesh a sheet."""
    disc = description.sheet.shape == "disc"
    mesh = _disc(description, spacing_m) if disc else _rectangle(description, spacing_m)
    ends = description.electrode_ends_m.reshape(-1, 2)
    if not disc:  # the rim of a disc begins with a node at every end
        refinements = max(refinements, _needed_refinements(mesh, ends, description))
    for _ in range(refinements):
        mesh = mesh.refined(_triangles_near(mesh, ends))
        if disc:
            mesh = _on_circle(mesh, description.width_m / 2)
    mesh = _snap(mesh, ends)
    return SheetMesh(mesh, electrode_facets(mesh, description))


def _rectangle(description: SensorDescription, spacing_m: float | None) -> skfem.MeshTri:
    if spacing_m is None:
        x, y = description.map_x_m, description.map_y_m
    else:
        x, y = (
            np.linspace(-side / 2, side / 2, round(side / spacing_m) + 1)
            for side in (description.width_m, description.height_m)
        )
    nx, ny = len(x), len(y)
    points = np.stack([np.tile(x, ny), np.repeat(y, nx)])
    corner = (np.arange(ny - 1)[:, None] * nx + np.arange(nx - 1)).ravel()
    a, b, c, d = corner, corner + 1, corner + nx + 1, corner + nx
    # Diagonals alternate, so that the mesh prefers no direction.
    even = (corner // nx + corner % nx) % 2 == 0
    first = np.where(even, np.stack([a, b, c]), np.stack([a, b, d]))
    second = np.where(even, np.stack([a, c, d]), np.stack([b, c, d]))
    return skfem.MeshTri(points, np.hstack([first, second]))


def _disc(description: SensorDescription, spacing_m: float | None) -> skfem.MeshTri:
    radius = description.width_m / 2
    rings = round(radius / (spacing_m or description.width_m / (description.map.nodes_x - 1)))
    # The rim's nodes come in equal steps between electrode ends; the rings inside need not know.
    ends = np.sort(np.arctan2(*description.electrode_ends_m.reshape(-1, 2).T[::-1]))
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


def _triangles_near(mesh: skfem.MeshTri, points: FloatArray) -> IntArray:
    """Triangles within one and a half of their own size of any of the points (n, 2)."""
    corners = mesh.p[:, mesh.t]  # (2, 3, triangles)
    size = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=0).max(axis=0)
    distance = np.linalg.norm(corners.mean(axis=1)[:, :, None] - points.T[:, None, :], axis=0)
    return np.flatnonzero((distance < 1.5 * size[:, None]).any(axis=1))


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
    """Move the nearest boundary node onto each electrode end."""
    points = mesh.p.copy()
    rim = mesh.boundary_nodes()
    for end in ends:
        nearest = rim[np.argmin(np.linalg.norm(points[:, rim] - end[:, None], axis=0))]
        points[:, nearest] = end
    return skfem.MeshTri(points, mesh.t)


def electrode_facets(mesh: skfem.MeshTri, description: SensorDescription) -> tuple[IntArray, ...]:
    """Boundary facets that each electrode covers, on a mesh with nodes at the electrodes' ends."""
    facets = mesh.boundary_facets()
    middle = mesh.p[:, mesh.facets[:, facets]].mean(axis=1)  # (2, facets)
    found = []
    for start, end in description.electrode_ends_m:
        centre = (start + end) / 2
        along = end - start
        length = np.linalg.norm(along)
        offset = middle - centre[:, None]
        # A hair less than half: a facet round the corner may begin where the electrode ends.
        on = (np.abs(along @ offset) / length < (1 - 1e-9) * length / 2) & (
            np.linalg.norm(offset, axis=0) < length
        )
        found.append(facets[on])
    return tuple(found)

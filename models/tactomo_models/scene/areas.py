"""Separate pressed areas: found in an image of what is pressed, with their places and sizes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from tactomo_models.arrays import FloatArray, Image
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene.shape_fit import Shape


@dataclass(frozen=True)
class Areas:
    """Separate pressed areas.

    Attributes:
        on_map: (K, nodes_y, nodes_x) share of each map node that each area covers.
        on_nodes: (K, P) the same at the pressable nodes.
        centres_m: (K, 2) centroids.
        areas_m2: (K,).
        sigmas: (K, 3) standard uncertainties of x, y and area; NaN where unknown.
    """

    on_map: FloatArray
    on_nodes: FloatArray
    centres_m: FloatArray
    areas_m2: FloatArray
    sigmas: FloatArray

    def __len__(self) -> int:
        return len(self.areas_m2)


class AreaFinder:
    """Splits an image of what is pressed into separate areas."""

    def __init__(self, forward: ForwardModel) -> None:
        description = forward.description
        self._nodes = forward.bare.points[:, forward.bare.pressable]
        self._map_weights = forward.bare.map_weights
        self._node_m2 = forward.node_areas_m2
        self._x, self._y = np.meshgrid(description.map_x_m, description.map_y_m)
        self._cell_m2 = (description.map_x_m[1] - description.map_x_m[0]) * (
            description.map_y_m[1] - description.map_y_m[0]
        )
        x, y = self._nodes
        column = np.abs(x[:, None] - description.map_x_m).argmin(axis=1)
        row = np.abs(y[:, None] - description.map_y_m).argmin(axis=1)
        self._nearest = (row, column)  # map node next to each pressable node

    @property
    def map_places(self) -> tuple[FloatArray, FloatArray]:
        """X and y (nodes_y, nodes_x) of the map's nodes, metres."""
        return self._x, self._y

    def on_map(self, nodes: FloatArray | Image) -> FloatArray:
        """What is shown at the pressable nodes (P,), as an image (nodes_y, nodes_x)."""
        return np.asarray(self._map_weights @ nodes).reshape(self._x.shape)

    def on_nodes(self, image: FloatArray | Image) -> FloatArray:
        """What an image (nodes_y, nodes_x) shows at the pressable nodes, (P,)."""
        return np.asarray(image[self._nearest], np.float64)

    def find(self, pressed: FloatArray | Image, pressed_nodes: FloatArray) -> Areas:
        """Find connected areas above one half; what lies around each goes to the nearest.

        Args:
            pressed: (nodes_y, nodes_x) share pressed, 0 to 1.
            pressed_nodes: (P,) the same at the pressable nodes.
        """
        smallest_area_m2 = 20e-6  # below this, a spot is a trace of the fit, not a contact
        label, count = ndimage.label(pressed > 0.5, structure=np.ones((3, 3)))
        if count == 0:
            none = np.zeros((0, *pressed.shape))
            on_nodes = np.zeros((0, len(pressed_nodes)))
            return Areas(none, on_nodes, np.zeros((0, 2)), np.zeros(0), np.zeros((0, 3)))
        nearest = ndimage.distance_transform_edt(
            label == 0, return_distances=False, return_indices=True
        )
        owner = label[tuple(nearest)]
        mine = owner[None] == np.arange(1, count + 1)[:, None, None]
        on_map = mine * pressed
        areas = on_map.sum(axis=(1, 2)) * self._cell_m2
        keep = areas >= smallest_area_m2
        on_map, areas = on_map[keep], areas[keep]
        weight = np.maximum(on_map.sum(axis=(1, 2)), 1e-12)
        centres = np.stack(
            [(on_map * axis).sum(axis=(1, 2)) / weight for axis in (self._x, self._y)], axis=1
        )
        on_nodes = mine[keep][:, *self._nearest] * pressed_nodes
        return Areas(on_map, on_nodes, centres, areas, np.full((len(areas), 3), np.nan))

    def inner_parts(self, areas: Areas, coverage: FloatArray, on_map: FloatArray) -> Areas:
        """What of each area lies within shapes that are drawn smaller.

        Args:
            areas: K areas.
            coverage: (P,) share pressed by the smaller shapes.
            on_map: (nodes_y, nodes_x) the same.
        """
        inside = np.minimum(areas.on_nodes, (areas.on_nodes > 0) * coverage)
        parts = np.minimum(areas.on_map, (areas.on_map > 0) * on_map)
        size = parts.sum(axis=(1, 2)) * self._cell_m2
        return replace(areas, on_map=parts, on_nodes=inside, areas_m2=size)

    def with_sigmas(self, areas: Areas, shape: Shape, covariance: FloatArray) -> Areas:
        """Say how far the places and sizes of a shape's areas may be trusted.

        Args:
            areas: those of the shape.
            shape: what they were found in.
            covariance: (n, n) of its parameters.
        """
        edge = shape.moving
        slope = shape.family.slope(shape.parameters, edge) * self._node_m2[edge, None]
        sigmas = np.full((len(areas), 3), np.nan)
        for k, inside in enumerate(areas.on_nodes[:, edge] > 0):
            by_area = slope[inside].sum(axis=0)
            off = self._nodes[:, edge[inside]] - areas.centres_m[k, :, None]
            by_centre = off @ slope[inside] / areas.areas_m2[k]
            gradient = np.vstack([by_centre, by_area])
            sigmas[k] = np.sqrt(np.einsum("ij,jk,ik->i", gradient, covariance, gradient))
        return replace(areas, sigmas=sigmas)

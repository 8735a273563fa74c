"""Separate pressed areas: found in an image of what is pressed, with their places and sizes."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from scipy import ndimage

from tactomo_models.arrays import FloatArray, Image, IntArray
from tactomo_models.physics.forward import ForwardModel


@dataclass(frozen=True)
class Areas:
    """Separate pressed areas."""

    on_map: FloatArray  # (K, nodes_y, nodes_x) share of each map node that each area covers
    on_nodes: FloatArray  # (K, P) the same at the pressable nodes
    centres_m: FloatArray  # (K, 2) centroids
    areas_m2: FloatArray  # (K,)
    sigmas: FloatArray  # (K, 3) standard uncertainties of x, y and area; NaN where unknown

    def __len__(self) -> int:
        return len(self.areas_m2)

    def joined(self, other: Areas) -> Areas:
        """These areas, then others of the same map."""
        names = [each.name for each in fields(Areas)]
        pairs = ([getattr(self, name), getattr(other, name)] for name in names)
        return Areas(*(np.concatenate(pair) for pair in pairs))


class AreaFinder:
    """Splits an image of what is pressed into separate areas."""

    def __init__(self, forward: ForwardModel) -> None:
        description = forward.description
        # (2, P) x and y of the pressable nodes, metres
        self.places = forward.bare.points[:, forward.bare.pressable]
        self._map_weights = forward.bare.map_weights
        # (P,) share of the sheet's area that belongs to each
        self.node_areas_m2 = forward.node_areas_m2
        self._x, self._y = np.meshgrid(description.map_x_m, description.map_y_m)
        # (nodes_y, nodes_x) of the map's cells
        self.cells_m2 = description.area_factor(self._x, self._y) * (
            (description.map_x_m[1] - description.map_x_m[0])
            * (description.map_y_m[1] - description.map_y_m[0])
        )
        x, y = self.places
        column = np.abs(x[:, None] - description.map_x_m).argmin(axis=1)
        row = np.abs(y[:, None] - description.map_y_m).argmin(axis=1)
        # row and column (P,) of the map node next to each
        self.nearest: tuple[IntArray, IntArray] = (row, column)

    @property
    def map_places(self) -> tuple[FloatArray, FloatArray]:
        """X and y (nodes_y, nodes_x) of the map's nodes, metres."""
        return self._x, self._y

    def on_map(self, nodes: FloatArray | Image) -> FloatArray:
        """What is shown at the pressable nodes (P,), as an image (nodes_y, nodes_x)."""
        return np.asarray(self._map_weights @ nodes).reshape(self._x.shape)

    def on_nodes(self, image: FloatArray | Image) -> FloatArray:
        """What an image (nodes_y, nodes_x) shows at the pressable nodes, (P,)."""
        return np.asarray(image[self.nearest], np.float64)

    def find(
        self,
        pressed: FloatArray | Image,  # (nodes_y, nodes_x) share pressed, 0 to 1
        pressed_nodes: FloatArray,  # (P,) the same at the pressable nodes
    ) -> Areas:
        """Find connected areas above one half; what lies around each goes to the nearest."""
        smallest_area_m2 = 20e-6  # below this, a spot is a trace of the fit, not a contact
        label, count = ndimage.label(pressed > 0.5, structure=np.ones((3, 3)))
        if count == 0:
            none = np.zeros((0, *pressed.shape))
            on_nodes = np.zeros((0, len(pressed_nodes)))
            return Areas(none, on_nodes, np.zeros((0, 2)), np.zeros(0), np.zeros((0, 3)))
        owner = np.ones_like(label)
        if count > 1:
            nearest = ndimage.distance_transform_edt(
                label == 0, return_distances=False, return_indices=True
            )
            owner = label[tuple(nearest)]
        mine = owner[None] == np.arange(1, count + 1)[:, None, None]
        on_map = mine * pressed
        areas = (on_map * self.cells_m2).sum(axis=(1, 2))
        keep = areas >= smallest_area_m2
        on_map, areas = on_map[keep], areas[keep]
        weight = np.maximum(on_map.sum(axis=(1, 2)), 1e-12)
        centres = np.stack(
            [(on_map * axis).sum(axis=(1, 2)) / weight for axis in (self._x, self._y)], axis=1
        )
        on_nodes = mine[keep][:, *self.nearest] * pressed_nodes
        return Areas(on_map, on_nodes, centres, areas, np.full((len(areas), 3), np.nan))

    def less(self, areas: Areas, share: FloatArray) -> Areas:
        """The same areas where a share (nodes_y, nodes_x) of each node is left of them."""
        on_map = areas.on_map * share
        return replace(areas, on_map=on_map, areas_m2=(on_map * self.cells_m2).sum(axis=(1, 2)))

"""Finding the next contact: where a small disc would explain most of what is left unexplained.

A disc of area A in a locally even field E disturbs the voltage between drive d and measurement m
as a dipole does,

    delta V = -2 A (c - 1) / (c + 1) E_d . E_m          (c its ratio of conductivities)

in the field of the sheet as already pressed, so that what one contact hides of another is
allowed for. The residual is matched against such discs on a grid (a step of matching pursuit);
the best one's place and area start a new contact.

Source of the disc's dipole: Ammari & Kang, "Reconstruction of small inhomogeneities from boundary
measurements", Springer (2004), polarisation tensors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactomo_models.arrays import FloatArray
from tactomo_models.physics.forward import ForwardModel, Solution
from tactomo_models.scene.pressure_field import Drawing


@dataclass(frozen=True)
class MissingContact:
    """A contact that may be missing.

    Attributes:
        x_m, y_m: its place.
        radius_m: as it would be for a disc.
        gain: by how much the squared misfit would fall, to first order.
    """

    x_m: float
    y_m: float
    radius_m: float
    gain: float


class ContactSearch:
    """Looks for a contact in what is left unexplained of one sheet.

    Args:
        forward: the model of the sheet.
        ratio: conductivity of a typical contact over the bare sheet's.
    """

    def __init__(self, forward: ForwardModel, ratio: float) -> None:
        grid = 2.0  # distance of the spots that are looked at, in distances of map nodes
        reach = 3.0  # radius over which the field is averaged there, likewise
        self._forward = forward
        self._dipole = 2 * (ratio - 1) / (ratio + 1)
        description = forward.description
        spacing = description.width_m / (description.map.nodes_x - 1)
        x, y = forward.bare.points[:, forward.bare.pressable]
        cell = np.round(np.stack([x, y]) / (grid * spacing)).astype(int)
        _, chosen = np.unique(cell, axis=1, return_index=True)
        self._nodes = np.sort(chosen)
        self._x, self._y = x[self._nodes], y[self._nodes]
        self._probes = forward.probes(self._x, self._y, reach * spacing)

    def best(
        self, solution: Solution, residual: FloatArray, drawing: Drawing, weight: FloatArray
    ) -> MissingContact:
        """The disc that would explain most of a residual.

        Args:
            solution: of what is known to be pressed.
            residual: (M,) noise-weighted misfit that it leaves.
            drawing: what is known to be pressed.
            weight: (M,) inverse standard deviations of the data.
        """
        largest_m = 0.02  # radius of a contact to begin with
        by_area = self._forward.spot_sensitivity(self._probes, solution)
        by_area *= (self._dipole * weight / np.abs(self._forward.bare_voltages))[:, None]
        power = np.maximum((by_area**2).sum(axis=0), 1e-30)
        area = -(by_area.T @ residual) / power
        pressed = np.zeros(self._forward.bare.pressable.shape)
        pressed[drawing.nodes] = np.abs(drawing.enclosed)
        bare = pressed[self._nodes] < 0.1
        gain = np.where(bare & (area > 0), area**2 * power, 0.0)
        best = int(gain.argmax())
        radius = float(np.sqrt(max(area[best], 0.0) / np.pi))
        return MissingContact(
            float(self._x[best]),
            float(self._y[best]),
            min(radius, largest_m),
            float(gain[best]),
        )

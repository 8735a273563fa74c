"""What drift does to a sheet's voltages, and how much of a change it explains.

Three things, each a few modes of the logarithm of the voltages: a common gain (temperature, the
current, the amplifier), conductivity that wanders smoothly across the sheet, and creep, which
leaves what was pressed a little more conductive. An amount of each has a prior standard deviation,
so that the most likely drift behind a change is a small linear least-squares problem.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.physics.actual_sheet import UNEVEN_DRIFT
from tactomo_models.scans.frame_noise import noise_limit
from tactomo_models.scans.tare import Sensor
from tactomo_models.scene.reconstruction import Reconstruction
from tactomo_models.sensor.description import SensorDescription

FIELD_STD: Final = 2**0.5  # of the cosines of a square sheet's estimate, each of its prior size
CELLS: Final = 20  # across the sheet: creep is told apart by them
CREEP: Final = 0.01  # of the bare conductivity that a decade of time under pressure leaves
CREEP_BEGIN_S: Final = 1.0
FORGOTTEN: Final = 0.1  # decades of it that are worth no memory
OUT_OF_BOUNDS: Final = 2.5  # standard deviations that no drift reaches


@dataclass(frozen=True)
class Explained:
    """The most likely drift behind a change."""

    amounts: FloatArray  # (K,) of every mode
    left: FloatArray  # (M,) what they do not explain
    misfit: float  # sum of squares of that, over the limit of what noise may come to; good below 1
    excess: float  # the largest amount over its bound; good below 1


class DriftSubspace:
    """The modes of one sensor's drift: the gain, the smooth ones, and one for each cell's creep."""

    def __init__(self, sensor: Sensor) -> None:
        description, artifact = sensor.description, sensor.artifact
        self._size_m = (description.width_m, description.height_m)
        x, y = artifact.bare.points[:, artifact.bare.pressable]
        places = self._cell_of(x, y), np.arange(len(x))
        own = sp.csr_matrix((np.ones(len(x)), places), (CELLS**2, len(x)))
        predicted = sensor.forward.bare_voltages
        cells = (own @ artifact.jacobian.T).T * np.sign(predicted)[:, None]
        smooth = sensor.drift[:, 1:] / (UNEVEN_DRIFT * FIELD_STD)
        # (M, K) change of the logarithm of each voltage by a unit of each mode: a factor e for the
        # gain, a field of unit standard deviation for each smooth one together with the others, a
        # relative change of 1 for a cell
        self.modes = np.hstack([np.ones((len(cells), 1)), smooth, cells])
        self.smooth = slice(1, 1 + smooth.shape[1])  # places of the smooth modes among the K
        # places of the cells among the K
        self.cells = slice(1 + smooth.shape[1], self.modes.shape[1])
        # (nodes_y, nodes_x) the cell of each map node, from 0
        self.cell_of_map = self._cell_of(*np.meshgrid(description.map_x_m, description.map_y_m))

    def _cell_of(self, x_m: FloatArray, y_m: FloatArray) -> IntArray:
        width_m, height_m = self._size_m
        column = np.clip(np.floor((x_m / width_m + 0.5) * CELLS), 0, CELLS - 1)
        row = np.clip(np.floor((y_m / height_m + 0.5) * CELLS), 0, CELLS - 1)
        return np.asarray(row * CELLS + column, np.intp)

    def explain(
        self,
        change: FloatArray,  # (M,) of the logarithm of the voltages
        precision: FloatArray,  # (M,) its inverse variances by noise; 0 where it is not known
        sigma: FloatArray,  # (K,) prior standard deviation of each mode; 0 where it has no say
    ) -> Explained:
        """The most likely amounts of drift behind a change."""
        active = np.flatnonzero(sigma)
        modes, prior = self.modes[:, active], 1 / sigma[active] ** 2
        weighted = modes * precision[:, None]
        normal = modes.T @ weighted
        normal[np.diag_indices_from(normal)] += prior
        amounts = np.zeros_like(sigma)
        amounts[active] = scipy.linalg.solve(normal, weighted.T @ change, assume_a="pos")
        left = change - modes @ amounts[active]
        count = max(int(np.count_nonzero(precision)), 1)
        excess = np.abs(amounts[active]) * np.sqrt(prior) / OUT_OF_BOUNDS
        return Explained(
            amounts,
            left,
            float((precision * left**2).sum()) / noise_limit(count),
            float(excess.max(initial=0.0)),
        )


class PressMemory:
    """Which cells of the sheet were pressed, for how long, and how long ago."""

    def __init__(self, description: SensorDescription, subspace: DriftSubspace) -> None:
        self._strength = {
            name: min(1.0, description.contrast(name) - 1) for name in description.channels
        }
        self._cell_of_map = subspace.cell_of_map.ravel()
        self._sigma = np.zeros(subspace.modes.shape[1])
        self._cells, self._number = subspace.cells, CELLS**2
        self._count = np.maximum(np.bincount(self._cell_of_map, minlength=self._number), 1)
        self.clear()

    def clear(self) -> None:
        """Forget all."""
        self._pressed_s = np.zeros(self._number)
        self._left_s = np.zeros(self._number)  # when each cell was last pressed

    def add(self, time_s: float, elapsed_s: float, frame: Reconstruction) -> None:
        """Take note of what a frame shows as pressed."""
        covered = 0.05  # share pressed from which a cell counts as pressed
        image = frame.map if frame.structure is None else frame.structure
        if not frame.contacts or image is None:
            return
        share = np.nan_to_num(np.abs(image.ravel()))  # NaN off the sheet
        if frame.structure is None:
            share = share / max(float(share.max()), 1e-12)
        cells = np.bincount(self._cell_of_map, share, minlength=self._number) / self._count
        pressed = cells > covered
        self._pressed_s[pressed] += max(elapsed_s, CREEP_BEGIN_S)
        self._left_s[pressed] = time_s

    def creep(self, time_s: float, name: Channel) -> FloatArray:
        """Standard deviations (K,) of what may be left of it now; 0 for all other modes."""
        ago_s = np.maximum(time_s - self._left_s, 0.0) + CREEP_BEGIN_S
        decades = np.log10(1 + self._pressed_s / ago_s)
        self._pressed_s[decades < FORGOTTEN] = 0.0
        sigma = np.zeros_like(self._sigma)
        sigma[self._cells] = CREEP * self._strength[name] * decades * (decades >= FORGOTTEN)
        return sigma

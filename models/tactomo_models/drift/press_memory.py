"""Which parts of a skin were pressed, and what may be left of it: creep, logarithmic in time."""

from __future__ import annotations

from typing import Final

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.drift.drift_model import DriftSubspace
from tactomo_models.scene.reconstruction import Reconstruction
from tactomo_models.sensor.description import SensorDescription

CREEP: Final = 0.01  # of the bare conductivity that a decade of time under pressure leaves
CREEP_BEGIN_S: Final = 1.0
FORGOTTEN: Final = 0.1  # decades of it that are worth no memory


class PressMemory:
    """Which cells of the sheet were pressed, for how long, and how long ago."""

    def __init__(self, description: SensorDescription, subspace: DriftSubspace) -> None:
        self._strength = {
            name: min(1.0, description.contrast(name) - 1) for name in description.channels
        }
        self._cell_of_map = subspace.cell_of_map.ravel()
        self._sigma = np.zeros(subspace.modes.shape[1])
        self._cells = subspace.cells
        self._count = np.maximum(np.bincount(self._cell_of_map, minlength=self._number), 1)
        self.clear()

    @property
    def _number(self) -> int:
        return int(self._cells.stop - self._cells.start)

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

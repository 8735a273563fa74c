"""Signs for the voltages of devices that tell sizes alone, such as a peak or RMS detector does.

Where drive and measuring pair do not cross, a voltage has the bare sheet's sign whatever presses
(see `plausibility`); so it is with every voltage between neighbours. Where they cross, pressing may
turn a voltage round, and does if it is small: one of less than a fifth of their root mean square
keeps no certain sign and is left out. In 360 simulated scenes of a contrast of 100, six patterns,
no voltage changed its sign without crossing; of the crossing ones 0.1 % above that limit did.
"""

from __future__ import annotations

import numpy as np

from tactomo_models.arrays import FloatArray
from tactomo_models.scans.plausibility import Wiring
from tactomo_models.sensor.description import SensorDescription


class Polarity:
    """What turns a device's readings into voltages."""

    def __init__(
        self,
        description: SensorDescription,  # the sensor; says whether its instrument tells signs
        wiring: Wiring,  # of the same sensor
        predicted: FloatArray,  # (M,) voltages of the bare sheet by the model, on any scale
    ) -> None:
        min_crossing = 0.2  # of the voltages' root mean square
        least = min_crossing * float(np.sqrt(np.mean(predicted**2)))
        kind = description.instrument.voltages
        self._are_told = kind == "signed"
        self._model = np.sign(predicted)
        # (M,) readings whose sign is known; all between rim electrodes where the device tells it,
        # and the half that it reads where it reads but one sign. Off the rim, one may be next
        # to nothing at rest, against which no change can be measured.
        told = self._are_told & ~wiring.off_rim
        self.certain = wiring.ordered | (np.abs(predicted) > least) | told
        if kind in ("positive", "negative"):
            self.certain &= self._model == (1.0 if kind == "positive" else -1.0)

    def apply(self, readings: FloatArray) -> FloatArray:
        """Voltages (..., M) of a device's readings, by the model's signs where it tells none."""
        return readings if self._are_told else np.abs(readings) * self._model

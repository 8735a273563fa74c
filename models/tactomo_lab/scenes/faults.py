"""What a broken lead does to the voltages of a skin.

Made from what an ideal device would read. A device drives a current of limited voltage and reads
each electrode against its ground, so a lead that is open carries no current and reads whatever the
input floats to: contact impedance alone changes little in four-wire voltages.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.sensor.description import SensorDescription

Reading = Callable[[int, float], float]


def with_lead(
    description: SensorDescription,  # the sensor
    volts: FloatArray,  # (M,) what a good device reads
    electrode: int,  # whose lead it is
    current: float,  # share of the current that still passes
    reading: Reading,  # from the drive and the potential there, in volts, to what is read
) -> FloatArray:
    """Voltages (M,) of a skin with a bad lead; adjacent patterns only."""
    drive, measure = description.pairs.drive, description.pairs.measure
    volts = np.where((drive == electrode).any(axis=1), current * volts, volts)
    count = description.electrode_count
    per_drive = count - 3
    made = volts.copy()
    for k in range(count):
        rows = np.flatnonzero(drive[:, 0] == k)
        rows = rows[np.argsort((measure[rows, 0] - k) % count)]  # along the rim, from k + 2 on
        at = (k + 2 + np.arange(per_drive + 1)) % count
        potential = -np.concatenate([[0.0], np.cumsum(volts[rows])])
        potential -= potential.mean()  # the amplifiers hold the skin at their ground
        read = np.array(
            [
                reading(k, p) if e == electrode else p
                for e, p in zip(at.tolist(), potential.tolist(), strict=True)
            ]
        )
        made[rows] = read[:-1] - read[1:]
    return made

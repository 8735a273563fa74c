"""What a broken lead, a short or a wrong order of electrodes does to the voltages of a skin.

Made from what an ideal device would read. A device drives a current of limited voltage and reads
each electrode against its ground, so a lead that is open carries no current and reads whatever the
input floats to: contact impedance alone changes nothing in four-wire voltages.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from tactomo_models import SensorDescription, SkinSimulator
from tactomo_models.forward import ForwardModel

FloatArray = NDArray[np.float64]
Reading = Callable[[int, float], float]


def touches(description: SensorDescription, electrode: int) -> NDArray[np.bool_]:
    """Voltages (M,) that are driven or read by an electrode."""
    pairs = description.pairs
    return np.asarray((np.hstack([pairs.drive, pairs.measure]) == electrode).any(axis=1))


def with_lead(
    description: SensorDescription,
    volts: FloatArray,
    electrode: int,
    current: float,
    reading: Reading,
) -> FloatArray:
    """Voltages (M,) of a skin with a bad lead; adjacent patterns only.

    Args:
        description: the sensor.
        volts: (M,) what a good device reads.
        electrode: whose lead it is.
        current: share of the current that still passes.
        reading: from the drive and the potential there, in volts, to what is read.
    """
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


def shorted(simulator: SkinSimulator, first: int, second: int) -> SkinSimulator:
    """The same skin with two electrodes connected: a rank-one change of the bare sheet."""
    forward = simulator._forward
    bare = forward.bare
    between = np.zeros(len(bare.transfer))
    between[first], between[second] = 1, -1
    electrodes = bare.transfer @ between
    nodes = bare.potentials @ between[:-1]
    resistance = between @ electrodes
    made = copy.copy(simulator)
    made._last = None
    made._forward = ForwardModel(
        simulator.description,
        replace(
            bare,
            transfer=bare.transfer - np.outer(electrodes, electrodes) / resistance,
            potentials=bare.potentials - np.outer(nodes, electrodes[:-1]) / resistance,
            green=bare.green - np.outer(nodes, nodes) / resistance,
        ),
    )
    return made


def rewired(simulator: SkinSimulator, order: list[int]) -> SkinSimulator:
    """The same skin, with the device's lead i on electrode order[i]."""
    forward = simulator._forward
    bare = forward.bare
    move = np.eye(len(order))[order]
    moved = move @ bare.transfer @ move.T
    # Potentials are held against the last lead's electrode: a current into lead l, out of the last.
    moved = moved - moved[-1:] - moved[:, -1:] + moved[-1, -1]
    full = np.hstack([bare.potentials, np.zeros((len(bare.potentials), 1))]) @ move.T
    made = copy.copy(simulator)
    made._last = None
    made._forward = ForwardModel(
        simulator.description,
        replace(bare, transfer=moved, potentials=(full - full[:, -1:])[:, :-1]),
    )
    return made

"""A simulated skin with a short or a wrong order of electrodes, and an electrode's voltages."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from noisy_skin import rms
from tactomo_lab.scenes.case import with_lead
from tactomo_models import SensorDescription, SkinSimulator
from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.physics.bare_sheet import exchanged
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.greens import PackedGreensFunction


def touches(description: SensorDescription, electrode: int) -> BoolArray:
    """Voltages (M,) that are driven or read by an electrode."""
    pairs = description.pairs
    return np.asarray((np.hstack([pairs.drive, pairs.measure]) == electrode).any(axis=1))


BadLead = Callable[[SensorDescription, FloatArray, int], FloatArray]
BAD_LEADS: Final[dict[str, BadLead]] = {
    "open, reads 0 V": lambda d, v, e: with_lead(d, v, e, 1e-3, lambda *_: 0.0),
    "open, floats": lambda d, v, e: with_lead(d, v, e, 1e-3, lambda *_: 3 * rms(v)),
    "poor, half the signal": lambda d, v, e: with_lead(d, v, e, 0.5, lambda _, true: true / 2),
    "silent": lambda d, v, e: np.where(touches(d, e), 1e-6 * v, v),
    "gain halved": lambda d, v, e: np.where(d.pairs.measure[:, 0] == e, v / 2, v),
}
"""What becomes of a scan's voltages where the lead of an electrode is bad."""


def shorted(simulator: SkinSimulator, first: int, second: int) -> SkinSimulator:
    """The same skin with two electrodes connected: a rank-one change of the bare sheet."""
    forward = simulator.forward
    bare = forward.bare
    between = np.zeros(len(bare.transfer))
    between[first], between[second] = 1, -1
    electrodes = bare.transfer @ between
    nodes = bare.potentials @ between[:-1]
    resistance = between @ electrodes
    every = np.arange(len(nodes))
    made = copy.copy(simulator)
    made._last = None
    made.forward = ForwardModel(
        simulator.description,
        replace(
            bare,
            transfer=bare.transfer - np.outer(electrodes, electrodes) / resistance,
            potentials=bare.potentials - np.outer(nodes, electrodes[:-1]) / resistance,
            green=PackedGreensFunction(
                (bare.green.between(every, every) - np.outer(nodes, nodes) / resistance)[
                    np.tril_indices(len(nodes))
                ]
            ),
        ),
    )
    return made


def rewired(simulator: SkinSimulator, order: list[int]) -> SkinSimulator:
    """The same skin, with the device's lead i on electrode order[i]."""
    forward = simulator.forward
    bare = forward.bare
    move = np.eye(len(order))[order]
    # Potentials are held against the last lead's electrode: a current into lead l, out of the last.
    full = np.hstack([bare.potentials, np.zeros((len(bare.potentials), 1))]) @ move.T
    made = copy.copy(simulator)
    made._last = None
    made.forward = ForwardModel(
        simulator.description,
        replace(
            bare, transfer=exchanged(bare.transfer, order), potentials=(full - full[:, -1:])[:, :-1]
        ),
    )
    return made

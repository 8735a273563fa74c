"""A simulated skin with a short or a wrong order of electrodes, and an electrode's voltages."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
from tactomo_models import SensorDescription, SkinSimulator
from tactomo_models.arrays import BoolArray
from tactomo_models.physics.bare_sheet import exchanged
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.greens import PackedGreensFunction


def touches(description: SensorDescription, electrode: int) -> BoolArray:
    """Voltages (M,) that are driven or read by an electrode."""
    pairs = description.pairs
    return np.asarray((np.hstack([pairs.drive, pairs.measure]) == electrode).any(axis=1))


def shorted(simulator: SkinSimulator, first: int, second: int) -> SkinSimulator:
    """The same skin with two electrodes connected: a rank-one change of the bare sheet."""
    forward = simulator.forward
    bare = forward.bare
    between = np.zeros(len(bare.transfer))
    between[first], between[second] = 1, -1
    electrodes = bare.transfer @ between
    nodes = bare.potentials @ between[:-1]
    resistance = between @ electrodes
    made = copy.copy(simulator)
    made._last = None
    made.forward = ForwardModel(
        simulator.description,
        replace(
            bare,
            transfer=bare.transfer - np.outer(electrodes, electrodes) / resistance,
            potentials=bare.potentials - np.outer(nodes, electrodes[:-1]) / resistance,
            green=PackedGreensFunction(
                (bare.green.rows(np.arange(len(nodes))) - np.outer(nodes, nodes) / resistance)[
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

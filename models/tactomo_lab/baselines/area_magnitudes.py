"""A magnitude for each area of a given shape, by Gauss-Newton."""

from __future__ import annotations

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.methods.magnitudes import Magnitudes, Tangent, step
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scans.changes import Changes


def fit_magnitudes(
    forward: ForwardModel,  # the model of the sheet
    # (K, P) share of each pressable node that each of at least one area covers
    on_nodes: FloatArray,
    measured: Changes,  # the magnitude channel's changes
    *,
    solves: int = 3,  # forward solves allowed
) -> Magnitudes:
    """Fit each area's conductivity change by Gauss-Newton."""
    change = np.zeros(len(on_nodes))
    for _ in range(solves):
        fitted = step(_tangent(forward, on_nodes, change), measured)
        change = fitted.change
    return fitted


def _tangent(forward: ForwardModel, on_nodes: FloatArray, change: FloatArray) -> Tangent:
    where = np.flatnonzero(on_nodes.any(axis=0))
    solution = forward.solve(change @ on_nodes)
    bare = forward.bare_voltages
    jacobian = forward.jacobian(solution, where, on_nodes[:, where].T)
    return Tangent(
        change, (solution.voltages - bare) / np.abs(bare), jacobian / np.abs(bare)[:, None]
    )

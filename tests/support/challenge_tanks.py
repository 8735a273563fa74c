"""Tanks of the Kuopio Tomography Challenge, simulated on a finer mesh than inverts."""

from __future__ import annotations

import numpy as np
from tactomo_lab.evaluation.ktc import every_reading
from tactomo_lab.tanks.model import TankModel, pixel_grid
from tactomo_models.arrays import FloatArray

ELECTRODES = 32
AGAINST = (0, 8, 16, 24)  # electrodes by which the currents of the others leave
FINE_RINGS = 37  # of nodes: the mesh that inverts has 22
ROWS = 256


def challenge_pattern() -> tuple[FloatArray, FloatArray]:
    """Unit currents and weights (2356, 32) of all readings, the currents changing last.

    Every second electrode drives: with the next of these, and with each of four; neighbours are
    measured.
    """
    driven = range(0, ELECTRODES, 2)
    pairs = [(i, (i + 2) % ELECTRODES) for i in driven]
    pairs += [(i, j) for j in AGAINST for i in driven if i != j]
    eye = np.eye(ELECTRODES)
    drive = np.array([eye[i] - eye[j] for i, j in pairs])
    measure = np.array([eye[i] - eye[i + 1] for i in range(ELECTRODES - 1)])
    return every_reading(drive.T, measure.T)


def simulated_tank(model: TankModel, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Draw two round objects of either kind in a tank of `FINE_RINGS`, and solve it.

    Returns (ROWS, ROWS) 1 in what conducts better and -1 worse, and the changes (P,) of the
    transfer resistances.
    """
    radius, turn = rng.uniform(0.2, 0.35, 2), rng.uniform(0, 2 * np.pi)
    kinds, middle = rng.choice([-1, 1], 2), 0.5 * np.array([np.cos(turn), np.sin(turn)])

    def kind(x: FloatArray, y: FloatArray) -> FloatArray:
        sides = zip(kinds, radius, (1, -1), strict=True)
        each = [k * (np.hypot(x - s * middle[0], y - s * middle[1]) < r) for k, r, s in sides]
        return np.asarray(np.sum(each, axis=0))

    x, y = model.points[model.triangles].mean(axis=1).T
    solved = model.solve(100.0 ** kind(x, y))[0] - model.empty
    return kind(*pixel_grid(ROWS)[:2]), solved

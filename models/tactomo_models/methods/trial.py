"""x"""
from __future__ import annotations
import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.scene.parameters import E1, E2, SIZE, UNIT_M, X, Y
FAR_STEPS = 20
HOPELESS = -6.0
def gaps_between(contacts: FloatArray) -> FloatArray:
    """Distances (K, K) between outlines of contacts (K, COLUMNS), m, about."""
    place = contacts[:, [X, Y]] * UNIT_M
    reach = np.exp(contacts[:, SIZE] + np.hypot(*contacts[:, [E1, E2]].T))
    apart = np.linalg.norm(place[:, None] - place, axis=2)
    return np.asarray(apart - reach[:, None] - reach)



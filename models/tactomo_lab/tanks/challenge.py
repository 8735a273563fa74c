"""The Kuopio Tomography Challenge: how its tanks are read, and its score.

Source: Rasanen et al., "Kuopio Tomography Challenge 2023 open electrical impedance tomographic
dataset", doi 10.5281/zenodo.8252370.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.ndimage import gaussian_filter
from tactomo_models.arrays import BoolArray, FloatArray, Image

WINDOW = 80  # pixels, standard deviation of the score's window; it ends at twice that
C1, C2 = 1e-4, 9e-4


def every_reading(currents: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Currents and weights (D m, L) of each reading, of those of D drives (L, D) and m (L, m)."""
    each = np.repeat(currents.T, weights.shape[1], axis=0)
    return each, np.tile(weights.T, (currents.shape[1], 1))


def kept_readings(currents: FloatArray, weights: FloatArray, lost: Iterable[int]) -> BoolArray:
    """Which readings (n,) touch none of the lost electrodes."""
    lost = list(lost)
    return np.asarray(~(currents[:, lost].any(axis=1) | weights[:, lost].any(axis=1)))


def score(truth: Image, found: Image) -> float:
    """The challenge's score: mean structural similarity of what conducts worse, and of better.

    Both (rows, columns) of 0 water, 1 worse, 2 better.
    """
    return float(np.mean([_similarity(truth == kind, found == kind) for kind in (1, 2)]))


def _similarity(truth: BoolArray, found: BoolArray) -> float:
    """Mean of the index of Wang et al., IEEE Trans. Image Process. 13 (2004), equation 13."""
    here = _windowed(np.ones(truth.shape))
    t, f = (_windowed(image.astype(float)) / here for image in (truth, found))
    both = _windowed((truth & found).astype(float)) / here
    means = (2 * t * f + C1) / (t**2 + f**2 + C1)  # a mask is its own square
    return float(np.mean(means * (2 * (both - t * f) + C2) / (t - t**2 + f - f**2 + C2)))


def _windowed(image: FloatArray) -> FloatArray:
    return np.asarray(gaussian_filter(image, WINDOW, mode="constant", truncate=2))

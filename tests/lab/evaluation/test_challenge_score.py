"""The challenge's pattern and score."""

from __future__ import annotations

import numpy as np
import pytest
from challenge_tanks import challenge_pattern
from scipy.signal import fftconvolve
from tactomo_lab.evaluation.ktc import kept_readings, score
from tactomo_models.arrays import FloatArray


def _similarity(truth: FloatArray, found: FloatArray) -> float:
    """As the organisers write it: a full two-dimensional window, cut off at twice its width."""
    far = np.arange(-160, 161)
    window = np.exp(-0.5 * (far[:, None] ** 2 + far**2) / 80**2)

    def mean(image: FloatArray) -> FloatArray:
        all_of_it = fftconvolve(np.ones_like(image), window, "same")
        return np.asarray(fftconvolve(image, window, "same") / all_of_it)

    t, f = mean(truth), mean(found)
    variances = mean(truth**2) - t**2, mean(found**2) - f**2
    both = mean(truth * found) - t * f
    numerator = (2 * t * f + 1e-4) * (2 * both + 9e-4)
    return float(np.mean(numerator / ((t**2 + f**2 + 1e-4) * (sum(variances) + 9e-4))))


def test_score_is_the_organisers() -> None:
    rows, columns = np.mgrid[:256, :256]
    truth = np.where(np.hypot(rows - 90, columns - 100) < 40, 1, 0)
    truth[150:190, 120:200] = 2
    found = np.roll(truth, 9, axis=1)
    found[20:30, 100:110] = 1
    parts = [_similarity((truth == k) * 1.0, (found == k) * 1.0) for k in (1, 2)]
    assert score(truth, found) == pytest.approx(np.mean(parts), abs=1e-9)
    assert score(truth, truth) == pytest.approx(1)
    assert score(np.where(truth == 1, 1, 0), np.zeros_like(truth)) == pytest.approx(0.5, abs=0.05)


def test_levels_lose_electrodes() -> None:
    currents, weights = challenge_pattern()
    assert currents.shape == weights.shape == (2356, 32)
    counts = [kept_readings(currents, weights, range(2 * lost)).sum() for lost in range(7)]
    assert counts[0] == 2356
    assert counts[6] == 27 * 19
    assert np.all(np.diff(counts) < 0)

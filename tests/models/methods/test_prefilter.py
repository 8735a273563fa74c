"""The filter in front of the networks: linear estimation of least error, whatever is missing."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from tactomo_models.methods.prefilter import BANDS, prefilter, signal_basis

VOLTAGES, COMPONENTS = 40, 20


MIXING = np.random.default_rng(9).standard_normal((COMPONENTS, VOLTAGES))
MIXING *= np.geomspace(1, 0.02, COMPONENTS)[:, None]


def scenes(count: int = 4000, seed: int = 0) -> np.ndarray:
    """Changes of rank 20, as reciprocity leaves half of the voltages independent."""
    return np.random.default_rng(seed).standard_normal((count, COMPONENTS)) @ MIXING


BASIS = signal_basis(scenes(), COMPONENTS)


def test_coefficients_of_scenes_have_unit_mean_square_and_are_uncorrelated() -> None:
    filtered = scenes() @ prefilter(BASIS, np.full(VOLTAGES, 1e12)).matrix.T
    np.testing.assert_allclose(filtered.T @ filtered / len(filtered), np.eye(COMPONENTS), atol=1e-3)


def test_without_noise_nothing_is_lost() -> None:
    change = scenes(10, seed=1)
    filtered = change @ prefilter(BASIS, np.full(VOLTAGES, 1e12)).matrix.T
    np.testing.assert_allclose(filtered @ BASIS.T, change, atol=1e-6)


def test_a_missing_voltage_is_filled_in_from_the_others() -> None:
    change = scenes(10, seed=1)
    certainty = np.full(VOLTAGES, 1e12)
    certainty[[3, 17]] = 0.0
    broken = change.copy()
    broken[:, [3, 17]] = 1e6  # whatever a dead lead reads
    filtered = broken @ prefilter(BASIS, certainty).matrix.T
    np.testing.assert_allclose(filtered @ BASIS.T, change, atol=1e-4)


def test_no_other_linear_estimate_is_better() -> None:
    rng = np.random.default_rng(2)
    change = scenes(seed=2)
    noise = rng.uniform(0.05, 1.0, VOLTAGES)
    data = change + noise * rng.standard_normal(change.shape)
    ours = data @ (BASIS @ prefilter(BASIS, noise**-2).matrix).T
    best = np.linalg.lstsq(data, change, rcond=None)[0]  # fitted to these very scenes
    assert np.mean((ours - change) ** 2) < 1.03 * np.mean((data @ best - change) ** 2)
    assert np.mean((ours - change) ** 2) < 0.3 * np.mean((data - change) ** 2)


@given(st.floats(-4, 4), st.floats(0.1, 3))
def test_more_noise_means_that_less_is_known(exponent: float, more: float) -> None:
    certainty = np.full(VOLTAGES, 10.0**exponent)
    quiet, noisy = (prefilter(BASIS, c).known for c in (certainty, certainty / 10**more))
    assert quiet.shape == (BANDS,)
    assert ((noisy >= 0) & (noisy <= quiet) & (quiet <= 1)).all()


def test_a_mute_channel_says_nothing() -> None:
    silent = prefilter(BASIS, np.zeros(VOLTAGES))
    assert not silent.matrix.any()
    assert not silent.known.any()

"""The evidence: against marginal likelihoods that are known, and what each datum counts for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from measured import measured
from scipy.linalg import solve_triangular
from tactomo_models import Channel
from tactomo_models.arrays import FloatArray
from tactomo_models.scene.evidence import FALSE_ALARM, Likelihood, log_occam

DATA = 1500


def likelihood_of(weight: FloatArray, inflation: FloatArray | float = 1.0) -> Likelihood:
    changes = measured(np.zeros(len(weight)), weight)
    inflated = replace(changes, variance_inflation=np.broadcast_to(inflation, weight.shape))
    return Likelihood.of({Channel.MAGNITUDE: inflated})


def log_evidence(design: FloatArray, data: FloatArray, precision: FloatArray) -> float:
    """Of a linear model with a prior around 0, in the way that accounts are judged."""
    likelihood = likelihood_of(np.ones(len(data)))
    best = np.linalg.solve(design.T @ design + np.diag(precision), design.T @ data)
    chi_squared = likelihood.chi_squared(design @ best - data)
    hessian = likelihood.information(design, chi_squared) + np.diag(precision)
    away = float(precision @ best**2)
    return likelihood.log(chi_squared) - away / 2 + log_occam(precision, hessian)


def log_marginal(design: FloatArray, data: FloatArray, precision: FloatArray) -> float:
    """The same by the data's own covariance."""
    half = np.linalg.cholesky(np.eye(len(data)) + (design / precision) @ design.T)
    white = solve_triangular(half, data, lower=True)
    return float(-white @ white / 2 - np.log(2 * np.pi * np.diag(half) ** 2).sum() / 2)


@pytest.mark.parametrize("size", [0.0, 0.05, 0.2], ids=["absent", "at the noise", "present"])
def test_of_linear_models_it_is_the_marginal_likelihood(size: float) -> None:
    """Which of two models is likelier, and by how much, where data are many."""
    rng = np.random.default_rng(3)
    design, precision = rng.standard_normal((DATA, 6)), np.geomspace(0.1, 10, 6)
    true = np.array([0.5, -0.3, 0.2, 0.1, size, size])
    data = design @ true + rng.standard_normal(DATA)
    few = design[:, :4], data, precision[:4]
    all_ = design, data, precision
    gain = log_evidence(*all_) - log_evidence(*few)
    assert gain == pytest.approx(log_marginal(*all_) - log_marginal(*few), rel=0.1, abs=0.2)


def test_errors_of_another_size_than_was_told_hardly_change_what_is_likelier() -> None:
    """Their variance is integrated over: twice the told errors is no proof of a parameter."""
    rng = np.random.default_rng(4)
    design, precision = rng.standard_normal((DATA, 2)), np.ones(2)
    gains = []
    for scale in (1.0, 2.0):
        data = scale * (0.1 * design[:, 0] + rng.standard_normal(DATA))
        gains.append(log_evidence(design, data, precision))
        gains[-1] -= log_evidence(design[:, :1], data, precision[:1])
    assert max(gains) < 0  # the second column explains nothing


def test_a_parameter_pays_for_the_share_of_its_range_that_is_left() -> None:
    precision, told = np.array([0.04, 1.0]), np.array([100.0, 0.0])
    paid = log_occam(precision, np.diag(precision + told))
    assert paid == pytest.approx(-np.log(1 + 100 / 0.04) / 2)


@given(st.integers(1, 6), st.integers(0, 2**16))
def test_data_never_widen_a_range(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    precision = np.exp(rng.uniform(-3, 3, count))
    half = rng.standard_normal((count, count))
    assert log_occam(precision, np.diag(precision) + half @ half.T) <= 1e-9


def test_errors_that_go_together_count_as_fewer_data() -> None:
    """A fourfold variance: each voltage is a fourth of a datum, in all that is summed."""
    rng = np.random.default_rng(5)
    residual, jacobian = rng.standard_normal(80), rng.standard_normal((80, 3))
    alone, together = likelihood_of(np.ones(80)), likelihood_of(np.ones(80), 4.0)
    assert together.count == alone.count / 4
    assert together.chi_squared(residual) == pytest.approx(alone.chi_squared(residual) / 4)
    np.testing.assert_allclose(
        together.information(jacobian, together.count),
        alone.information(jacobian, alone.count) / 4,
    )


def test_voltages_that_are_invalid_tell_nothing() -> None:
    weight = np.ones(80)
    weight[::4] = 0.0
    half = likelihood_of(weight)
    assert half.count == 60
    assert half.chi_squared(np.where(weight == 0, 1e6, 0.0)) == 0.0
    jacobian = np.where(weight == 0, 1e6, 0.0)[:, None]
    assert not half.information(jacobian, 60.0).any()


def test_what_is_left_is_the_errors_scale() -> None:
    """At what was told errors are as large; where four times as much is left, they are larger."""
    likelihood = likelihood_of(np.ones(200))
    assert likelihood.precision(200.0) == pytest.approx(1.0)
    assert likelihood.precision(800.0) == pytest.approx(2 / 5)


def test_noise_of_the_size_that_was_told_is_explained() -> None:
    """But for false alarms, of which there are as many as are asked for."""
    likelihood, rng = likelihood_of(np.ones(200)), np.random.default_rng(6)
    chi_squared = rng.chisquare(200, 20000)
    missed = np.mean([not likelihood.explains(float(each)) for each in chi_squared])
    assert missed == pytest.approx(FALSE_ALARM, abs=4 * np.sqrt(FALSE_ALARM / 20000))
    assert not likelihood.explains(200 + 6 * np.sqrt(2 * 200))


def test_parameters_that_stand_for_one_another_have_an_evidence() -> None:
    """Rounding may leave such a Hessian a negative eigenvalue."""
    precision = np.array([0.04, 0.04, 2.8])
    along = np.array([1.0, 1.0, 1e-3])
    hessian = 4e17 * np.outer(along, along) + np.diag(precision)
    assert np.isfinite(log_occam(precision, hessian))
    hessian[0, 1] = hessian[1, 0] = hessian[0, 0] + 64  # its last digit
    assert np.linalg.eigvalsh(hessian)[0] < 0
    assert np.isfinite(log_occam(precision, hessian))

"""A magnitude for each of given areas, by Gauss-Newton, as the paper's methods take it."""

from __future__ import annotations

import numpy as np
import pytest
from measured import measured
from tactomo_lab.baselines.paper_methods import fit_magnitudes
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene.areas import Areas

SIGMA = 0.002  # of each voltage's relative change


def changes(forward: ForwardModel, areas: Areas, change: tuple[float, float]) -> FloatArray:
    bare = forward.bare_voltages
    volts = forward.solve(np.array(change) @ areas.on_nodes).voltages
    return np.asarray((volts - bare) / np.abs(bare))


@pytest.mark.parametrize("truth", [(0.25, 0.05), (-0.2, -0.05), (0.2, -0.2)])
def test_magnitudes_come_back_with_their_uncertainty(
    forward: ForwardModel, two_areas: Areas, truth: tuple[float, float]
) -> None:
    """The share of errors within one standard uncertainty is the normal distribution's."""
    exact, rng = changes(forward, two_areas, truth), np.random.default_rng(5)
    within = []
    for _ in range(150):
        noisy = exact + SIGMA * rng.standard_normal(len(exact))
        fit = fit_magnitudes(forward, two_areas.on_nodes, measured(noisy, 1 / SIGMA))
        assert fit.misfit == pytest.approx(1, abs=0.5)
        within += list(np.abs(fit.change - truth) < fit.sigma)
    assert np.mean(within) == pytest.approx(0.68, abs=0.1)


def test_each_step_comes_much_nearer(forward: ForwardModel, two_areas: Areas) -> None:
    """Gauss-Newton on data without noise, at second order of what is left: a right Jacobian."""
    truth = (0.6, -0.3)
    data = measured(changes(forward, two_areas, truth), 1 / SIGMA)
    left = [
        np.linalg.norm(fit_magnitudes(forward, two_areas.on_nodes, data, solves=n).change - truth)
        for n in (1, 2, 3, 4)
    ]
    assert left[0] > 0.02
    assert left[1] < left[0] ** 1.5
    assert left[3] < 1e-4


def test_what_the_data_do_not_explain_makes_all_less_certain(
    forward: ForwardModel, two_areas: Areas
) -> None:
    data = changes(forward, two_areas, (0.25, -0.1))
    noise = 10 * SIGMA * np.random.default_rng(3).standard_normal(len(data))
    good, bad = (
        fit_magnitudes(forward, two_areas.on_nodes, measured(each, 1 / SIGMA))
        for each in (data, data + noise)
    )
    assert bad.misfit == pytest.approx(10, rel=0.5)
    np.testing.assert_allclose(bad.sigma, bad.misfit * good.sigma, rtol=0.1)

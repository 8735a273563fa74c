"""The paper's own level set: linear in the bare sheet's Jacobian. It is what we compare with.

    dsigma(x) = dsigma_0 (1 - H(f(x))) + dsigma_1 H(f(x))           equation 6
    f(x) = sum_i mu_i p_i(x) - 1/2                                  equation 7, with a resting value
    minimise |J dsigma(mu) - dV|^2 + alpha |mu|^2                   equations 8 and 9

dV are volts, every measurement alike, as the paper has it. alpha, which it does not mention, keeps
the coefficients that no voltage sees. It starts cold from the Tikhonov image and runs until it
settles, by Levenberg-Marquardt. Kernels and H are those of our own level set.

Both phases' conductivities are known: nothing changes outside, and inside it does by 2 (c - 1) /
(c + 1), what a round inclusion of ratio c looks like from far away in a linear equation. With
c - 1 itself, H comes out grey (0.03 at a ratio of 100); so it does where both are estimated with
mu, which also takes four times as many steps and leaves one scene in five unsettled.

Where the ratio is large, what J predicts is far from what the sheet does, and an outline may
explain the linear equation well and still be wrong. So the outcome is held against the nonlinear
forward model, once: that is the misfit it is judged by.

The free choices are the best of some sixty sets tried on tuning scenes of one to four contacts.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from tactomo_models.arrays import BoolArray, FloatArray, Image
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scans.changes import Changes
from tactomo_models.scene.field_fit import MAX_DAMPING, STEP_LIMIT, FieldFit, FittedField
from tactomo_models.scene.level_set import LevelSet
from tactomo_protocol import Channel

ALPHA: Final = 1.0  # with data of unit root mean square
CUT: Final = 0.25  # of the Tikhonov image's peak, where the outline starts
MAX_TRIALS: Final = 100  # steps tried, taken or not
SETTLED: Final = 1e-4  # share of the cost below which a gain is the last


class PaperLevelSet:
    """Equations 5 to 9 for one sensor.

    Args:
        forward: the model of the sheet.
        jacobian_by_node: (P, M) derivative of the bare sheet's relative voltage changes.
        ratio: conductivity of the pressed phase over the bare sheet's.
    """

    def __init__(self, forward: ForwardModel, jacobian_by_node: FloatArray, ratio: float) -> None:
        self.forward = forward
        self.family = LevelSet(forward)
        self._volts = np.abs(forward.bare_voltages)
        self._by_node = 2 * (ratio - 1) / (ratio + 1) * jacobian_by_node * self._volts  # (P, M)
        self._judge = FieldFit(forward)

    def predict(self, mu: FloatArray) -> FloatArray:
        """Voltage changes (M,) by equation 8, in the bare sheet's units, for coefficients (K,)."""
        drawing = self.family.draw(mu)
        return np.asarray(drawing.share @ self._by_node[drawing.nodes])

    def jacobian(self, mu: FloatArray) -> FloatArray:
        """Derivative (M, K) of `predict`."""
        drawing = self.family.draw(mu)
        return np.asarray(self._by_node[drawing.nodes].T @ drawing.slopes()[0])

    def fit(self, measured: Changes, image: FloatArray | Image) -> FittedField:
        """Minimise equation 9 and judge what comes out by the nonlinear model.

        Args:
            measured: the changes; a weight of 0 leaves a voltage out.
            image: (P,) Tikhonov image, not negative.
        """
        likeness = image.astype(np.float64) / max(float(image.max()), 1e-12)
        start = self.family.parameters_of(0.5 + 0.5 * (likeness - CUT) / (1 - CUT))
        mu, converged = self._minimise(start, measured.change * self._volts, measured.weight > 0)
        data = {Channel.STRUCTURE: measured}
        shape = self._judge.evaluate(self.family, mu, self._judge.likely, data)
        assert shape is not None
        return replace(shape, converged=converged)

    def _minimise(
        self, mu: FloatArray, data: FloatArray, valid: BoolArray
    ) -> tuple[FloatArray, bool]:
        """Levenberg-Marquardt; also whether it settled before the steps ran out."""
        scale = valid / max(float(np.sqrt(np.mean(data[valid] ** 2))), 1e-30)
        residual, cost = self._residual(mu, data, scale)
        damping, moved = 1.0, True
        for _ in range(MAX_TRIALS):
            if moved:
                J = scale[:, None] * self.jacobian(mu)
                normal = J.T @ J + ALPHA * np.eye(len(mu))
                gradient = J.T @ residual + ALPHA * mu
            step = -np.linalg.solve(normal + damping * np.eye(len(mu)), gradient)
            step *= min(1.0, STEP_LIMIT / max(float(np.abs(step).max()), 1e-12))
            trial, trial_cost = self._residual(mu + step, data, scale)
            moved = trial_cost < cost
            if moved:
                settled = cost - trial_cost < SETTLED * cost
                mu, residual, cost, damping = mu + step, trial, trial_cost, damping / 5
            else:
                damping *= 5
                settled = damping > MAX_DAMPING
            if settled:
                return mu, True
        return mu, False

    def _residual(
        self, mu: FloatArray, data: FloatArray, scale: FloatArray
    ) -> tuple[FloatArray, float]:
        residual = scale * (self.predict(mu) - data)
        cost = float(residual @ residual + ALPHA * (mu @ mu))
        # Where nothing is pressed there is no slope, and no way back.
        return residual, cost if self.family.draw(mu).share.max(initial=0.0) > 0.5 else np.inf

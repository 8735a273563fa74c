"""Objects that conduct better or worse than what surrounds them, both kinds in one scene.

A skin's contacts all change its conductivity one way; in a tank there may be metal beside
plastic. One signed level-set function tells both kinds and keeps them from overlapping:

    f(x) = sum_i mu_i p_i(x)            the paper, equation 7; 0 where there is nothing
    h = H(f - 1/2) - H(-f - 1/2)        1 in what conducts better, -1 in what conducts worse
    sigma = c in the one, 1 / c in the other, the edges between as in `sheet_response`
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene.drawing import heaviside, heaviside_slope
from tactomo_models.scene.field_fit import Budget, FieldFit, FittedField, Measured
from tactomo_models.scene.level_set import HALF_WIDTH, RESTING, LevelSet

Imager = Callable[[FloatArray], FloatArray]

GOOD_MISFIT = 1.0  # explained to the noise: no further step, and no other start


class SignedLevelSet(LevelSet):
    """Level-set functions whose shapes say of each node: better (1), bare (0) or worse (-1)."""

    def __init__(self, forward: ForwardModel) -> None:
        prior = 0.1  # inverse variance of a coefficient
        super().__init__(forward)
        self.prior_precision = np.full(self.kernels.shape[1], prior)

    def parameters_of(self, likeness: FloatArray, peaks: FloatArray | None = None) -> FloatArray:
        """Coefficients (K,) for an image (P,) that is 1 or -1 in objects and 0 elsewhere."""
        mu = self._projection @ np.clip(likeness, 2 * RESTING, -2 * RESTING)
        # Gaussians round off small objects; a start without any has no derivative.
        return np.asarray(mu * (-2 * RESTING / max(float(np.abs(self.kernels @ mu).max()), 1e-6)))

    def _step(self, f: FloatArray) -> tuple[FloatArray, BoolArray]:
        better, worse = f, 2 * RESTING - f
        share = heaviside(better / HALF_WIDTH) - heaviside(worse / HALF_WIDTH)
        return share, np.maximum(better, worse) > -HALF_WIDTH

    def _slope(self, f: FloatArray) -> FloatArray:
        worse = 2 * RESTING - f
        return (heaviside_slope(f / HALF_WIDTH) + heaviside_slope(worse / HALF_WIDTH)) / HALF_WIDTH


class ObjectFit:
    """Finds objects of both kinds, frame by frame.

    Args:
        fit: what fits them to the structure sheet.
        imager: signed linear image (P,) of relative voltage changes (M,).
    """

    def __init__(self, fit: FieldFit, imager: Imager) -> None:
        self.fit = fit
        self._level_set = SignedLevelSet(fit.forward)
        self._imager = imager
        self.forget()

    def forget(self) -> None:
        """Drop the warm start."""
        self._shape: FittedField | None = None

    def follow(self, measured: Measured, budget: Budget) -> tuple[FittedField, str]:
        """Find the objects that explain a frame.

        Args:
            measured: the structure channel's changes.
            budget: compute time that may be spent.

        Returns:
            The shape, whose `pressed` is signed, and in words what it came from.
        """
        warm = self._warm(measured)
        if warm is not None and warm.converged:
            return warm, "still"
        starts = [warm] if warm else []
        starts += self._cold(measured)
        best, how = self._nothing(measured), "nothing found"
        for start in starts:
            shape = self.fit.refine(start, measured, budget, GOOD_MISFIT)
            if shape.cost < best.cost:
                best, how = shape, "warm start" if start is warm else "cold start"
            if best.misfit <= GOOD_MISFIT or budget.over:
                break
        self._shape = best
        return best, how

    def _warm(self, measured: Measured) -> FittedField | None:
        """The last frame's shape against this one's data; None where there is none."""
        still_misfit = 1.1  # share of its misfit within which a settled shape is left alone
        if self._shape is None:
            return None
        shape = self.fit.compare(self._shape, measured)
        still = shape.misfit <= still_misfit * max(self._shape.misfit, GOOD_MISFIT)
        return replace(shape, converged=self._shape.converged and still)

    def _cold(self, measured: Measured) -> list[FittedField]:
        """The linear image, cut at each height; the more likely start comes first."""
        cut_heights = (0.35, 0.6)  # of the linear image's peak, where outlines may start
        image = self._imager(measured[Channel.STRUCTURE].change)
        image = image / max(float(np.abs(image).max()), 1e-12)
        shapes = []
        for height in cut_heights:
            likeness = np.sign(image) * np.clip(np.abs(image) / height - 0.5, 0, 1)
            parameters = self._level_set.parameters_of(likeness)
            shapes.append(self._evaluate(parameters, measured))
        return sorted((shape for shape in shapes if shape), key=lambda shape: shape.cost)

    def _nothing(self, measured: Measured) -> FittedField:
        shape = self._evaluate(np.zeros(self._level_set.kernels.shape[1]), measured)
        assert shape is not None
        return shape

    def _evaluate(self, parameters: FloatArray, measured: Measured) -> FittedField | None:
        return self.fit.evaluate(self._level_set, parameters, self.fit.likely, measured)

"""Objects that conduct better or worse than what surrounds them, both kinds in one scene.

A skin's contacts all change its conductivity one way; in a tank there may be metal beside
plastic. One signed level-set function tells both kinds and keeps them from overlapping:

    f(x) = sum_i mu_i p_i(x)            the paper, equation 7; 0 where there is nothing
    h = H(f - 1/2) - H(-f - 1/2)        1 in what conducts better, -1 in what conducts worse
    sigma = c in the one, 1 / c in the other, the edges between as in `shape_fit.conductivity`
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tactomo_models.forward import ForwardModel
from tactomo_models.levelset import HALF_WIDTH, RESTING, LevelSet
from tactomo_models.shape_fit import Budget, Shape, ShapeFit, heaviside, heaviside_slope

FloatArray = NDArray[np.float64]
Imager = Callable[[FloatArray], FloatArray]

PRIOR = 0.1  # inverse variance of a coefficient
CUT_HEIGHTS = (0.35, 0.6)  # of the linear image's peak, where outlines may start
GOOD_MISFIT = 1.0  # explained to the noise: no further step, and no other start
STILL_MISFIT = 1.1  # share of its misfit within which a settled shape is left alone


class SignedLevelSet(LevelSet):
    """Level-set functions whose shapes say of each node: better (1), bare (0) or worse (-1)."""

    def __init__(self, forward: ForwardModel) -> None:
        super().__init__(forward)
        self.prior_precision = np.full(self.kernels.shape[1], PRIOR)

    def parameters_of(self, likeness: FloatArray) -> FloatArray:
        """Coefficients (K,) for an image (P,) that is 1 or -1 in objects and 0 elsewhere."""
        mu = self._projection @ np.clip(likeness, 2 * RESTING, -2 * RESTING)
        # Gaussians round off small objects; a start without any has no derivative.
        return np.asarray(mu * (-2 * RESTING / max(float(np.abs(self.kernels @ mu).max()), 1e-6)))

    def render(self, parameters: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """(P,) h from -1 to 1, and where it is not 0 or may become so."""
        better, worse = self._both(parameters, slice(None))
        h = heaviside(better / HALF_WIDTH) - heaviside(worse / HALF_WIDTH)
        return h, np.maximum(better, worse) > -HALF_WIDTH

    def slope(self, parameters: FloatArray, nodes: NDArray[np.intp]) -> FloatArray:
        """Derivative (n, K) of h at n nodes by the coefficients."""
        better, worse = self._both(parameters, nodes)
        by_f = (
            heaviside_slope(better / HALF_WIDTH) + heaviside_slope(worse / HALF_WIDTH)
        ) / HALF_WIDTH
        return np.asarray(by_f[:, None] * self.kernels[nodes])

    def _both(
        self, parameters: FloatArray, nodes: slice | NDArray[np.intp]
    ) -> tuple[FloatArray, FloatArray]:
        f = self._function(parameters, nodes)
        return f, 2 * RESTING - f


class ObjectFollower:
    """Finds objects of both kinds, frame by frame.

    Args:
        forward: the model of what surrounds them.
        contrast: conductivity of the better objects over the bare one, and of the bare one over
            that of the worse objects.
        imager: signed linear image (P,) of relative voltage changes (M,).
    """

    def __init__(self, forward: ForwardModel, contrast: float, imager: Imager) -> None:
        self.fit = ShapeFit(forward, contrast)
        self._level_set = SignedLevelSet(forward)
        self._imager = imager
        self.forget()

    def forget(self) -> None:
        """Drop the warm start."""
        self._shape: Shape | None = None

    def follow(self, change: FloatArray, weight: FloatArray, budget_s: float) -> tuple[Shape, str]:
        """Find the objects that explain a frame.

        Args:
            change: (M,) relative voltage changes.
            weight: (M,) their inverse standard deviations.
            budget_s: compute time, by a model of the work.

        Returns:
            The shape, whose `pressed` is signed, and in words what it came from.
        """
        data, budget = (change, weight), Budget(budget_s)
        warm = self._warm(*data)
        if warm is not None and warm.converged:
            return warm, "still"
        starts = [warm] if warm else []
        starts += self._cold(*data)
        best, how = self._nothing(*data), "nothing found"
        for start in starts:
            shape = self.fit.refine(start, *data, budget, GOOD_MISFIT)
            if shape.cost < best.cost:
                best, how = shape, "warm start" if start is warm else "cold start"
            if best.misfit <= GOOD_MISFIT or budget.over:
                break
        self._shape = best
        return best, how

    def _warm(self, change: FloatArray, weight: FloatArray) -> Shape | None:
        """The last frame's shape against this one's data; None where there is none."""
        if self._shape is None:
            return None
        shape = self.fit.compare(self._shape, change, weight)
        still = shape.misfit <= STILL_MISFIT * max(self._shape.misfit, GOOD_MISFIT)
        return replace(shape, converged=self._shape.converged and still)

    def _cold(self, change: FloatArray, weight: FloatArray) -> list[Shape]:
        """The linear image, cut at each height; the more likely start comes first."""
        image = self._imager(change)
        image = image / max(float(np.abs(image).max()), 1e-12)
        shapes = []
        for height in CUT_HEIGHTS:
            likeness = np.sign(image) * np.clip(np.abs(image) / height - 0.5, 0, 1)
            parameters = self._level_set.parameters_of(likeness)
            nominal = self.fit.likely
            shapes.append(self.fit.evaluate(self._level_set, parameters, nominal, change, weight))
        return sorted((shape for shape in shapes if shape), key=lambda shape: shape.cost)

    def _nothing(self, change: FloatArray, weight: FloatArray) -> Shape:
        none = np.zeros(self._level_set.kernels.shape[1])
        shape = self.fit.evaluate(self._level_set, none, self.fit.likely, change, weight)
        assert shape is not None
        return shape

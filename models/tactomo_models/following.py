"""Following a shape through time: the warm start, and what to do when it leads nowhere.

Each frame starts from the last one's shape. A level set moves outlines but cannot make a contact
where there is none, so when the scene has changed too much, or a minimum does not explain the
data, other starts are tried: the shape with what its residual shows added ("grown"), and the
linear image alone ("cold"). A challenger is refined beside the shape in force, over as many frames
as the budget needs, and takes its place only once it explains the data better.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tactomo_models.levelset import RESTING, LevelSet, Shape

FloatArray = NDArray[np.float64]
Imager = Callable[[FloatArray], FloatArray]

GOOD_MISFIT = 1.0  # explained to the noise: no further step
SUSPECT_MISFIT = 1.5  # a minimum this bad may be the wrong one: others are tried
CUT_HEIGHTS = (0.8, 0.65, 0.5)  # of the linear image's peak, where an outline may start
SLACK = 1.1  # a settled shape is left alone while its misfit stays within this


class ShapeFollower:
    """Keeps the shape of what presses from frame to frame.

    Args:
        level_set: the fit.
        imager: linear image (P,), not negative, of relative voltage changes (M,).
    """

    def __init__(self, level_set: LevelSet, imager: Imager) -> None:
        self._level_set = level_set
        self._imager = imager
        self.forget()

    def forget(self) -> None:
        """Drop the warm start."""
        self._shape: Shape | None = None
        self._settled_misfit = 0.0
        self._challenger: Shape | None = None
        self._challenges = 0

    def follow(self, change: FloatArray, weight: FloatArray, budget_s: float) -> tuple[Shape, str]:
        """Find the shape that explains a frame.

        Args:
            change: (M,) relative voltage changes.
            weight: (M,) their inverse standard deviations.
            budget_s: compute time, by a model of the work.

        Returns:
            The shape, and in words what it came from.
        """
        before = self._shape
        if before is None:
            shape, how = self._cold(change, weight), "cold start"
        else:
            shape, how = self._level_set.compare(before, change, weight), "warm start"
            if before.converged and shape.misfit <= SLACK * max(self._settled_misfit, GOOD_MISFIT):
                shape = replace(shape, converged=True)
            elif _lost(before, shape):
                shape, how = self._best_start(shape, change, weight)
                self._challenger, self._challenges = None, 0
        if not shape.converged:
            shape = self._level_set.refine(shape, change, weight, budget_s, GOOD_MISFIT)
            self._settled_misfit = shape.misfit
        elif shape.misfit > SUSPECT_MISFIT:
            shape, how = self._challenge(shape, how, change, weight, budget_s)
        self._shape = shape
        return shape, how

    def _cold(self, change: FloatArray, weight: FloatArray) -> Shape:
        """Cut the linear image at the height that explains the data best.

        The image of a contact is as wide as the sensor is blind there, so no single height will
        do. Small shapes come first: they are the cheaper ones to solve.
        """
        image = self._imager(change)
        likeness = image / max(float(image.max()), 1e-12)
        best = None
        for height in CUT_HEIGHTS:
            cut = 0.5 + 0.5 * (likeness - height) / (1 - height)
            shape = self._level_set.start(cut, change, weight)
            if shape is None or (best is not None and shape.cost > best.cost):
                break
            best = shape
        return best or self._level_set.nothing(change, weight)

    def _grown(self, shape: Shape, change: FloatArray, weight: FloatArray) -> Shape:
        """Add to a shape what the linear image of its residual shows."""
        left = np.divide(-shape.residual, weight, out=np.zeros_like(change), where=weight > 0)
        image = self._imager(left)
        known = np.clip((self._level_set.function(shape) + 1) / 2, (1 + RESTING) / 2, 1)
        likeness = np.maximum(known, image / max(float(image.max()), 1e-12))
        return self._level_set.start(likeness, change, weight) or shape

    def _best_start(
        self, shape: Shape, change: FloatArray, weight: FloatArray
    ) -> tuple[Shape, str]:
        starts = [
            (shape, "warm start"),
            (self._grown(shape, change, weight), "grown"),
            (self._cold(change, weight), "cold start"),
        ]
        return min(starts, key=lambda start: start[0].cost)

    def _challenge(
        self, shape: Shape, how: str, change: FloatArray, weight: FloatArray, budget_s: float
    ) -> tuple[Shape, str]:
        """Refine another start beside a suspect minimum; the better of the two wins."""
        if self._challenger is None:
            if self._challenges == 2:
                return shape, how  # both were tried: this is what the model can explain
            if self._challenges == 0:
                self._challenger = self._grown(shape, change, weight)
            else:
                self._challenger = self._cold(change, weight)
            self._challenges += 1
            return shape, how  # a start costs solves enough for one frame
        rival = self._level_set.compare(self._challenger, change, weight)
        rival = self._level_set.refine(rival, change, weight, budget_s, GOOD_MISFIT)
        self._challenger = None if rival.converged else rival
        if rival.cost < 0.98 * shape.cost:
            self._challenger, self._challenges = None, 0
            self._settled_misfit = rival.misfit
            return rival, "restarted"
        return shape, how


def _lost(before: Shape, now: Shape) -> bool:
    """Tell whether the last frame's shape, held against new data, is no longer a start."""
    jumped = now.misfit > max(SUSPECT_MISFIT, 2 * before.misfit)
    vanished = not np.any(now.pressed > 0.5)
    return jumped or vanished

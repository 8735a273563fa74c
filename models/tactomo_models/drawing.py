"""The physics' account of what presses: areas of a shape, and a magnitude for each of them.

What was made of a shape serves again while the shape stays as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tactomo_models.areas import AreaFinder, Areas
from tactomo_models.changes import Changes
from tactomo_models.description import Modality
from tactomo_models.forward import ForwardModel
from tactomo_models.magnitudes import MagnitudeFollower, Magnitudes, without_holes
from tactomo_models.outlines import Outlines
from tactomo_models.shape_fit import Shape, ShapeFit

FloatArray = NDArray[np.float64]
Image = NDArray[np.float32]

HOLLOW_MISFIT = 1.1  # of the magnitude channel: enough to ask whether a contact is a ring


@dataclass(frozen=True)
class Drawing:
    """One account of what presses.

    Attributes:
        areas: K pressed areas.
        pressed: (nodes_y, nodes_x) share pressed.
        fitted: their magnitudes; None where there is no area or no magnitude channel.
    """

    areas: Areas
    pressed: FloatArray | Image
    fitted: Magnitudes | None

    def map(self, sign: float) -> FloatArray:
        """|Relative conductivity change| (nodes_y, nodes_x), of areas that change by this sign."""
        if self.fitted is None:
            return np.zeros(self.pressed.shape)
        size = np.maximum(sign * self.fitted.change, 0.0)
        return np.asarray(np.einsum("k,kyx->yx", size, self.areas.on_map))


@dataclass(frozen=True)
class _Shown:
    """What was made of a shape."""

    pressed: FloatArray
    on_map: FloatArray
    areas: Areas
    holes_sought: bool = False


class Drawer:
    """Draws frame after frame; each magnitude is fitted from where the last one ended.

    Args:
        forward: the model of the sheet.
        areas: finds areas on its map.
        fit: what the shapes are fitted by.
    """

    def __init__(self, forward: ForwardModel, areas: AreaFinder, fit: ShapeFit) -> None:
        self._forward, self._areas, self._fit = forward, areas, fit
        self._magnitudes = MagnitudeFollower(forward)
        self._shown: _Shown | None = None

    def forget(self) -> None:
        """Drop what was drawn before."""
        self._magnitudes.forget()
        self._shown = None

    @property
    def has_drawn(self) -> bool:
        """Whether there is a shape that could be drawn again."""
        return self._shown is not None

    def draw(self, shape: Shape, data: Mapping[Modality, Changes], solves: int) -> Drawing:
        """Draw a shape.

        Args:
            shape: fitted to the structure channel.
            data: that channel's changes, and the magnitude channel's if there are any.
            solves: forward solves allowed.
        """
        shown = self._shown_of(shape, data["structure"])
        fitted = self._fit_magnitudes(shown.areas, data, solves)
        if fitted is not None and _may_be_hollow(shown, shape, fitted):
            shown = self._hollowed(shown, shape, data["magnitude"])
            fitted = self._fit_magnitudes(shown.areas, data, 3)
        self._shown = shown
        return Drawing(shown.areas, shown.on_map, fitted)

    def draw_again(self, data: Mapping[Modality, Changes]) -> Drawing:
        """Draw the last shape with magnitudes as they are now."""
        assert self._shown is not None
        areas = self._shown.areas
        return Drawing(areas, self._shown.on_map, self._fit_magnitudes(areas, data, 1))

    def _shown_of(self, shape: Shape, structure: Changes) -> _Shown:
        """What is made of a shape; that of the frame before while it has not moved."""
        if self._shown is not None and self._shown.pressed is shape.pressed:
            return self._shown
        coverage = shape.coverage
        on_map = self._areas.on_map(coverage)
        areas = self._areas.find(np.abs(on_map), np.abs(coverage))
        if len(areas):
            covariance = self._fit.covariance(shape, structure.weight, structure.spread)
            areas = self._areas.with_sigmas(areas, shape, covariance)
        return _Shown(shape.pressed, on_map, areas)

    def _hollowed(self, shown: _Shown, shape: Shape, magnitude: Changes) -> _Shown:
        """The same with the holes of rings taken out."""
        assert isinstance(shape.family, Outlines)
        solid, coverage = shown.areas, shape.family.inner_coverage(shape.parameters)
        inner = self._areas.inner_parts(solid, coverage, self._areas.on_map(coverage))
        change, weight, spread = magnitude.change, magnitude.weight, magnitude.spread
        areas = without_holes(self._forward, solid, inner, change, weight, spread)
        on_map = shown.on_map
        if areas is not solid:
            on_map = on_map - (solid.on_map - areas.on_map).sum(axis=0)
        return replace(shown, areas=areas, on_map=on_map, holes_sought=True)

    def _fit_magnitudes(
        self, areas: Areas, data: Mapping[Modality, Changes], solves: int
    ) -> Magnitudes | None:
        if "magnitude" not in data:
            self._magnitudes.forget()
            return None
        taken = data["magnitude"]
        return self._magnitudes.fit(areas, taken.change, taken.weight, taken.spread, solves=solves)


def _may_be_hollow(shown: _Shown, shape: Shape, fitted: Magnitudes) -> bool:
    """Tell whether to look for rings: once for a shape, where something is unexplained."""
    unasked = not shown.holes_sought and isinstance(shape.family, Outlines)
    return unasked and shape.converged and fitted.misfit > HOLLOW_MISFIT

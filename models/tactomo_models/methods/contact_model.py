"""The physics' account of what presses: areas of a shape, and a magnitude for each of them.

What was made of a shape serves again while the shape stays as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray, Image
from tactomo_models.methods.magnitudes import Magnitudes, WarmStartedMagnitudes, without_holes
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scans.changes import Changes
from tactomo_models.scene.areas import AreaFinder, Areas
from tactomo_models.scene.outlines import Outlines
from tactomo_models.scene.shape_fit import Shape, ShapeFit


@dataclass(frozen=True)
class Account:
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
class _Made:
    """What was made of a shape."""

    pressed: FloatArray
    on_map: FloatArray
    areas: Areas
    holes_sought: bool = False


class ContactModel:
    """Accounts for frame after frame; each magnitude is fitted from where the last one ended.

    Args:
        forward: the model of the sheet.
        areas: finds areas on its map.
        fit: what the shapes are fitted by.
    """

    def __init__(self, forward: ForwardModel, areas: AreaFinder, fit: ShapeFit) -> None:
        self._forward, self._areas, self._fit = forward, areas, fit
        self._magnitudes = WarmStartedMagnitudes(forward)
        self._made: _Made | None = None

    def forget(self) -> None:
        """Drop what was made before."""
        self._magnitudes.forget()
        self._made = None

    @property
    def has_shape(self) -> bool:
        """Whether there is a shape that could serve again."""
        return self._made is not None

    def account(self, shape: Shape, changes: Mapping[Channel, Changes], solves: int) -> Account:
        """Account for a shape.

        Args:
            shape: fitted to the structure channel.
            changes: of that channel, and of the magnitude channel if there are any.
            solves: forward solves allowed.
        """
        made = self._made_of(shape, changes[Channel.STRUCTURE])
        fitted = self._fit_magnitudes(made.areas, changes, solves)
        if fitted is not None and _may_be_hollow(made, shape, fitted):
            made = self._hollowed(made, shape, changes[Channel.MAGNITUDE])
            fitted = self._fit_magnitudes(made.areas, changes, 3)
        self._made = made
        return Account(made.areas, made.on_map, fitted)

    def account_again(self, changes: Mapping[Channel, Changes]) -> Account:
        """The last shape with magnitudes as they are now."""
        assert self._made is not None
        areas = self._made.areas
        return Account(areas, self._made.on_map, self._fit_magnitudes(areas, changes, 1))

    def _made_of(self, shape: Shape, structure: Changes) -> _Made:
        """What is made of a shape; that of the frame before while it has not moved."""
        if self._made is not None and self._made.pressed is shape.pressed:
            return self._made
        coverage = shape.coverage
        on_map = self._areas.on_map(coverage)
        areas = self._areas.find(np.abs(on_map), np.abs(coverage))
        if len(areas):
            covariance = self._fit.covariance(shape, structure)
            areas = self._areas.with_sigmas(areas, shape, covariance)
        return _Made(shape.pressed, on_map, areas)

    def _hollowed(self, made: _Made, shape: Shape, magnitude: Changes) -> _Made:
        """The same with the holes of rings taken out."""
        assert isinstance(shape.family, Outlines)
        solid, coverage = made.areas, shape.family.inner_coverage(shape.parameters)
        inner = self._areas.inner_parts(solid, coverage, self._areas.on_map(coverage))
        areas = without_holes(self._forward, solid, inner, magnitude)
        on_map = made.on_map
        if areas is not solid:
            on_map = on_map - (solid.on_map - areas.on_map).sum(axis=0)
        return replace(made, areas=areas, on_map=on_map, holes_sought=True)

    def _fit_magnitudes(
        self, areas: Areas, changes: Mapping[Channel, Changes], solves: int
    ) -> Magnitudes | None:
        if Channel.MAGNITUDE not in changes:
            self._magnitudes.forget()
            return None
        return self._magnitudes.fit(areas, changes[Channel.MAGNITUDE], solves=solves)


def _may_be_hollow(made: _Made, shape: Shape, fitted: Magnitudes) -> bool:
    """Tell whether to look for rings: once for a shape, where something is unexplained."""
    hollow_misfit = 1.1  # of the magnitude channel: enough to ask whether a contact is a ring
    unasked = not made.holes_sought and isinstance(shape.family, Outlines)
    return unasked and shape.converged and fitted.misfit > hollow_misfit

"""What presses on a skin: indenters and the pressure that they leave on it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tactomo_models.arrays import FloatArray

Shape = Literal["ellipse", "rectangle", "ring"]
Profile = Literal["flat", "dome", "cone"]


@dataclass(frozen=True)
class Press:
    """One indenter of a shape and size, and the pressure under it."""

    #: x_m, y_m: its centre
    x_m: float
    y_m: float
    pressure_kpa: float  #: pressure under it; the largest, of a dome
    radius_m: float = 0.015  #: half its width along its own x axis
    radius_y_m: float | None = None  #: half its width along its own y axis; `radius_m` if None
    angle_rad: float = 0.0  #: turned by this, counter-clockwise
    #: an ellipse, a rectangle, or a ring (an ellipse with its inner half left out)
    shape: Shape = "ellipse"
    #: "flat", a punch that presses evenly, or "dome", a ball whose pressure falls to nothing at the
    #: rim (Hertz) of the ellipse or of the ellipse around a rectangle; a "cone"'s falls evenly
    profile: Profile = "flat"

    def pressure_at(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray | float:
        """Pressure in kPa at points that the indenter covers, same shape."""
        if self.profile == "flat":
            return self.pressure_kpa
        u, v = self._own_axes(x_m, y_m)
        rho = np.hypot(u / self.radius_m, v / (self.radius_y_m or self.radius_m))
        left = 1 - rho if self.profile == "cone" else np.sqrt(np.maximum(1 - rho**2, 0.0))
        return np.asarray(self.pressure_kpa * np.maximum(left, 0.0))

    def _own_axes(self, x_m: FloatArray, y_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        cos, sin = np.cos(self.angle_rad), np.sin(self.angle_rad)
        dx, dy = x_m - self.x_m, y_m - self.y_m
        return cos * dx + sin * dy, -sin * dx + cos * dy

    def coverage(self, x_m: FloatArray, y_m: FloatArray, edge_m: float) -> FloatArray:
        """Share of the neighbourhood of each point that the indenter covers, 0 to 1, same shape.

        Args:
            x_m: coordinates of the points.
            y_m: coordinates of the points.
            edge_m: width over which the share falls from 1 to 0 across the outline: the distance
                of the points, so that area is kept whatever the grid.
        """
        u, v = self._own_axes(x_m, y_m)
        a, b = self.radius_m, self.radius_y_m or self.radius_m
        if self.shape == "rectangle":
            outside = np.maximum(np.abs(u) - a, np.abs(v) - b)
        else:
            outside = _ellipse_distance(u, v, a, b)
            if self.shape == "ring":
                outside = np.maximum(outside, -_ellipse_distance(u, v, a / 2, b / 2))
        return np.asarray(np.clip(0.5 - outside / edge_m, 0.0, 1.0))


def _ellipse_distance(u: FloatArray, v: FloatArray, a: float, b: float) -> FloatArray:
    """Signed distance to an ellipse, first order near its outline and exact for a circle."""
    scaled = np.hypot(u / a, v / b)
    slope = np.hypot(u / a**2, v / b**2)
    middle = slope < 1e-12
    distance = scaled * (scaled - 1) / np.where(middle, 1.0, slope)
    return np.asarray(np.where(middle, -min(a, b), distance))


def strongest(
    presses: Iterable[Press], x_m: FloatArray, y_m: FloatArray, edge_m: float
) -> tuple[FloatArray, FloatArray]:
    """Pressure in kPa and coverage at each point, by the strongest indenter that covers it."""
    pressure, coverage = np.zeros_like(x_m), np.zeros_like(x_m)
    for press in presses:
        covered = press.coverage(x_m, y_m, edge_m)
        own = press.pressure_at(x_m, y_m)
        wins = covered * own > coverage * pressure
        pressure = np.where(wins, own, pressure)
        coverage = np.where(wins, covered, coverage)
    return pressure, coverage

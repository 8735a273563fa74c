"""Surfaces that carry a sheet, as the text of an OBJ file."""

from __future__ import annotations

import numpy as np


def bent_obj(
    width_m: float,
    height_m: float,
    radius_m: float,
    cells: int = 12,
    *,
    stretch: float = 1.0,
    unit: float = 1.0,  # of the vertices, in metres
    texture: str = "vt {x:.6f} {y:.6f}",
) -> str:
    """A sheet that is bent around the link's z axis, its middle at x = radius."""
    lines = []
    for y in np.linspace(-height_m / 2, height_m / 2, cells + 1):
        for x in np.linspace(-width_m / 2, width_m / 2, cells + 1):
            angle = stretch * x / radius_m
            point = np.array([radius_m * np.cos(angle), radius_m * np.sin(angle), y]) / unit
            lines.append(f"v {point[0]:.6f} {point[1]:.6f} {point[2]:.6f}")
            lines.append(texture.format(x=x, y=y, u=x / width_m + 0.5, v=y / height_m + 0.5))
    for row in range(cells):
        for column in range(cells):
            number = row * (cells + 1) + column + 1
            corners = (number, number + 1, number + cells + 2, number + cells + 1)
            lines.append("f " + " ".join(f"{n}/{n}" if texture else f"{n}" for n in corners))
    return "\n".join(lines) + "\n"

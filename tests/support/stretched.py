"""Sensors on surfaces that stretch them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from tactomo_models import SensorDescription
from variants import variant

Point = tuple[float, float, float]


def on_surface(
    sensor: SensorDescription, lift: Callable[[float, float], Point], cells: int = 16
) -> SensorDescription:
    """The same sensor on a surface that has a point for each place on the sheet."""
    lines = []
    for y in np.linspace(-0.51, 0.51, cells + 1) * sensor.height_m:
        for x in np.linspace(-0.51, 0.51, cells + 1) * sensor.width_m:
            lines.append("v {:.9f} {:.9f} {:.9f}".format(*lift(x, y)))
            lines.append(f"vt {x:.9f} {y:.9f}")
    for row in range(cells):
        for column in range(cells):
            first = row * (cells + 1) + column + 1
            corners = first, first + 1, first + cells + 2, first + cells + 1
            lines.append("f " + " ".join(f"{n}/{n}" for n in corners))
    mount = {"frame": "arm", "surface": {"obj": "\n".join(lines)}}
    return variant(sensor, mount=mount).model_copy(update={"name": "stretched"})


def along(x_times: float, y_times: float) -> Callable[[float, float], Point]:
    return lambda x, y: (x_times * x, y_times * y, 0.0)

"""How a frame looks where there is no page to draw it (a terminal, Foxglove): colours and words.

`map_pixels` colours the map, `pressure_words` and `force_words` say how hard a contact is pressed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactomo_client.schema import Companion, Contact, Frame

# Dark to bright, as perceived brightness: black, violet, red, orange, yellow, white.
COLOURS: Final = ((0, 0, 4), (87, 16, 110), (188, 55, 84), (249, 142, 9), (252, 255, 164))
PRESSED_COLOUR: Final = (40, 60, 90)
UNKNOWN_COLOUR: Final = (30, 30, 30)

COMPANION_STATES: Final = {
    "disputed": "not used: it contradicts the sheets",
    "late": "not used: of before the sheets last moved",
    "missing": "no reading within its limits",
    "unused": "not needed: nothing presses, or the method takes none",
}
"""What became of a companion, in words; `fitted` says so itself."""
DEFAULT_PRESSURE_MAX_KPA: Final = 300.0
DEFAULT_MAGNITUDE_MAX: Final = 0.25


def map_pixels(frame: Frame, description: Mapping[str, Any]) -> NDArray[np.uint8] | None:
    """Return the colours of the map's nodes (ny, nx, 3), row 0 at the bottom; None without a map.

    Colour is pressure, or the relative change where the sensor has no pressure calibration, or how
    surely a node is pressed. What is pressed without a value is blue-grey.

    Args:
        frame: a frame with images.
        description: the sensor, as `status` has it; may be empty.
    """
    shown = shown_image(frame, description)
    if shown is None:
        return None
    image, top = shown
    level = np.nan_to_num(image) / top
    pixels = colours(level)
    if frame.structure is not None:
        pressed = (np.nan_to_num(frame.structure) > 0.5) & (level < 0.0125)
        pixels[pressed] = PRESSED_COLOUR
    pixels[~known_nodes(frame, image)] = UNKNOWN_COLOUR
    return pixels.astype(np.uint8)


def colours(level: NDArray[Any]) -> NDArray[np.float64]:
    """Return the colours (..., 3), 0 to 255, of shares of a scale's top."""
    knots, palette = np.linspace(0.0, 1.0, len(COLOURS)), np.array(COLOURS, dtype=float)
    return np.stack([np.interp(level, knots, channel) for channel in palette.T], axis=-1)


def companion_words(companion: Companion) -> str:
    """Return what a companion reads, and whether it is believed."""
    believed = COMPANION_STATES.get(companion.state, companion.state)
    reading, force_n, sigma_n = companion.reading, companion.force_n, companion.force_sigma_n
    if reading is None or force_n is None or sigma_n is None:
        return believed
    return f"reads {reading:g}: {force_n:z.1f} ± {sigma_n:.1f} N, {believed}"


def shown_image(
    frame: Frame, description: Mapping[str, Any]
) -> tuple[NDArray[np.float32], float] | None:
    """Return the image that says most about how hard is pressed, and the top of its scale."""
    if frame.pressure_kpa is not None:
        top = description.get("pressure_max_kpa") or DEFAULT_PRESSURE_MAX_KPA
        return frame.pressure_kpa, top
    if frame.map is not None:
        return frame.map, description.get("magnitude_max") or DEFAULT_MAGNITUDE_MAX
    return None if frame.structure is None else (frame.structure, 1.0)


def known_nodes(frame: Frame, image: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which nodes are on the sheet at all: those outside a round one are not."""
    return ~np.isnan(image if frame.structure is None else frame.structure)


def pressure_words(contact: Contact) -> str:
    """Return the contact's pressure, as far as it is known."""
    if contact.pressure_kpa is not None:
        return _measured(contact, contact.pressure_kpa, contact.pressure_sigma_kpa, "kPa")
    if contact.max_kpa is not None:
        return f"at most {contact.max_kpa:.0f} kPa"
    if contact.pressure_range == "below":
        return "touched, pressure unknown"
    return "pressed" if contact.magnitude is None else f"Δσ/σ₀ {contact.magnitude:.3f}"


def force_words(contact: Contact, before: str = "") -> str:
    """Return the contact's force, with `before` before it; empty where it is not known."""
    if contact.force_n is None:
        return ""
    return before + _measured(contact, contact.force_n, contact.force_sigma_n, "N")


def _measured(contact: Contact, value: float, sigma: float | None, unit: str) -> str:
    if contact.pressure_range == "above":
        return f"≥ {value:.0f} {unit}"
    return f"{value:.0f}{'' if sigma is None else f' ± {sigma:.0f}'} {unit}"


def surface_points(
    surface_m: Sequence[Sequence[Sequence[float]]],
    x_share: NDArray[np.float64],
    y_share: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return where on a mounted sheet's surface places are, linear between the status's points.

    Args:
        surface_m: of a status's ``description.mount``, (rows, columns, 3).
        x_share: how far from the left edge to the right one, 0 to 1; any shape.
        y_share: how far from the bottom to the top, likewise.

    Returns:
        Points in the frame of the mount's link, metres: that shape and 3.
    """
    points = np.asarray(surface_m, dtype=float)
    rows, columns, _ = points.shape
    along_y, along_x = y_share * (rows - 1), x_share * (columns - 1)
    row = np.clip(along_y.astype(int), 0, rows - 2)
    column = np.clip(along_x.astype(int), 0, columns - 2)
    up, right = (along_y - row)[..., None], (along_x - column)[..., None]
    below = points[row, column] * (1 - right) + points[row, column + 1] * right
    above = points[row + 1, column] * (1 - right) + points[row + 1, column + 1] * right
    return np.asarray(below * (1 - up) + above * up)


def surface_nodes(
    surface_m: Sequence[Sequence[Sequence[float]]], shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """Return where a map's nodes are on a mounted sheet's surface: (ny, nx, 3), metres."""
    rows, columns = (np.linspace(0.0, 1.0, count) for count in shape)
    return surface_points(surface_m, *np.meshgrid(rows, columns, indexing="ij")[::-1])


def towards(normal: Sequence[float]) -> tuple[float, float, float, float]:
    """Return the shortest rotation that turns z into a unit vector: (x, y, z, w)."""
    x, y, z = normal
    length = math.hypot(x, y, 1.0 + z)
    if length < 1e-9:  # straight down: about x, as well as about any other
        return 1.0, 0.0, 0.0, 0.0
    return -y / length, x / length, 0.0, (1.0 + z) / length

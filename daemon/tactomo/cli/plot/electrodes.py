"""A sensor as its pictures show it: its outline, and electrodes as bars or discs, with numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from tactomo_models import SensorDescription
    from tactomo_models.arrays import FloatArray


def outline_path(description: SensorDescription, inset_m: float = 0.0) -> Any:
    """Return the sheet's outline and holes, so far within, as matplotlib's path in millimetres."""
    from matplotlib.path import Path

    rings = description.sheet.outline.drawn(inset_m)
    closed = [Path(1e3 * np.vstack([ring, ring[:1]]), closed=True) for ring in rings]
    return Path.make_compound_path(*closed)


def outwards(description: SensorDescription) -> FloatArray:
    """Unit vectors (electrodes, 2) that point off the sheet; up from a pad."""
    along = np.diff(description.electrode_ends_m, axis=1)[:, 0]
    out = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.linalg.norm(along, axis=1)[:, None]
    out[~np.isnan(description.pad_radii_m)] = 0.0, 1.0
    return np.asarray(out)


def draw_electrodes(
    axes: Axes,  # in millimetres
    description: SensorDescription,
    gap_mm: float,  # from an electrode's rim to the middle of its number
    first: dict[str, Any] | None = None,  # how the number 0 is written; as the others if None
    **style: Any,  # how numbers are written
) -> None:
    """Draw a sensor's electrodes, each with its number outside the sheet, or above a pad."""
    from matplotlib.patches import Circle

    out, radii_mm = outwards(description), 1e3 * description.pad_radii_m
    for number, (begin, end) in enumerate(1e3 * description.electrode_ends_m):
        middle, radius = (begin + end) / 2, radii_mm[number]
        if np.isnan(radius):
            axes.plot(
                *zip(begin, end, strict=True),
                color="black",
                linewidth=4,
                solid_capstyle="butt",
                zorder=5,
                clip_on=False,
            )
        else:
            axes.add_patch(Circle(middle, radius, color="black"))
        at = middle + (gap_mm + np.nan_to_num(radius)) * out[number]
        written = style | (first or {} if number == 0 else {})
        axes.text(at[0], at[1], str(number), ha="center", va="center", **written)

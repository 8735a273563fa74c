"""Pictures of `tactomo models simulate`: what networks are trained on."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactomo.cli.plot import save_figure

if TYPE_CHECKING:
    from tactomo_models import SensorDescription

ROWS, COLUMNS = 3, 4  # of scenes, each a pair of images


def draw_scenes(
    scenes: dict[str, Any], description: SensorDescription, title: str, output: Path
) -> None:
    """Draw the truth of the first scenes of a set: magnitude above, pressed area below.

    Args:
        scenes: as `read_scenes` returns them.
        description: the sensor.
        title: above the picture.
        output: the picture to write.

    Raises:
        TactomoError: the picture cannot be written.
    """
    from matplotlib.figure import Figure

    maps = scenes["map"][: ROWS * COLUMNS].astype(np.float32)
    pressed = scenes["pressed"][: ROWS * COLUMNS].astype(np.float32)
    x, y = description.map_x_m * 1e3, description.map_y_m * 1e3
    rows = -(-len(maps) // COLUMNS)
    figure = Figure(figsize=(2.3 * COLUMNS, 1.8 + 4.4 * rows), layout="constrained")
    figure.suptitle(f"{title}: number in the set, contacts, σ of the magnitude channel")
    grid: Any = figure.subplots(2 * rows, COLUMNS, sharex=True, sharey=True, squeeze=False)
    kinds = (
        (maps, float(maps.max()) or 1.0, "viridis", "upper rows: |Δσ|/σ₀, magnitude channel"),
        (pressed, 1.0, "gray", "lower rows: pressed, share of the structure channel's change"),
    )
    for row, (images, highest, colours, label) in enumerate(kinds):
        for number, image in enumerate(images):
            axes = grid[2 * (number // COLUMNS) + row, number % COLUMNS]
            shown = axes.imshow(
                image,
                origin="lower",
                extent=(x[0], x[-1], y[0], y[-1]),
                vmin=0,
                vmax=highest,
                cmap=colours,
            )
            if row == 0:
                sign = "falls" if _falls(description, scenes["opposite"][number]) else "rises"
                count = int(scenes["contacts"][number])
                plural = "" if count == 1 else "s"
                axes.set_title(f"{number}: {count} contact{plural}, σ {sign}", fontsize=9)
        figure.colorbar(shown, ax=grid, label=label, location="bottom", aspect=40, pad=0.02)
    for axes in grid.flat:
        axes.set_visible(bool(axes.images))
    for axes in grid[:, 0]:
        axes.set_ylabel("y (mm)")
    for axes in grid[2 * rows - 1]:
        axes.set_xlabel("x (mm)")
    save_figure(figure, output)


def _falls(description: SensorDescription, opposite: bool) -> bool:
    assert description.magnitude is not None
    return bool((description.magnitude.response.sign < 0) != opposite)

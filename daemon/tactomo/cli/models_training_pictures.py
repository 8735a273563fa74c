"""Pictures of `tactomo models simulate` and `train`: scenes to learn from, and how that went."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactomo.cli.plot import save_figure

if TYPE_CHECKING:
    from tactomo_models import SensorDescription
    from tactomo_models.training.train import Epoch

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


def draw_curves(history: Sequence[Epoch], title: str, output: Path) -> None:
    """Draw the loss, and the correlation with the truth on held-out scenes, epoch by epoch.

    Raises:
        TactomoError: the picture cannot be written.
    """
    from matplotlib.figure import Figure

    epochs = range(1, len(history) + 1)
    noises = [*by_noise(history[-1].held_out)] if history else []
    figure = Figure(figsize=(4 * (1 + len(noises)), 3.6), layout="constrained")
    figure.suptitle(title)
    axes: Any = figure.subplots(1, 1 + len(noises), squeeze=False)[0]
    axes[0].plot(epochs, [epoch.loss for epoch in history], ".-")
    axes[0].set(xlabel="epoch", ylabel="loss", yscale="log", title="training scenes")
    for panel, noise in zip(axes[1:], noises, strict=True):
        curves: dict[str, list[float]] = {}
        for epoch in history:
            for contacts, icc in by_noise(epoch.held_out)[noise]:
                curves.setdefault(contacts, []).append(icc)
        for contacts, values in curves.items():
            name = f"{contacts} contact(s)" if contacts.isdigit() else contacts
            panel.plot(epochs, values, ".-", label=f"{name}: {values[-1]:.3f}")
        panel.set(xlabel="epoch", ylabel="ICC of the map", title=f"held-out scenes, {noise}")
        panel.legend(fontsize=8, loc="lower right")
        panel.grid(alpha=0.3)
    for panel in axes:
        panel.xaxis.get_major_locator().set_params(integer=True)
    save_figure(figure, output)


def by_noise(held_out: Mapping[str, float]) -> dict[str, list[tuple[str, float]]]:
    """Measures named "40 dB, 2" as pairs of the number of contacts and the value, by noise."""
    found: dict[str, list[tuple[str, float]]] = {}
    for name, value in held_out.items():
        noise, _, contacts = name.rpartition(", ")
        found.setdefault(noise, []).append((contacts, value))
    return found

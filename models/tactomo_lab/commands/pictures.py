"""Pictures of `tactomo evaluate`: truth beside what was made of it."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tactomo.cli.plot.plot import save_figure
from tactomo_models import SensorDescription

from tactomo_lab.evaluation.play import Outcome
from tactomo_lab.scenes.measures import Score, mean

ROWS = 4  # scenes of each kind
CHANGE = "|Δσ|/σ₀"
DPI = 120  # legible at a page's width, and below 300 kB


def draw_outcomes(outcomes: Sequence[Outcome], output: Path) -> None:
    """Draw the worst scenes and those in the middle: true and found magnitude and shape.

    Raises TactomoError where the picture cannot be written.
    """
    from matplotlib.figure import Figure

    by_icc = sorted(outcomes, key=lambda outcome: outcome.score.icc)
    middle = max(ROWS, (len(by_icc) - ROWS) // 2)  # none of the worst once more
    kinds = {
        "the worst": by_icc[:ROWS],
        f"in the middle of {len(by_icc)}": by_icc[middle : middle + ROWS],
    }
    kinds = {kind: chosen for kind, chosen in kinds.items() if chosen}
    size = (8.5 * len(kinds), 2.3 * min(ROWS, len(by_icc)) + 0.5)
    figure = Figure(figsize=size, layout="constrained")
    halves: Any = figure.subfigures(1, len(kinds), squeeze=False)[0]
    sensor = outcomes[0].case.description
    size_mm = " × ".join(f"{np.ptp(m) * 1e3:.0f}" for m in (sensor.map_x_m, sensor.map_y_m))
    for half, (kind, chosen) in zip(halves, kinds.items(), strict=True):
        half.suptitle(f"{kind} (maps of {size_mm} mm)")
        grid = half.subplots(len(chosen), 4, squeeze=False)
        for axes, outcome in zip(grid, chosen, strict=True):
            _draw_outcome(axes, outcome)
    save_figure(figure, output, dpi=DPI)


def _draw_outcome(axes: Any, outcome: Outcome) -> None:
    score, truth, frame = outcome.score, outcome.case.truth_of(outcome.frame), outcome.made
    top = max(truth.map.max(), 0.0 if frame.map is None else float(frame.map.max()))
    sensor = outcome.case.description
    images = (
        (truth.map, top, f"{score.scene}, {score.snr_db:g} dB\ntrue {CHANGE}"),
        (frame.map, top, f"found {CHANGE}, + centres\ncorrelation {score.icc:.3f}"),
        (truth.pressed, 1.0, f"{score.shape}, contrast {score.contrast:.0f}\ntrue shape"),
        (frame.structure, 1.0, f"found shape\ncorrelation {score.icc_structure:.3f}"),
    )
    for panel, (image, highest, title) in zip(axes, images, strict=True):
        panel.set_title(title, fontsize=8)
        drawn = _show(panel, image, sensor, highest)
        if panel in (axes[1], axes[2]):  # of the truth beside it, too
            bar = axes[0].figure.colorbar(drawn, ax=panel, shrink=0.8, pad=0.02)
            bar.ax.tick_params(labelsize=6)
            bar.set_label(CHANGE if panel is axes[1] else "share pressed", fontsize=7)
    for contact in frame.contacts:
        axes[1].plot(contact.x_m * 1e3, contact.y_m * 1e3, "r+", markersize=6)
    axes[2].set_xlabel("\n".join(score.flags), fontsize=6, color="tab:red")


def draw_overview(
    by_line: dict[str, dict[str, list[Score]]],  # scores of each line by each method
    methods: Sequence[str],
    output: Path,
) -> None:
    """Draw lines by methods: mean ICC as colour, and how many bad maps nothing warned of.

    Raises TactomoError where the picture cannot be written.
    """
    from matplotlib.figure import Figure

    of_all = {one: [s for row in by_line.values() for s in row.get(one, ())] for one in methods}
    rows = [[row.get(one, []) for one in methods] for row in (*by_line.values(), of_all)]
    icc = np.array([[mean(s.likeness for s in scores) for scores in row] for row in rows])
    size = (2.8 + 1.05 * len(methods), 1.9 + 0.3 * len(rows))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(icc, vmin=0, vmax=1, cmap="viridis", aspect="auto")
    axes.set_xticks(range(len(methods)), methods, rotation=30, ha="left", rotation_mode="anchor")
    axes.set_yticks(range(len(rows)), [*by_line, "all"])
    axes.tick_params(top=True, bottom=False, labeltop=True, labelbottom=False, length=0)
    axes.axhline(len(rows) - 1.5, color="white", linewidth=3)
    for row, of_methods in enumerate(rows):
        for column, scores in enumerate(of_methods):
            ink = "black" if icc[row, column] > 0.6 else "white"
            icc_shown = f"{icc[row, column]:.2f}" if scores else ""
            axes.text(column - 0.44, row, icc_shown, va="center", fontsize=8, color=ink)
            if silent := sum(one.bad and not one.warned for one in scores):
                red = {"facecolor": "tab:red", "edgecolor": "none", "pad": 1.5}
                words = axes.text(column + 0.44, row, f"{silent}/{len(scores)}", va="center")
                words.set(ha="right", fontsize=8, color="white", bbox=red)
    figure.colorbar(image, ax=axes, label="mean ICC with the truth", aspect=30)
    legend = (
        "Red: maps with an ICC below 0.7 that no flag told to distrust, of all maps. "
        "Blank: not for this sensor. Simulated."
    )
    figure.supxlabel(textwrap.fill(legend, int(13 * size[0])), fontsize=8)
    save_figure(figure, output, dpi=DPI)


def _show(panel: Any, image: NDArray[Any] | None, sensor: SensorDescription, highest: float) -> Any:
    """Draw an image in millimetres, nothing where there is none; what a colour bar is made of."""
    x, y = sensor.map_x_m * 1e3, sensor.map_y_m * 1e3
    shown = np.full((len(y), len(x)), np.nan) if image is None else image
    panel.set(xticks=[], yticks=[], aspect="equal")
    return panel.imshow(
        shown, origin="lower", extent=(x[0], x[-1], y[0], y[-1]), vmin=0, vmax=highest
    )

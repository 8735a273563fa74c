"""Pictures of `tactomo evaluate`: truth beside what was made of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactomo.cli.plot.plot import save_figure

if TYPE_CHECKING:
    from tactomo_lab.evaluation.still import Outcome

ROWS = 4  # scenes of each kind


def draw_outcomes(outcomes: Sequence[Outcome], output: Path) -> None:
    """Draw the worst scenes and those in the middle: true and found magnitude and shape.

    Raises:
        TactomoError: the picture cannot be written.
    """
    from matplotlib.figure import Figure

    by_icc = sorted(outcomes, key=lambda outcome: outcome.score.icc)
    middle = max(0, (len(by_icc) - ROWS) // 2)
    kinds = {"worst": by_icc[:ROWS], "in the middle": by_icc[middle : middle + ROWS]}
    figure = Figure(figsize=(15, 2.3 * min(ROWS, len(by_icc))), layout="constrained")
    halves: Any = figure.subfigures(1, len(kinds))
    for half, (kind, chosen) in zip(halves, kinds.items(), strict=True):
        half.suptitle(kind)
        grid = half.subplots(len(chosen), 4, squeeze=False)
        for axes, outcome in zip(grid, chosen, strict=True):
            _draw_outcome(axes, outcome)
    save_figure(figure, output)


def _draw_outcome(axes: Any, outcome: Outcome) -> None:
    score, truth, frame = outcome.score, outcome.scene.truth, outcome.frame
    top = max(truth.map.max(), 0.0 if frame.map is None else float(frame.map.max()))
    sensor = outcome.scene.description
    x, y = sensor.map_x_m * 1e3, sensor.map_y_m * 1e3
    images = (
        (truth.map, top, f"truth |Δσ|/σ₀: {score.scene}, {score.snr_db:g} dB"),
        (frame.map, top, f"found, + centres: ICC {score.icc:.2f}"),
        (truth.pressed, 1.0, f"true shape: {score.shape}, contrast {score.contrast:.0f}"),
        (frame.structure, 1.0, f"found: ICC {score.icc_structure:.2f}"),
    )
    for panel, (image, highest, title) in zip(axes, images, strict=True):
        panel.set_title(title, fontsize=8)
        panel.set(xticks=[], yticks=[], aspect="equal")
        panel.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
        if image is not None:
            panel.imshow(
                image, origin="lower", extent=(x[0], x[-1], y[0], y[-1]), vmin=0, vmax=highest
            )
    for contact in frame.contacts:
        axes[1].plot(contact.x_m * 1e3, contact.y_m * 1e3, "r+", markersize=6)
    axes[3].set_xlabel(", ".join(score.flags), fontsize=6, color="tab:red")

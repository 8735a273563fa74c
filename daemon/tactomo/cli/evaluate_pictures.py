"""Pictures of `tactomo evaluate`: truth beside what was made of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactomo.cli.plot import save_figure

if TYPE_CHECKING:
    from tactomo_models.evaluation.moving import FrameScore
    from tactomo_models.evaluation.still import Outcome

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


def draw_traces(played: Sequence[Sequence[FrameScore]], output: Path) -> None:
    """Draw how each moving scene was followed: ICC, contacts and time over its frames.

    Raises:
        TactomoError: the picture cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 4.5 * len(played)), layout="constrained")
    for part, scores in zip(figure.subfigures(len(played), 1, squeeze=False), played, strict=True):
        _draw_trace(part[0], scores)
    save_figure(figure, output)


def _draw_trace(figure: Any, scores: Sequence[FrameScore]) -> None:
    rows = figure.subplots(3, 1, sharex=True, height_ratios=(2, 1, 1))
    frames = range(len(scores))
    rows[0].plot(frames, [score.icc for score in scores], label="map")
    rows[0].plot(frames, [score.icc_structure for score in scores], "--", label="shape")
    rows[0].set(ylim=(0, 1), ylabel="ICC")
    rows[1].step(frames, [score.contacts for score in scores], "k:", where="mid", label="true")
    rows[1].step(frames, [score.found for score in scores], where="mid", label="found")
    rows[1].set_ylabel("contacts")
    rows[2].plot(frames, [score.seconds * 1e3 for score in scores])
    rows[2].set(ylabel="ms", xlabel="frame")
    for frame, score in enumerate(scores):
        colour = "tab:red" if score.confidently_wrong else "0.8" if score.distrusted else None
        if colour:
            rows[0].axvspan(frame - 0.5, frame + 0.5, color=colour, linewidth=0, alpha=0.5)
        if frame == 0 or score.phase != scores[frame - 1].phase:
            rows[0].text(frame, 1.02, score.phase, fontsize=8, rotation=15)
            for axes in rows:
                axes.axvline(frame - 0.5, color="0.6", linewidth=0.5)
    rows[0].plot([], [], color="0.8", linewidth=6, label="flagged")
    rows[0].plot([], [], color="tab:red", linewidth=6, alpha=0.5, label="wrong, not flagged")
    for axes in rows[:2]:
        axes.legend(fontsize=7, loc="lower left", ncols=4)

"""Pictures of `tactomo evaluate stability`: every method's worst case, and an overview of all."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactomo.cli.plot import save_figure

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from tactomo_models.evaluation.stability import CaseScore, Outcome

PANEL_INCHES = 1.9
NOTE_INCHES = 1.1
BAR_INCHES = 1.3


def draw_worst(outcomes: Sequence[Outcome], output: Path) -> None:
    """Draw one regime: of each method the case with the lowest ICC, truth above, map below.

    The magnitude map; where nothing presses hard enough to show in it, the pressed shape.

    Raises:
        TactomoError: the picture cannot be written.
    """
    from matplotlib.figure import Figure
    from tactomo_models.evaluation.regimes import REGIMES

    worst: dict[str, Outcome] = {}
    for one in sorted(outcomes, key=lambda one: one.score.icc):
        worst.setdefault(one.score.method, one)
    methods = dict.fromkeys(one.score.method for one in outcomes)
    chosen = [worst[method] for method in methods]
    shape = not any(one.case.truth.map.any() for one in outcomes)
    top = max(float(_images(one, shape=shape)[0].max()) for one in chosen) or 1.0
    width = PANEL_INCHES * len(chosen) + BAR_INCHES
    figure = Figure(figsize=(width, 2 * PANEL_INCHES + NOTE_INCHES + 1.0), layout="constrained")
    regime = outcomes[0].score.regime
    title = f"{regime}: {REGIMES[regime].what} Each method's worst case, simulated."
    figure.suptitle(textwrap.fill(title, int(13 * width)), fontsize=10)
    grid = figure.subplots(
        3, len(chosen), squeeze=False, height_ratios=(PANEL_INCHES, PANEL_INCHES, NOTE_INCHES)
    )
    for axes, one in zip(grid.T, chosen, strict=True):
        _draw_outcome(axes, one, _images(one, shape=shape), top)
    for panel in grid[:2, 1:].ravel():
        panel.tick_params(labelleft=False)
    grid[0, 0].set_ylabel("truth\ny (mm)", fontsize=9)
    grid[1, 0].set_ylabel("found, + contacts\ny (mm)", fontsize=9)
    label = "pressed: 0 bare to 1 saturated" if shape else "|Δσ|/σ₀ of the magnitude channel"
    panels = grid[:2].ravel().tolist()
    bar = figure.colorbar(grid[0, 0].images[0], ax=panels, label=label, extend="max", shrink=0.8)
    bar.ax.tick_params(labelsize=8)
    save_figure(figure, output)


def _images(one: Outcome, *, shape: bool) -> tuple[NDArray[Any], NDArray[Any] | None]:
    truth, frame = one.case.truth, one.frame
    return (truth.pressed, frame.structure) if shape else (truth.map, frame.map)


def _draw_outcome(
    axes: Any, one: Outcome, images: tuple[NDArray[Any], NDArray[Any] | None], top: float
) -> None:
    sensor = one.case.description
    extent = [float(x * 1e3) for axis in (sensor.map_x_m, sensor.map_y_m) for x in axis[[0, -1]]]
    for panel, image in zip(axes, images, strict=False):
        panel.set(xlim=extent[:2], ylim=extent[2:], aspect="equal")
        panel.tick_params(labelsize=7)
        if image is None:
            panel.text(0.5, 0.5, "no map", ha="center", transform=panel.transAxes)
        else:
            panel.imshow(image, origin="lower", extent=extent, vmin=0, vmax=top)
    for contact in one.frame.contacts:
        axes[1].plot(contact.x_m * 1e3, contact.y_m * 1e3, "r+", markersize=6)
    axes[0].set_title(f"{one.score.method}\n{one.score.case}", fontsize=9)
    axes[1].set_title(_verdict(one.score), fontsize=9, color=_colour(one.score))
    axes[1].set_xlabel("x (mm)", fontsize=8)
    axes[2].axis("off")
    axes[2].text(0, 1, _note(one.score), va="top", fontsize=7, transform=axes[2].transAxes)


def _verdict(score: CaseScore) -> str:
    if score.bad:
        return f"ICC {score.icc:.2f}: bad,\n{'warned' if score.warned else 'no warning'}"
    return f"ICC {score.icc:.2f}: good,\n{'but warned' if score.warned else 'no warning'}"


def _colour(score: CaseScore) -> str:
    """Red where a bad map passes for a good one, orange where a good one passes for bad."""
    if score.bad == score.warned:
        return "black"
    return "tab:red" if score.bad else "tab:orange"


def _note(score: CaseScore) -> str:
    flags = f"flags: {', '.join(score.flags) or 'none'}"
    parts = [flags, f"{score.tier}: {score.reason}"]
    if np.isfinite(score.misfit):
        parts.append(f"misfit {score.misfit:.1f}")
    if np.isfinite(score.confidence):
        parts.append(f"confidence {score.confidence:.2f}")
    return "\n".join(textwrap.fill(part, 27) for part in parts)


def draw_overview(scores: Sequence[CaseScore], output: Path) -> None:
    """Draw regimes by methods: mean ICC as colour, and how many bad maps nothing warned of.

    Raises:
        TactomoError: the picture cannot be written.
    """
    from matplotlib.figure import Figure
    from tactomo_models.evaluation.stability import trust_by_regime

    rows = trust_by_regime(scores)
    methods = list(rows["all"])
    icc = np.array([[counts.icc for counts in row.values()] for row in rows.values()])
    size = (2.8 + 1.05 * len(methods), 1.9 + 0.3 * len(rows))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(icc, vmin=0, vmax=1, cmap="viridis", aspect="auto")
    axes.set_xticks(range(len(methods)), methods, rotation=30, ha="left", rotation_mode="anchor")
    axes.set_yticks(range(len(rows)), list(rows))
    axes.tick_params(top=True, bottom=False, labeltop=True, labelbottom=False, length=0)
    axes.axhline(len(rows) - 1.5, color="white", linewidth=3)
    for row, by_method in enumerate(rows.values()):
        for column, counts in enumerate(by_method.values()):
            ink = "black" if counts.icc > 0.6 else "white"
            axes.text(column - 0.44, row, f"{counts.icc:.2f}", va="center", fontsize=8, color=ink)
            if counts.bad_unwarned:
                _mark(axes, column + 0.44, row, f"{counts.bad_unwarned}/{counts.maps}")
    figure.colorbar(image, ax=axes, label="mean ICC with the truth", aspect=30)
    legend = (
        "Red: maps with an ICC below 0.7 that no flag told to distrust, of all maps. Simulated."
    )
    figure.supxlabel(textwrap.fill(legend, int(13 * size[0])), fontsize=8)
    save_figure(figure, output)


def _mark(axes: Any, x: float, y: float, words: str) -> None:
    box = {"facecolor": "tab:red", "edgecolor": "none", "pad": 1.5}
    axes.text(x, y, words, va="center", ha="right", fontsize=8, color="white", bbox=box)

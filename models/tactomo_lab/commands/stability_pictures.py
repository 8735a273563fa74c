"""The picture of `tactomo evaluate stability`: regimes by methods."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tactomo.cli.plot.plot import save_figure

from tactomo_lab.commands.pictures import DPI

if TYPE_CHECKING:
    from tactomo_lab.evaluation.stability import CaseScore


def draw_overview(scores: Sequence[CaseScore], output: Path) -> None:
    """Draw regimes by methods: mean ICC as colour, and how many bad maps nothing warned of.

    Raises TactomoError where the picture cannot be written.
    """
    from matplotlib.figure import Figure

    from tactomo_lab.evaluation.stability import trust_by_regime

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
            icc_shown = f"{counts.icc:.2f}" if counts.maps else ""
            axes.text(column - 0.44, row, icc_shown, va="center", fontsize=8, color=ink)
            if counts.bad_unwarned:
                _mark(axes, column + 0.44, row, f"{counts.bad_unwarned}/{counts.maps}")
    figure.colorbar(image, ax=axes, label="mean ICC with the truth", aspect=30)
    legend = (
        "Red: maps with an ICC below 0.7 that no flag told to distrust, of all maps. "
        "Blank: not for this sensor. Simulated."
    )
    figure.supxlabel(textwrap.fill(legend, int(13 * size[0])), fontsize=8)
    save_figure(figure, output, dpi=DPI)


def _mark(axes: Any, x: float, y: float, words: str) -> None:
    box = {"facecolor": "tab:red", "edgecolor": "none", "pad": 1.5}
    axes.text(x, y, words, va="center", ha="right", fontsize=8, color="white", bbox=box)

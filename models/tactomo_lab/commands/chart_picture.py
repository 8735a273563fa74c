"""The picture of `tactomo bench --chart`: accuracy over time per frame, a panel for each noise.

All words stand beside the panels, so that none lies over a point or another word: the legend says
which marker is which method, which size is which budget, and what the lines are.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from tactomo_models import available_methods
from tactomo_models.arrays import FloatArray

from tactomo_lab.evaluation.trade_off import Point, panels, pareto_front

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's colours, which those who see fewer colours tell apart, too.
COLOURS: Final = (
    *("#D55E00", "#0072B2", "#56B4E9", "#000000", "#009E73"),
    *("#CC79A7", "#E69F00", "#7A4FBF", "#8C6D31", "#808080", "#00A5B5", "#A50F3C"),
)
MARKERS: Final = "oDsXPv^*<>hp"
MARKER: Final = 7.0  # points of print, across, of methods without a budget
MARKERS_OF_BUDGETS: Final = (4.0, 10.0)  # likewise, of the least and the most work
PALE: Final = 0.35  # opacity of what something else is better than
FRONT: Final[dict[str, Any]] = {"color": "0.45", "linewidth": 1.5}
Style = tuple[str, str]  # colour and marker
Sizes = dict[float | None, float]  # of markers, by budget in seconds
ICC_TICKS: Final = (-0.5, 0, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998)
MAX_ICC: Final = 0.9995  # drawn there if it is more
PAPER_MS: Final = 6000.0  # the paper, section V: whole tomography, hardware; it prints no ICC
PAPER: Final[dict[str, Any]] = {"color": "0.6", "linestyle": ":", "linewidth": 1}
FRAME_MS: Final = 50.0  # between two scans at 20 a second
FRAME: Final[dict[str, Any]] = {"color": "0.6", "linestyle": "--", "linewidth": 1}


def draw_chart(points: Sequence[Point], title: str) -> Figure:
    """Draw a panel for each kind of scene and noise."""
    from matplotlib.figure import Figure

    groups, styles, sizes = list(panels(points)), _styles(points), _sizes(points)
    columns = 2 if len(groups) > 1 else 1
    rows = -(-len(groups) // columns)
    figure = Figure(figsize=(5.5 * columns, 0.7 + 4.0 * rows), layout="constrained")
    figure.suptitle(title, fontsize=9)
    grid: Any = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes in grid.flat[len(groups) :]:
        axes.set_visible(False)
    for axes, panel in zip(grid.flat, groups, strict=False):
        _draw_panel(axes, panel, styles, sizes)
    _set_axes(grid, points)
    _add_legend(figure, points, styles, sizes)
    return figure


def _add_legend(
    figure: Figure, points: Sequence[Point], styles: dict[str, Style], sizes: Sizes
) -> None:
    """Say below the panels what markers, their sizes and lines are."""
    from matplotlib.lines import Line2D

    measured = {point.variant.method for point in points}
    methods = [
        Line2D([], [], color=colour, marker=marker, markersize=MARKER, label=method)
        for method, (colour, marker) in styles.items()
        if method in measured
    ]
    names = {p.variant.budget_s: p.variant.budget_name for p in points}
    budgets = [
        Line2D([], [], color="0.5", marker="o", markersize=size, linewidth=0, label=names[budget])
        for budget, size in sizes.items()
        if budget is not None
    ]
    lines = [Line2D([], [], **FRONT, label="Pareto front")]
    if any(point.scene == "moving" for point in points):
        lines.append(Line2D([], [], **FRAME, label="next scan, 20 a second"))
    lines.append(Line2D([], [], **PAPER, label="the paper: 6 s, hardware, no ICC"))
    handles = [*methods, *budgets, *lines]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=8)


def _draw_panel(axes: Any, panel: Sequence[Point], styles: dict[str, Style], sizes: Sizes) -> None:
    front = pareto_front(panel)
    axes.axvline(PAPER_MS, **PAPER)
    if panel[0].scene == "moving":
        axes.axvline(FRAME_MS, **FRAME)
    if front:
        x, y = [p.summary.seconds * 1e3 for p in front], [p.summary.icc for p in front]
        axes.step([*x, PAPER_MS], [*y, y[-1]], where="post", zorder=1, **FRONT)
    for method in dict.fromkeys(point.variant.method for point in panel):
        _draw_method(axes, [p for p in panel if p.variant.method == method], front, styles, sizes)
    kind = "Still scenes, cold start" if panel[0].scene == "still" else "Moving scenes, 20 frames/s"
    axes.set_title(f"{kind}: {panel[0].snr_db:g} dB signal to noise", fontsize=10)


def _draw_method(
    axes: Any,
    series: Sequence[Point],
    front: Sequence[Point],
    styles: dict[str, Style],
    sizes: Sizes,
) -> None:
    """Draw a method's points, joined from its smallest budget to its largest."""
    colour, marker = styles[series[0].variant.method]
    axes.plot(
        [p.summary.seconds * 1e3 for p in series],
        [_shown(p.summary.icc) for p in series],
        color=colour,
        linewidth=1,
        alpha=PALE,
        zorder=2,
    )
    for point in series:
        best = point in front
        axes.errorbar(
            point.summary.seconds * 1e3,
            _shown(point.summary.icc),
            xerr=[[0.0], [max(0.0, point.summary.seconds_99 - point.summary.seconds) * 1e3]],
            color=colour,
            marker=marker,
            markersize=sizes[point.variant.budget_s],
            elinewidth=1,
            capsize=2,
            alpha=1.0 if best else PALE,
            zorder=4 if best else 3,
        )


def _styles(points: Sequence[Point]) -> dict[str, Style]:
    """Colours and markers of methods: ours and installed ones keep theirs on every chart."""
    methods = dict.fromkeys((*available_methods(), *(point.variant.method for point in points)))
    return dict(zip(methods, cycle(zip(COLOURS, MARKERS, strict=True)), strict=False))


def _sizes(points: Sequence[Point]) -> Sizes:
    """Sizes of markers: the more work a budget allows, the larger."""
    budgets = sorted({p.variant.budget_s for p in points if p.variant.budget_s is not None})
    across = np.linspace(*MARKERS_OF_BUDGETS, len(budgets))
    return {None: MARKER, **dict(zip(budgets, across.tolist(), strict=True))}


def _shown(icc: float) -> float:
    return min(icc, MAX_ICC)


def _set_axes(grid: Any, points: Sequence[Point]) -> None:
    """Stretch ICC towards 1: half of what is missing is as far up everywhere."""
    icc = np.array([_shown(p.summary.icc) for p in points if np.isfinite(p.summary.icc)])
    least, most = (-np.log10(1 - value) for value in (icc.min(), icc.max()))
    margin = 0.08 * max(most - least, 0.5)
    for axes in grid.flat:
        axes.set_xscale("log")
        axes.set_yscale("function", functions=(_stretch, _unstretch))
        ends = _unstretch(np.array([least - margin, most + 1.5 * margin]))
        axes.set_ylim(*ends)
        axes.set_yticks([tick for tick in ICC_TICKS if ends[0] < tick < ends[1]])
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.minorticks_off()
        axes.grid(alpha=0.25)
    for axes in grid[-1]:
        axes.set_xlabel("time per frame (ms), less is better: p50, whisker to p99")
    for axes in grid[:, 0]:
        axes.set_ylabel("mean ICC with the true map, more is better")


def _stretch(icc: FloatArray) -> FloatArray:
    return np.asarray(-np.log10(1 - np.minimum(icc, MAX_ICC)))


def _unstretch(stretched: FloatArray) -> FloatArray:
    return np.asarray(1 - 10.0**-stretched)

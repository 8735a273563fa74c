"""The picture of `tactomo bench --chart`: accuracy over time per frame, a panel for each noise."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle, groupby
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
MARKER: Final = 7.0  # points of print, across
PALE: Final = 0.35  # opacity of what something else is better than
FRONT: Final = "0.45"
Style = tuple[str, str]  # colour and marker
ICC_TICKS: Final = (-0.5, 0, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998)
MAX_ICC: Final = 0.9995  # drawn there if it is more
PAPER_MS: Final = 6000.0  # the paper, section V: whole tomography, hardware; it prints no ICC
FRAME_MS: Final = 50.0  # between two scans at 20 a second


def draw_chart(points: Sequence[Point], title: str) -> Figure:
    """Draw a panel for each kind of scene and noise."""
    from matplotlib.figure import Figure

    groups, styles = list(panels(points)), _styles(points)
    columns = 2 if len(groups) > 1 else 1
    rows = -(-len(groups) // columns)
    figure = Figure(figsize=(5.5 * columns, 0.7 + 4.0 * rows), layout="constrained")
    figure.suptitle(title, fontsize=9)
    grid: Any = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes in grid.flat[len(groups) :]:
        axes.set_visible(False)
    for axes, panel in zip(grid.flat, groups, strict=False):
        _draw_panel(axes, panel, styles)
    _set_axes(grid, points)
    _name_methods(figure, points, styles)
    _part_labels(figure, grid)
    return figure


def _part_labels(figure: Figure, grid: Any) -> None:
    """Move labels down until none lies over another one of its panel."""
    figure.draw_without_rendering()
    for axes in grid.flat:
        placed: list[Any] = []
        for label in sorted(axes.texts, key=lambda text: -text.get_window_extent().y1):
            while any(label.get_window_extent().overlaps(other) for other in placed):
                if not isinstance(label.get_gid(), str):  # of a line or a front: stays there
                    break
                x, y = label.get_position()
                label.set_position((x, y - label.get_fontsize() - 1))
            placed.append(label.get_window_extent())


def _name_methods(figure: Figure, points: Sequence[Point], styles: dict[str, Style]) -> None:
    """Say below the panels which marker is which method."""
    from matplotlib.lines import Line2D

    measured = {point.variant.method for point in points}
    handles = [
        Line2D([], [], color=colour, marker=marker, label=method)
        for method, (colour, marker) in styles.items()
        if method in measured
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=8)


def _draw_panel(axes: Any, panel: Sequence[Point], styles: dict[str, Style]) -> None:
    front = pareto_front(panel)
    _draw_time(axes, PAPER_MS, "the paper: 6 s a frame, hardware, no ICC given")
    if panel[0].scene == "moving":
        _draw_time(axes, FRAME_MS, "next scan at 20 a second")
    if front:
        x, y = [p.p50_s * 1e3 for p in front], [p.icc for p in front]
        axes.step([*x, PAPER_MS], [*y, y[-1]], where="post", color=FRONT, linewidth=1.5, zorder=1)
        axes.annotate(
            "Pareto front ",
            (PAPER_MS, y[-1]),
            xytext=(-10, 3),
            textcoords="offset points",
            ha="right",
            fontsize=7,
            color=FRONT,
        )
    for method in dict.fromkeys(point.variant.method for point in panel):
        _draw_method(axes, [p for p in panel if p.variant.method == method], front, styles)
    kind = "Still scenes, cold start" if panel[0].scene == "still" else "Moving scenes, 20 frames/s"
    axes.set_title(f"{kind}: {panel[0].snr_db:g} dB signal to noise", fontsize=10)


def _draw_time(axes: Any, ms: float, what: str) -> None:
    """Mark a time that is worth comparing with."""
    axes.axvline(ms, color="0.6", linestyle=":", linewidth=1)
    axes.annotate(
        what,
        (ms, 0.02),
        xytext=(-1, 0),
        xycoords=axes.get_xaxis_transform(),
        textcoords="offset points",
        rotation=90,
        ha="right",
        va="bottom",
        fontsize=6.5,
        color="0.4",
    )


def _draw_method(
    axes: Any, series: Sequence[Point], front: Sequence[Point], styles: dict[str, Style]
) -> None:
    """Draw a method's points, joined from its smallest budget to its largest, with the budgets."""
    colour, marker = styles[series[0].variant.method]
    axes.plot(
        [p.p50_s * 1e3 for p in series],
        [_shown(p.icc) for p in series],
        color=colour,
        linewidth=1,
        alpha=PALE,
        zorder=2,
    )
    for point in series:
        best = point in front
        axes.errorbar(
            point.p50_s * 1e3,
            _shown(point.icc),
            xerr=[[0.0], [max(0.0, point.summary.seconds_99 - point.p50_s) * 1e3]],
            color=colour,
            marker=marker,
            markersize=MARKER if best else 0.7 * MARKER,
            elinewidth=1,
            capsize=2,
            alpha=1.0 if best else PALE,
            zorder=4 if best else 3,
        )
    if len(series) > 1:
        _name_budgets(axes, series, colour)


def _name_budgets(axes: Any, series: Sequence[Point], colour: str) -> None:
    """Write budgets below points: one range for budgets in a row whose ICC prints alike."""
    for _, alike in groupby(series, key=lambda point: f"{point.icc:.3f}"):
        first, *others = alike
        names = [first.variant.budget_name, *(p.variant.budget_name for p in others[-1:])]
        axes.annotate(
            " to ".join(names),
            (first.p50_s * 1e3, _shown(first.icc)),
            xytext=(0, -MARKER),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=6,
            color=colour,
            gid="budget",
        )


def _styles(points: Sequence[Point]) -> dict[str, Style]:
    """Colours and markers of methods: ours and installed ones keep theirs on every chart."""
    methods = dict.fromkeys((*available_methods(), *(point.variant.method for point in points)))
    return dict(zip(methods, cycle(zip(COLOURS, MARKERS, strict=True)), strict=False))


def _shown(icc: float) -> float:
    return min(icc, MAX_ICC)


def _set_axes(grid: Any, points: Sequence[Point]) -> None:
    """Stretch ICC towards 1: half of what is missing is as far up everywhere."""
    icc = np.array([_shown(p.icc) for p in points if np.isfinite(p.icc)])
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
        axes.set_xlabel("time per frame (ms): p50, whisker to p99")
    for axes in grid[:, 0]:
        axes.set_ylabel("ICC with the true map, mean")
    grid[0, 0].annotate(
        "better",
        xy=(0.02, 0.98),
        xytext=(0.12, 0.88),
        xycoords="axes fraction",
        color="0.4",
        fontsize=9,
        arrowprops={"arrowstyle": "->", "color": "0.4"},
    )


def _stretch(icc: FloatArray) -> FloatArray:
    return np.asarray(-np.log10(1 - np.minimum(icc, MAX_ICC)))


def _unstretch(stretched: FloatArray) -> FloatArray:
    return np.asarray(1 - 10.0**-stretched)

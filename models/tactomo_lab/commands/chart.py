"""The chart of `tactomo bench`: every method's speed against its accuracy, on simulated scenes.

Presses of mixed kinds on skins made by hand, all with reporting seeds, under every budget. *Still*
scenes at three signal-to-noise ratios: each by itself from a cold start, so that a budget which
ends early leaves what one frame could do. *Moving*: frame after frame as the daemon has them, so
that what one frame does not finish the next one goes on with; every frame is reconstructed, however
long that takes.

In the picture, all words stand beside the panels, so that none lies over a point or another word.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from tactomo.cli.output import say
from tactomo.cli.plot.plot import prepare_picture, save_figure
from tactomo_models import available_methods, load_description
from tactomo_models.arrays import FloatArray
from tactomo_models.batch import BUDGET_S
from tactomo_models.methods.registry import BUDGETED
from tactomo_models.reconstruct import DEFAULT_BUDGET_S

from tactomo_lab.commands.report import shown, usable
from tactomo_lab.evaluation.moving import mixed_sequence
from tactomo_lab.evaluation.play import Outcome, Variant, play
from tactomo_lab.evaluation.regimes import make_case
from tactomo_lab.scenes.case import Case
from tactomo_lab.scenes.measures import Summary, summarise_by

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SceneKind = Literal["still", "moving"]

UNHURRIED: Final = ("levelset",)  # charted under the last budget alone
BUDGETS_S: Final = (0.001, 0.002, 0.005, 0.01, 0.02, DEFAULT_BUDGET_S)
STILL_BUDGETS_S: Final = (*BUDGETS_S, BUDGET_S)  # the last one: as much as a scene needs


def variants(methods: Iterable[str], budgets_s: Sequence[float] = BUDGETS_S) -> list[Variant]:
    """Every method: `auto` under each of some budgets, others that one bounds under the last."""
    chosen = []
    for method in methods:
        if method not in BUDGETED:
            chosen.append(Variant(method))
        else:
            budgets = budgets_s[-1:] if method in UNHURRIED else budgets_s
            chosen += [Variant(method, budget_s) for budget_s in budgets]
    return chosen


@dataclass(frozen=True)
class Point:
    """How fast and how right a variant is on scenes of one kind."""

    scene: SceneKind
    snr_db: float
    variant: Variant
    summary: Summary


def points_of(outcomes: Iterable[Outcome]) -> list[Point]:
    """What became of cases, one point for each kind of scene, ratio and variant."""

    def key(outcome: Outcome) -> tuple[SceneKind, float, Variant]:
        kind: SceneKind = "still" if outcome.case.is_still else "moving"
        return kind, outcome.score.snr_db, outcome.variant

    found = summarise_by((key(outcome), outcome.score) for outcome in outcomes)
    return [Point(*of, summary) for of, summary in found.items()]


def panels(points: Iterable[Point]) -> Iterator[list[Point]]:
    """Points that can be compared: of one kind of scene and one signal-to-noise ratio."""
    groups: dict[tuple[SceneKind, float], list[Point]] = {}
    for point in points:
        groups.setdefault((point.scene, point.snr_db), []).append(point)
    yield from groups.values()


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """Points than which none is both as fast and as right, and better in one; fastest first."""
    known = [point for point in points if np.isfinite(point.summary.icc)]
    best = [one for one in known if not any(_dominates(other, one) for other in known)]
    return sorted(best, key=lambda point: point.summary.seconds)


def _dominates(one: Point, other: Point) -> bool:
    a, b = ((point.summary.seconds, -point.summary.icc) for point in (one, other))
    return a != b and a[0] <= b[0] and a[1] <= b[1]


STILL_SNR_DB: Final = (40.0, 20.0, 10.0)
CONTACTS: Final = 4  # mixed scenes have one to so many, in turns
SCENES_A_SEQUENCE: Final = 5  # a sequence has some 100 frames
SEEDS: Final = "reporting"
BUSY: Final = 0.8  # share of a core below which times are those of whatever else ran
MEASURES: Final = (
    "frames",
    "icc",
    "icc_worst",
    "count_right",
    "warned",
    "bad_unflagged",
)


def chart(
    name: str, picture: Path, count: int, machine: str, methods: Sequence[str] = ()
) -> list[dict[str, Any]]:
    """Measure methods, write the picture, and return a row for each point of the chart.

    Raises:
        TactomoError: the picture cannot be written, or matplotlib is missing.
        ModelError: there are no scenes for such a sensor, or a method of the user's own failed.
    """
    prepare_picture(picture)
    points, warnings = measure_chart(name, count, methods)
    machine = "; ".join((machine, *warnings))
    moving_scenes = sequences(count)
    title = (
        f"Simulated, not measured on hardware: sensor {name}, reporting seeds; presses of mixed "
        f"kinds on skins made by hand\n{count} still scenes each of 1 to 4 contacts, "
        f"{moving_scenes} moving scene{'s' * (moving_scenes > 1)}; one thread of\n{machine}\n"
        "sizes of markers: budget of modelled work; pale: another point is both faster and better"
    )
    save_figure(draw_chart(points, title), picture)
    say(f"wrote {picture}", err=True)
    return rows_of(points)


def measure_chart(
    name: str, count: int, methods: Sequence[str] = ()
) -> tuple[list[Point], list[str]]:
    """Measure methods, with a progress bar in the terminal; also return what is wrong with times.

    Raises:
        ModelError: there are no scenes for such a sensor, or a method of the user's own failed.
    """
    sensor = load_description(name)
    methods = usable(sensor, methods or available_methods())
    scenes = count * CONTACTS
    drawn: list[tuple[str, Sequence[float], list[Case]]] = []
    for snr_db in STILL_SNR_DB:
        what = f"still scenes, {snr_db:g} dB"
        mixed = (make_case(sensor, "mixed", SEEDS, n, snr_db=snr_db) for n in range(scenes))
        made = list(shown(mixed, scenes, f"simulating {what}"))
        drawn.append((what, STILL_BUDGETS_S, made))
    numbers = range(sequences(count))
    moving = (mixed_sequence(sensor, SEEDS, number, "each change") for number in numbers)
    made = list(shown(moving, len(numbers), "simulating moving scenes"))
    drawn.append(("moving scenes", BUDGETS_S, made))
    points = []
    with _warned_if_busy() as warnings:
        for what, budgets_s, cases in drawn:
            asked = variants(methods, budgets_s)
            total = len(asked) * sum(len(case.frames) for case in cases)
            points += points_of(shown(play(cases, *asked), total, f"measuring on {what}"))
    return points, warnings


def sequences(count: int) -> int:
    """Return how many moving scenes go with `count` still ones of each number of contacts."""
    return -(-count // SCENES_A_SEQUENCE)


@contextmanager
def _warned_if_busy() -> Iterator[list[str]]:
    """Say on standard error if this process had to wait for others while it measured times.

    The list that the block gets holds the same words at its end, for what else shows the times.
    """
    wall_s, own_s = time.perf_counter(), time.process_time()
    warnings: list[str] = []
    yield warnings
    share = (time.process_time() - own_s) / (time.perf_counter() - wall_s)
    if share < BUSY:
        busy = (
            f"the machine was busy: this process had {share:.0%} of a core, so its times are "
            "too long"
        )
        warnings.append(busy)
        say(f"{busy}; run it again when nothing else runs", err=True)


def rows_of(points: Sequence[Point]) -> list[dict[str, Any]]:
    """Return the points as flat rows, for JSON; in each panel the fastest first."""
    rows = []
    for panel in panels(points):
        front = pareto_front(panel)
        for point in sorted(panel, key=lambda p: p.summary.seconds):
            summary, budget_s = point.summary, point.variant.budget_s
            rows.append(
                {
                    "scene": point.scene,
                    "snr_db": point.snr_db,
                    "method": point.variant.method,
                    "budget_ms": None if budget_s is None else budget_s * 1e3,
                    "p50_ms": summary.seconds * 1e3,
                    "p99_ms": summary.seconds_99 * 1e3,
                    **{name: getattr(summary, name) for name in MEASURES},
                    "on_front": point in front,
                }
            )
    return rows


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

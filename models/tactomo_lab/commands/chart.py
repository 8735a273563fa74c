"""The chart of `tactomo bench`: every method's speed against its accuracy, on simulated scenes.

Presses of mixed kinds on skins made by hand: still scenes at three signal-to-noise ratios and
moving ones, all with reporting seeds.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from tactomo.cli.output import say
from tactomo.cli.plot.plot import prepare_picture, save_figure
from tactomo_models import available_methods, load_description

from tactomo_lab.commands.report import shown, usable
from tactomo_lab.evaluation import trade_off
from tactomo_lab.evaluation.moving import mixed_sequence
from tactomo_lab.evaluation.play import play
from tactomo_lab.evaluation.regimes import make_case
from tactomo_lab.scenes.case import Case

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
    from tactomo_lab.commands.chart_picture import draw_chart

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
) -> tuple[list[trade_off.Point], list[str]]:
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
        drawn.append((what, trade_off.STILL_BUDGETS_S, made))
    numbers = range(sequences(count))
    moving = (mixed_sequence(sensor, SEEDS, number, "each change") for number in numbers)
    made = list(shown(moving, len(numbers), "simulating moving scenes"))
    drawn.append(("moving scenes", trade_off.BUDGETS_S, made))
    points = []
    with _warned_if_busy() as warnings:
        for what, budgets_s, cases in drawn:
            asked = trade_off.variants(methods, budgets_s)
            total = len(asked) * sum(len(case.frames) for case in cases)
            points += trade_off.points_of(shown(play(cases, *asked), total, f"measuring on {what}"))
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


def rows_of(points: Sequence[trade_off.Point]) -> list[dict[str, Any]]:
    """Return the points as flat rows, for JSON; in each panel the fastest first."""
    rows = []
    for panel in trade_off.panels(points):
        front = trade_off.pareto_front(panel)
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

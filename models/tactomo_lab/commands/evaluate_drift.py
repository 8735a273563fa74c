"""`tactomo evaluate drift`: a day of a skin that drifts, with one tare at its start."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from tactomo.cli.options import DEFAULT_DESCRIPTION, Description, JsonOutput, examples, typer_app
from tactomo.cli.output import print_json, table
from tactomo.cli.plot.plot import save_figure

from tactomo_lab.commands.evaluate import Picture, Seeds, shown

if TYPE_CHECKING:
    from tactomo_lab.evaluation.drifting import Day, DaySummary, Seen

FEWER = 10  # frames without tracking are slow, for all that they show
FIGURES = (
    *("frames", "ghosts that begin, an hour", "frames with a ghost"),
    *("presses", "presses missed", "presses that vanished for a while"),
    *("frames under a press that do not show it", "frames distrusted", "frames not followed"),
    "error of firm presses' magnitude",
)

app = typer_app()


@app.command(
    epilog=examples(
        "tactomo evaluate drift",
        "tactomo evaluate drift --hours 3 --json",
        "tactomo evaluate drift --seeds reporting --count 2 --picture drift.png",
    )
)
def drift(
    seeds: Seeds = "tuning",
    count: Annotated[int, typer.Option(min=1, help="Days.")] = 1,
    hours: Annotated[float, typer.Option(min=0.5, max=48.0, help="How long a day is.")] = 24.0,
    sensor: Description = DEFAULT_DESCRIPTION,
    picture: Picture = None,
    as_json: JsonOutput = False,
) -> None:
    """Live through days of a skin that drifts, with baseline tracking and without.

    The temperature swings by 10 K over a day and steps by 2 K once, by 2 % of conductivity per
    kelvin, a tenth of it unevenly; what is pressed creeps by 1 % per decade of time and comes back
    as slowly; contact impedances wander by 10 %. Presses last from seconds to two hours, a third
    of them too light for the magnitude channel. A frame comes every 20 s, and two a second while
    something is pressed or let go; every tenth of the former without tracking.

    The first run simulates (some minutes a day) and keeps the voltages in the cache.
    """
    from tactomo_models import load_description

    from tactomo_lab.evaluation.drifting import live, simulate_day, summarise_day

    description = load_description(sensor)
    days, told = [], []
    for number in range(count):
        day = simulate_day(description, seeds, number, hours)
        name = f"{seeds} {number}"
        tracked = list(shown(live(day), sum(1 for _ in day.times()), f"{name}, tracked"))
        fewer = sum(1 for _ in day.times(FEWER))
        untracked = list(shown(live(day, track=False, every=FEWER), fewer, f"{name}, untracked"))
        days.append((day, tracked, untracked))
        told.append((name, summarise_day(tracked, hours), summarise_day(untracked, hours)))
    if as_json:
        settings = {"simulated": True, "sensor": description.name, "seeds": seeds, "hours": hours}
        rows = [
            {"day": name, "tracked": asdict(tracked), "untracked": asdict(untracked)}
            for name, tracked, untracked in told
        ]
        print_json({**settings, "days": rows})
    else:
        _print(description.name, hours, told)
    if picture is not None:
        _draw(*days[0], picture)
        typer.echo(f"wrote {picture}", err=True)


def _print(sensor: str, hours: float, told: Sequence[tuple[str, DaySummary, DaySummary]]) -> None:
    from rich.console import Console

    console = Console()
    console.print(f"Simulated, not measured: {sensor}, {hours:g} hours after one tare.")
    for name, tracked, untracked in told:
        made = table(name, "tracked", "untracked")
        for figure, with_it, without in zip(FIGURES, _told(tracked), _told(untracked), strict=True):
            made.add_row(figure, with_it, without)
        console.print(made)


def _told(summary: DaySummary) -> list[str]:
    return [
        str(summary.frames),
        f"{summary.ghosts_per_hour:.2f}",
        f"{summary.ghost_share:.1%}",
        str(summary.presses),
        str(summary.missed),
        str(summary.erased),
        f"{summary.erased_share:.1%}",
        f"{summary.distrusted:.1%}",
        f"{summary.refused:.1%}",
        f"{summary.magnitude_error:.1%}".replace("nan%", "-"),
    ]


def _draw(day: Day, tracked: Sequence[Seen], untracked: Sequence[Seen], output: Path) -> None:
    """Draw the drift and how it is followed, and what each of the two shows over the day."""
    import numpy as np
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6.5), layout="constrained")
    axes: Any = figure.subplots(3, 1, sharex=True, height_ratios=(2, 2, 1.6))
    hours = np.array([each.time_s / 3600 for each in tracked])
    true = [100 * math.expm1(-day.skin.warming(each.time_s)) for each in tracked]
    axes[0].plot(hours, true, color="0.6", lw=4, label="of the sheet, by temperature")
    axes[0].plot(hours, [100 * e.gain for e in tracked], lw=1.2, label="followed")
    axes[0].set_ylabel("voltages since\nthe tare (%)")
    axes[0].legend(frameon=False)
    pressed = [each for each in tracked if each.truth > 0]
    times = [each.time_s / 3600 for each in pressed]
    axes[1].plot(times, [e.truth for e in pressed], "_", color="0.6", mew=4, label="true")
    axes[1].plot(times, [e.magnitude for e in pressed], ".", ms=3, label="tracked")
    late = [each for each in untracked if each.truth > 0]
    bare = [e.magnitude for e in late]
    axes[1].plot([e.time_s / 3600 for e in late], bare, "x", ms=4, label="untracked")
    axes[1].set_ylabel("|Δσ|/σ₀ of\nfirm presses")
    axes[1].legend(frameon=False, ncols=3)
    for each in day.skin.presses:
        for axis in axes:
            axis.axvspan(each.start_s / 3600, each.end_s / 3600, color="0.93", lw=0)
    for seen, label, colour in ((tracked, "tracked", "C0"), (untracked, "untracked", "C1")):
        ghosts = [each.ghosts for each in seen]
        axes[2].plot([e.time_s / 3600 for e in seen], ghosts, color=colour, label=label)
    axes[2].set_ylabel("contacts where\nnothing presses")
    axes[2].set_xlabel("hours since the tare; grey: something presses (simulated)")
    axes[2].set_xlim(hours[0], hours[-1])
    axes[2].legend(loc="center right")  # framed: nothing says where ghosts leave room
    save_figure(figure, output)

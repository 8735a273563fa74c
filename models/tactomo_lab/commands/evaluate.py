"""`tactomo evaluate`: how right the reconstruction is, where the truth is known."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import typer
from tactomo.cli import options
from tactomo.cli.commands import Group
from tactomo.cli.output import print_json, table
from tactomo.cli.plot.plot import picture_option

if TYPE_CHECKING:
    from tactomo_lab.evaluation.still import Outcome

Item = TypeVar("Item")

app = options.typer_app(
    name="evaluate",
    cls=Group,
    help="Measure how right the reconstruction is, where the truth is known.",
    no_args_is_help=True,
)

Seeds = Annotated[
    Literal["tuning", "reporting"],
    typer.Option(help="Tune on the one set of scenes, publish figures of the other."),
]
SnrOf = Annotated[
    Literal["change", "voltage"],
    typer.Option(
        help="What noise is measured by: the rms of a channel's voltage changes, or of its "
        "voltages at rest, of which changes are a few percent or less."
    ),
]
Picture = Annotated[Path | None, picture_option("Draw truth and outcome")]


@app.command(
    epilog=options.examples(
        "tactomo evaluate scenes",
        "tactomo evaluate scenes --count 50 --contacts 1-4 --snr 60,40,20,10",
        "tactomo evaluate scenes --method tikhonov --picture tikhonov.png",
        "tactomo evaluate scenes --seeds reporting --snr-of voltage --json > report.json",
    )
)
def scenes(
    seeds: Seeds = "tuning",
    count: Annotated[int, typer.Option(min=1, help="Scenes of each number of contacts.")] = 10,
    contacts: Annotated[str, typer.Option(help="How many contacts: 3, or 1-4.")] = "1-6",
    snr: Annotated[str, typer.Option(help="Signal-to-noise ratios in dB, with commas.")] = "40",
    snr_of: SnrOf = "change",
    method: options.Method = "auto",
    sensor: options.Description = options.DEFAULT_DESCRIPTION,
    picture: Picture = None,
    as_json: options.JsonOutput = False,
) -> None:
    """Reconstruct simulated still scenes, each from a cold start, and compare with the truth.

    Every scene has sheets of its own, uneven by 5 %, uneven electrodes, a contrast of 10 to 100
    that the reconstruction is not told, and noise of equal size in volts on every voltage. They
    are simulated on another, finer mesh than the one that reconstructs. The first run simulates
    (half a second a scene) and keeps the voltages in the cache.

    A frame whose *misfit*, in units of the scans' noise, is above 2 (1.5 over both channels, where
    an unsure network stands in) is flagged misfit_high; about 1 is good.
    """
    from tactomo_models import load_description

    from tactomo_lab.evaluation.still import reconstruct_scenes
    from tactomo_lab.scenes.still_scenes import scenes as draw_scenes

    numbers, ratios = _range(contacts), _decibels(snr)
    description = load_description(sensor)
    drawn = chain.from_iterable(
        draw_scenes(description, seeds, count, contacts=numbers, snr_db=ratio, snr_of=snr_of)
        for ratio in ratios
    )
    total = count * len(numbers) * len(ratios)
    outcomes = list(shown(reconstruct_scenes(drawn, method), total, f"{seeds} scenes"))
    settings = settings_of(description.name, seeds, snr_of, method)
    if as_json:
        print_json({**settings, "scenes_each": count, **_as_json(outcomes)})
    else:
        _print_scenes(settings, outcomes)
    if picture is not None:
        from tactomo_lab.commands.pictures import draw_outcomes

        draw_outcomes(outcomes, picture)
        typer.echo(f"wrote {picture}", err=True)


@app.command(
    epilog=options.examples(
        "tactomo evaluate moving",
        "tactomo evaluate moving --count 10 --snr 20 --budget-ms 100",
        "tactomo evaluate moving --seeds reporting --json > moving.json",
    )
)
def moving(
    seeds: Seeds = "tuning",
    count: Annotated[int, typer.Option(min=1, help="Sequences.")] = 3,
    snr: Annotated[float, typer.Option(help="Signal-to-noise ratio in dB.")] = 40.0,
    snr_of: SnrOf = "change",
    method: options.Method = "auto",
    budget_ms: Annotated[
        float | None, typer.Option(min=1.0, help="Compute time a frame may take. [the daemon's]")
    ] = None,
    sensor: options.Description = options.DEFAULT_DESCRIPTION,
    as_json: options.JsonOutput = False,
) -> None:
    """Follow simulated contacts that slide, land, lift, jump, merge and split, frame by frame.

    With lost scans and a tare on the way, at 20 frames a second, under the budget that the daemon
    has. Each sequence has sheets of its own, as in `tactomo evaluate scenes`. The first run
    simulates (a minute a sequence) and keeps the voltages in the cache.
    """
    from rich.console import Console
    from rich.progress import Progress
    from tactomo_models import load_description

    from tactomo_lab.evaluation.moving import draw_sequence, play, summarise_phases

    description = load_description(sensor)
    played = []
    with Progress(console=Console(stderr=True), transient=True) as shown:
        for number in range(count):
            task = shown.add_task(f"simulating sequence {number + 1} of {count}", total=None)
            sequence = draw_sequence(description, seeds, number, snr_db=snr, snr_of=snr_of)
            name = f"reconstructing sequence {number + 1} of {count}"
            shown.update(task, description=name, total=len(sequence.steps))
            scores = []
            for score in play(sequence, method, None if budget_ms is None else budget_ms / 1e3):
                scores.append(score)
                shown.advance(task)
            played.append(scores)
            shown.remove_task(task)
    phases = summarise_phases(played)
    settings = settings_of(description.name, seeds, snr_of, method)
    if as_json:
        settings |= {"snr_db": snr, "budget_ms": budget_ms}
        rows = {name: asdict(summary) for name, summary in phases.items()}
        frames = [[asdict(score) for score in scores] for scores in played]
        print_json({**settings, "phases": rows, "sequences": frames})
    else:
        print_tables(
            settings,
            phases,
            {f"{count} sequences, {snr:g} dB": PHASES},
            "worst: ICC that 95 % exceed; shape: ICC of the pressed shape; lost: longest run of "
            "frames in which that is below 0.8, median and most; ids: identities lost; wrong: "
            "frames with an ICC below 0.8 or another count, and no flag that says so.",
        )


def _range(text: str) -> range:
    """The numbers from "3" or "1-4"."""
    first, _, last = text.partition("-")
    try:
        numbers = range(int(first), int(last or first) + 1)
    except ValueError:
        numbers = range(0)
    if not numbers or numbers[0] < 1:
        raise typer.BadParameter(
            f"--contacts {text!r}: give a number such as 3, or a range such as 1-4"
        )
    return numbers


def _decibels(text: str) -> list[float]:
    """The numbers from "60,40,20"."""
    try:
        ratios = [float(part) for part in text.split(",")]
    except ValueError:
        ratios = []
    if not ratios or any(math.isnan(ratio) for ratio in ratios):
        raise typer.BadParameter(f"--snr {text!r}: give numbers, such as 60,40,20,10")
    return ratios


def chosen_names(text: str | None, known: Iterable[str], option: str) -> list[str]:
    """Return the names from "a,b", in that order; all where nothing was asked for."""
    known = list(known)
    names = known if text is None else [name.strip() for name in text.split(",")]
    for name in names:
        if name not in known:
            choices = ", ".join(known)
            raise typer.BadParameter(f"{option} {name!r}: give one or more of {choices}")
    return list(dict.fromkeys(names))


def shown(items: Iterable[Item], total: int | None, what: str) -> Iterator[Item]:
    """Pass items on, with a progress bar in the terminal; without an end if there is no total."""
    from rich.console import Console
    from rich.progress import track

    yield from track(
        items, description=what, total=total, console=Console(stderr=True), transient=True
    )


def _as_json(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    from tactomo_lab.scenes.measures import summaries, summarise

    scores = [outcome.score for outcome in outcomes]
    return {
        "all": asdict(summarise(scores)),
        "by": {
            name: {value: asdict(summary) for value, summary in rows.items()}
            for name, rows in summaries(scores).items()
        },
        "scenes": [one.as_json() for one in scores],
    }


def settings_of(sensor: str, seeds: str, snr_of: str, method: str) -> dict[str, Any]:
    """Return what was evaluated, for JSON and `print_settings`."""
    return {"simulated": True, "sensor": sensor, "seeds": seeds, "snr_of": snr_of, "method": method}


def print_tables(
    settings: dict[str, Any],
    groups: Mapping[str, object],  # summaries by their names
    tables: Mapping[str, Sequence[str]],  # by their titles, columns out of `FIGURES`
    legend: str,
) -> None:
    """Print what was evaluated, and tables of what came out."""
    from rich.console import Console

    console = Console()
    console.print(
        f"Simulated, not measured: {settings['sensor']}, {settings['seeds']} seeds, method "
        f"[bold]{settings['method']}[/], SNR of the {settings['snr_of']}."
    )
    for title, columns in tables.items():
        made = table("", *columns, title=title)
        for name, summary in groups.items():
            cells = (FIGURES[column](summary).replace("nan", "-") for column in columns)
            made.add_row(name, *cells)
        console.print(made)
    console.print(f"[dim]{legend}[/]")


def _print_scenes(settings: dict[str, Any], outcomes: Sequence[Outcome]) -> None:
    from tactomo_lab.scenes.measures import summaries, summarise

    scores = [outcome.score for outcome in outcomes]
    groups = {"all": summarise(scores)}
    for name, rows in summaries(scores).items():
        if len(rows) > 1:
            groups |= {f"{name} {value}": summary for value, summary in rows.items()}
    print_tables(
        settings,
        groups,
        {"maps, cold start": MAPS, "contacts": CONTACTS},
        "worst: ICC that 95 % exceed; shape: ICC of the pressed shape; wrong: ICC below 0.8 "
        "or another count, and no flag that says so. counted: right; missed: of the true contacts; "
        "false: a scene; mm: centre error, median; Δσ: error of the magnitude, mean, share of the "
        "range; spread: largest minus smallest at one pressure; in σ: within one reported "
        "standard uncertainty, 68 % where that is right.",
    )


# What tables of a summary show under each heading; of a phase, what stands under the same ones.
FIGURES: dict[str, Callable[[Any], str]] = {
    "frames": lambda s: str(s.frames),
    "ICC": lambda s: f"{s.icc:.3f}",
    "worst": lambda s: f"{s.icc_worst:.2f}",
    "shape": lambda s: f"{s.icc_structure:.3f}",
    "RIE": lambda s: f"{s.rie:.3f}",
    "flagged": lambda s: f"{s.distrusted:.0%}",
    "silent": lambda s: f"{s.bad_unflagged:.0%}",
    "alarms": lambda s: f"{s.good_flagged:.0%}",
    "wrong": lambda s: f"{s.confidently_wrong:.0%}",
    "ms": lambda s: f"{s.seconds * 1e3:.0f}",
    "p99": lambda s: f"{s.seconds_99 * 1e3:.0f}",
    "counted": lambda s: f"{s.count_right:.0%}",
    "missed": lambda s: f"{s.missed:.0%}",
    "false": lambda s: f"{s.false:.2f}",
    "mm": lambda s: f"{s.centre_mm:.2f}",
    "p95": lambda s: f"{s.centre_mm_95:.1f}",
    "right to 10 %": lambda s: f"{s.peak_right:.0%}",
    "overload right": lambda s: f"{s.overload_right:.0%}",
    "overload wrong": lambda s: f"{s.overload_wrong:.0%}",
    "surely wrong": lambda s: f"{s.peak_surely_wrong:.0%}",
    "area": lambda s: f"{s.area_error:.0%}",
    "Δσ": lambda s: f"{s.magnitude_error:.1%}",
    "spread": lambda s: f"{s.magnitude_spread:.0%}",
    "kPa": lambda s: f"{s.pressure_error_kpa:.1f}",
    "in σ": lambda s: f"{s.within_sigma:.0%}",
    "place in σ": lambda s: f"{s.place_within_sigma:.0%}",
    "area in σ": lambda s: f"{s.area_within_sigma:.0%}",
    "peak in σ": lambda s: f"{s.peak_within_sigma:.0%}",
    "lost": lambda s: f"{s.recovery:.0f}",
    "most": lambda s: f"{s.recovery_most:.0f}",
    "ids": lambda s: str(s.switches),
}
MAPS = ("frames", "ICC", "worst", "shape", "RIE", "flagged", "wrong", "ms", "p99")
CONTACTS = (*("counted", "missed", "false", "mm", "p95", "area"), *("Δσ", "spread", "kPa", "in σ"))
PHASES = (
    *("frames", "ICC", "worst", "shape", "counted", "lost", "most", "ids"),
    *("flagged", "wrong", "ms", "p99"),
)

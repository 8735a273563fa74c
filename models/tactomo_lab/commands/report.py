"""What every evaluation prints, writes as JSON and draws: one way for all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple, TypeVar

import typer
from tactomo.cli.output import print_json, say, table
from tactomo.cli.plot.plot import picture_option
from tactomo.errors import TactomoError

if TYPE_CHECKING:
    from rich.table import Table
    from tactomo.cli.console import Console
    from tactomo_models import SensorDescription

Item = TypeVar("Item")

Seeds = Annotated[
    Literal["tuning", "reporting"],
    typer.Option(help="Tune on the one set of scenes, publish figures of the other."),
]
Picture = Annotated[Path | None, picture_option("Draw truth and outcome")]


class Figure(NamedTuple):
    """A column of a table of summaries."""

    attribute: str  # of the summary
    form: str  # that it is printed in
    meaning: str = ""  # said below the table, where the heading does not say it
    unit: float = 1.0  # in which it is printed, over the attribute's


FIGURES: Final = {
    "frames": Figure("frames", "d"),
    "ICC": Figure("icc", ".3f"),
    "worst": Figure("icc_worst", ".2f", "ICC that 95 % exceed"),
    "shape": Figure("icc_structure", ".3f", "ICC of the pressed shape"),
    "RIE": Figure("rie", ".3f"),
    "flagged": Figure("distrusted", ".0%"),
    "silent": Figure(
        "bad_unflagged", ".0%", "maps with an ICC below 0.7 and no flag that tells to distrust"
    ),
    "alarms": Figure("good_flagged", ".0%", "good maps with such a flag, of the good ones"),
    "wrong": Figure(
        "confidently_wrong", ".0%", "ICC below 0.8 or another count, and no flag that says so"
    ),
    "ms": Figure("seconds", ".0f", unit=1e-3),
    "p99": Figure("seconds_99", ".0f", unit=1e-3),
    "counted": Figure("count_right", ".0%", "right"),
    "missed": Figure("missed", ".0%", "of the true contacts"),
    "false": Figure("false", ".2f", "a scene"),
    "mm": Figure("centre_mm", ".2f", "centre error, median"),
    "p95": Figure("centre_mm_95", ".1f"),
    "right to 10 %": Figure("peak_right", ".0%", "peaks, of the true contacts"),
    "force": Figure("force_error", ".1%", "error of all force, mean, where one contact presses"),
    "forces": Figure("force_error_several", ".1%", "the same where several press"),
    "overload right": Figure(
        "overload_right", ".0%", "of contacts beyond the response table, told without a bound"
    ),
    "overload wrong": Figure(
        "overload_wrong", ".0%", "likewise, those whose 95 % interval ends below them"
    ),
    "surely wrong": Figure(
        "peak_surely_wrong",
        ".0%",
        "peaks more than 3 reported sigmas and 10 % off, or told above a range that they lie in",
    ),
    "area": Figure("area_error", ".0%"),
    "Δσ": Figure("magnitude_error", ".1%", "error of the magnitude, mean, share of the range"),
    "spread": Figure("magnitude_spread", ".0%", "largest minus smallest at one pressure"),
    "kPa": Figure("pressure_error_kpa", ".1f"),
    "in σ": Figure(
        "within_sigma",
        ".0%",
        "within one reported standard uncertainty, 68 % where that is right",
    ),
    "place in σ": Figure("place_within_sigma", ".0%"),
    "area in σ": Figure("area_within_sigma", ".0%"),
    "peak in σ": Figure("peak_within_sigma", ".0%"),
    "lost": Figure(
        "recovery", ".0f", "longest run of frames in which the shape's ICC is below 0.8, median"
    ),
    "most": Figure("recovery_most", ".0f", "... of the slowest sequence"),
    "ids": Figure("switches", "d", "identities lost"),
    "ghosts/h": Figure("ghosts_per_hour", ".2f", "contacts that begin where nothing presses"),
    "ghosts": Figure("ghost_share", ".1%", "frames with one"),
    "presses": Figure("presses", "d"),
    "unseen": Figure("missed", "d", "presses that are never shown"),
    "erased": Figure("erased", "d", "presses that vanish for a while"),
    "hidden": Figure("erased_share", ".1%", "frames under a press that do not show it"),
    "distrusted": Figure("distrusted", ".1%", "frames with a flag that tells to distrust"),
    "refused": Figure("refused", ".1%", "frames not followed"),
    "firm Δσ": Figure("magnitude_error", ".1%", "error of firm presses' magnitude"),
}


def summary_table(title: str, columns: Sequence[str], summaries: Mapping[str, object]) -> Table:
    """Lay out summaries by their names, in columns out of `FIGURES`."""
    made = table("", *columns, title=title)
    for name, summary in summaries.items():
        made.add_row(name, *(_cell(FIGURES[column], summary) for column in columns))
    return made


def _cell(figure: Figure, summary: object) -> str:
    value = getattr(summary, figure.attribute)
    value = value if figure.unit == 1.0 else value / figure.unit
    return f"{value:{figure.form}}".replace("nan%", "-").replace("nan", "-")


def legend(columns: Iterable[str]) -> str:
    """Say what headings mean that do not say it themselves."""
    return "; ".join(f"{c}: {FIGURES[c].meaning}" for c in columns if FIGURES[c].meaning) + "."


def tell(
    told: dict[str, Any],
    as_json: bool,
    show: Callable[[Console], None],
    picture: Path | None = None,
    draw: Callable[[Path], None] | None = None,
) -> None:
    """Print what came out, for programs or in words, and draw it if asked for."""
    if as_json:
        print_json(told)
    else:
        from tactomo.cli.console import Console

        show(Console())
    if picture is not None and draw is not None:
        draw(picture)
        say(f"wrote {picture}", err=True)


def print_suite(
    console: Console,
    what: str,  # was evaluated, and how
    tables: Mapping[str, Sequence[str]],  # by their titles, columns out of `FIGURES`
    summaries: Mapping[str, object],  # by their names
) -> None:
    """Print what was evaluated, and tables of what came out."""
    console.print(f"Simulated, not measured: {what}.")
    for title, columns in tables.items():
        console.print(summary_table(title, columns, summaries))
    headings = dict.fromkeys(column for each in tables.values() for column in each)
    console.print(legend(headings), style="dim")


def shown(items: Iterable[Item], total: int | None, what: str) -> Iterator[Item]:
    """Pass items on, with a progress bar in the terminal; without an end if there is no total."""
    from rich.progress import track
    from tactomo.cli.console import Console

    yield from track(
        items, description=what, total=total, console=Console(stderr=True), transient=True
    )


def chosen_names(text: str | None, known: Iterable[str], option: str) -> list[str]:
    """Return the names from "a,b", in that order; all where nothing was asked for."""
    known = list(known)
    names = known if text is None else [name.strip() for name in text.split(",")]
    for name in names:
        if name not in known:
            choices = ", ".join(known)
            raise typer.BadParameter(f"{option} {name!r}: give one or more of {choices}")
    return list(dict.fromkeys(names))


def usable(sensor: SensorDescription, methods: Sequence[str]) -> list[str]:
    """Return the methods that serve a sensor; say on standard error why others are left out.

    Raises TactomoError where none does.
    """
    from tactomo_lab.evaluation.trade_off import left_out

    missing = left_out(sensor, methods)
    for method, reason in missing.items():
        say(f"left out: {method}: {reason}", err=True)
    if len(missing) == len(methods):
        raise TactomoError("none of the methods is available", "choose others with --method")
    return [method for method in methods if method not in missing]

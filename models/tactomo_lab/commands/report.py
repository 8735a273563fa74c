"""What every evaluation prints, writes as JSON and draws: one way for all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple, TypeVar

import typer
from tactomo.cli.output import print_json, say, table
from tactomo.errors import TactomoError

if TYPE_CHECKING:
    from rich.table import Table
    from tactomo.cli.console import Console
    from tactomo_models import SensorDescription

    from tactomo_lab.scenes.measures import Summary

Item = TypeVar("Item")

Seeds = Annotated[
    Literal["tuning", "reporting"],
    typer.Option(help="Tune on the one set of scenes, publish figures of the other."),
]


class Finding(NamedTuple):
    """What an evaluation shows: in words, a table with its caption, and all for programs."""

    words: str
    table: Table
    caption: str
    facts: Any


class Column(NamedTuple):
    """A measure's column in tables."""

    attribute: str  # of `Summary`
    form: str  # that it is printed in
    meaning: str = ""  # where the heading does not say it
    unit: float = 1.0  # in which it is printed, over the attribute's


SIGMA = "within one reported standard uncertainty, 68 % where that is right"
TABLES: Final = {
    "maps": {
        "frames": Column("frames", "d"),
        "ICC": Column("icc", ".3f"),
        "RIE": Column("rie", ".3f"),
        "worst": Column("icc_worst", ".2f", "ICC that 95 % exceed"),
        "shape": Column("icc_structure", ".3f", "ICC of the pressed shape"),
        "flagged": Column("warned", ".0%", "with a flag that tells to distrust, or no map"),
        "silent": Column("bad_unflagged", ".0%", "maps with an ICC below 0.7 and no such flag"),
        "alarms": Column("good_flagged", ".0%", "good maps with such a flag, of the good ones"),
        "ms": Column("seconds", ".0f", unit=1e-3),
        "p99": Column("seconds_99", ".0f", unit=1e-3),
    },
    "contacts": {
        "counted": Column("count_right", ".0%", "right"),
        "missed": Column("missed", ".0%", "of the true contacts"),
        "false": Column("false", ".2f", "a scene"),
        "mm": Column("centre_mm", ".2f", "centre error, median"),
        "p95": Column("centre_mm_95", ".1f"),
        "place in σ": Column("place_within_sigma", ".0%"),
        "area in σ": Column("area_within_sigma", ".0%"),
        "Δσ": Column("magnitude_error", ".1%", "error of the magnitude, mean, share of the range"),
        "in σ": Column("within_sigma", ".0%", SIGMA),
    },
    "pressures": {
        "right to 10 %": Column("peak_right", ".0%", "peaks, of the true contacts"),
        "peak in σ": Column("peak_within_sigma", ".0%"),
        "surely wrong": Column(
            *("peak_surely_wrong", ".0%"),
            "peaks 3 reported sigmas and 10 % off, or told above a range that they lie in",
        ),
        "force": Column("force_error", ".1%", "error of all force, mean, where one presses"),
        "forces": Column("force_error_several", ".1%", "the same where several press"),
        "overload right": Column(
            *("overload_right", ".0%"),
            "of contacts beyond the table, told without a bound",
        ),
        "overload wrong": Column(
            "overload_wrong", ".0%", "likewise, those whose 95 % interval ends below them"
        ),
    },
}


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
        from tactomo.cli.console import page

        show(page())
    if picture is not None and draw is not None:
        draw(picture)
        say(f"wrote {picture}", err=True)


def print_suite(console: Console, what: str, summaries: Mapping[str, Summary]) -> None:
    """Print what was evaluated, and tables of what came out, by its name."""
    console.print(f"Simulated, not measured: {what}.")
    if not summaries:  # every line was left out
        return
    for title, columns in TABLES.items():
        made = table("", *columns, title=title)
        for name, summary in summaries.items():
            made.add_row(name, *(_cell(summary, column) for column in columns.values()))
        console.print(made)
    meanings = [
        f"{heading}: {column.meaning}"
        for columns in TABLES.values()
        for heading, column in columns.items()
        if column.meaning
    ]
    console.print(f"{'; '.join(meanings)}.", style="dim")


def _cell(summary: Summary, column: Column) -> str:
    value = getattr(summary, column.attribute)
    value = value if column.unit == 1.0 else value / column.unit
    return f"{value:{column.form}}".replace("nan%", "-").replace("nan", "-")


def shown(items: Iterable[Item], total: int | None, what: str) -> Iterator[Item]:
    """Pass items on, with a progress bar in the terminal; without an end if there is no total."""
    from tactomo.cli.console import progress

    with progress() as bar:
        yield from bar.track(items, total, description=what)


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
    from tactomo_models.methods.registry import left_out

    why = left_out(methods, sensor)
    for method, error in why.items():
        say(f"left out: {method}: {error}", err=True)
    found = [method for method in methods if method not in why]
    if not found:
        raise TactomoError("none of the methods is available", "choose others with --method")
    return found

"""What every evaluation prints, writes as JSON and draws: one way for all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_type_hints

import typer
from tactomo.cli.output import print_json, say, table
from tactomo.errors import TactomoError

if TYPE_CHECKING:
    from tactomo.cli.console import Console
    from tactomo_models import SensorDescription

    from tactomo_lab.scenes.measures import Figure

Item = TypeVar("Item")

Seeds = Annotated[
    Literal["tuning", "reporting"],
    typer.Option(help="Tune on the one set of scenes, publish figures of the other."),
]


def _figures(kind: type) -> dict[str, tuple[str, Figure]]:
    """Attributes of a kind of summaries, and their columns, by the headings of these."""
    columns = get_type_hints(kind, include_extras=True).items()
    return {
        hint.__metadata__[0].heading: (attribute, hint.__metadata__[0])
        for attribute, hint in columns
    }


def _cell(value: float, figure: Figure) -> str:
    value = value if figure.unit == 1.0 else value / figure.unit
    return f"{value:{figure.form}}".replace("nan%", "-").replace("nan", "-")


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


def print_suite(
    console: Console,
    what: str,  # was evaluated, and how
    tables: Mapping[str, Sequence[str]],  # by their titles, headings of the summaries' `Figure`s
    summaries: Mapping[str, object],  # by their names
) -> None:
    """Print what was evaluated, and tables of what came out."""
    console.print(f"Simulated, not measured: {what}.")
    if not summaries:  # every line was left out
        return
    figures = _figures(type(next(iter(summaries.values()))))
    for title, headings in tables.items():
        made = table("", *headings, title=title)
        for name, summary in summaries.items():
            columns = (figures[heading] for heading in headings)
            made.add_row(name, *(_cell(getattr(summary, a), figure) for a, figure in columns))
        console.print(made)
    all_headings = dict.fromkeys(heading for each in tables.values() for heading in each)
    meanings = {heading: figures[heading][1].meaning for heading in all_headings}
    legend = "; ".join(f"{heading}: {meaning}" for heading, meaning in meanings.items() if meaning)
    console.print(f"{legend}.", style="dim")


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

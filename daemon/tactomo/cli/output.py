"""What commands print: tables for people, JSON for programs."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Container, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer

from tactomo.plain import plain

if TYPE_CHECKING:
    from rich.table import Table


def table(*columns: str, left: Container[str] = (), title: str | None = None) -> Table:
    """Return a table without rows: numbers to the right, the first column and some others left."""
    from rich import box
    from rich.table import Table

    made = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0)
    for name in columns:
        words = name in left or name == columns[0]
        made.add_column(name, justify="left" if words else "right", no_wrap=not words)
    return made


def say(text: str = "", err: bool = False, nl: bool = True) -> None:
    """Print a line that may hold what others wrote, on standard error if `err`."""
    typer.echo(plain(text), err=err, nl=nl)


def print_json(told: Any) -> None:
    """Print what programs read; what is not a finite number is null."""
    typer.echo(json.dumps(mapped(told, _finite), indent=2, default=str))


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def mapped(value: Any, change: Callable[[Any], Any]) -> Any:
    """Return maps and lists in each other with all that they hold, names included, changed."""
    if isinstance(value, dict):
        return {change(key): mapped(item, change) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [mapped(item, change) for item in value]
    return change(value)


@contextmanager
def progress_bar(doing: str) -> Iterator[Callable[[float, float], None]]:
    """Show a bar on standard error while this lasts, if that is a terminal."""
    from tactomo.cli.console import progress

    with progress() as bar:
        task = bar.add_task(doing, total=None)

        yield lambda done, total: bar.update(task, completed=done, total=total)

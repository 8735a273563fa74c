"""`tactomo bench --compare`: what has become slower or larger since an earlier `bench --json`.

Methods are compared in bare products of the same run, which hold on another machine as well; live
latency in milliseconds, which does not.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from tactomo.cli.output import table
from tactomo.errors import TactomoError

if TYPE_CHECKING:
    from rich.table import Table

Row = dict[str, Any]  # see `compared`

# What is compared of a row: its name in the table, and the row's keys for p50, p99 and memory.
METHODS: Final = ("products", "of_product", "p99_of_product", "memory_mb")
LIVE: Final = ("ms", "latency_p50_ms", "latency_p99_ms", "memory_mb")
NOTICEABLE: Final = 1.3  # ratio that is marked; p50s of two runs on a busy machine: up to 1.3


def read_results(path: Path) -> Mapping[str, Any]:
    """Return what an earlier run has printed with --json.

    Raises TactomoError where it cannot be read, or is something else.
    """
    try:
        results = json.loads(path.read_text("utf-8"))
        _named(results)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise TactomoError(
            f"cannot compare with {path}: {error}", "write one with: tactomo bench --json > FILE"
        ) from error
    return dict(results)


def compared(earlier: Mapping[str, Any], now: Mapping[str, Any]) -> list[Row]:
    """Set the rows of two runs beside each other.

    Returns:
        A row for each that both have measured: `what`, `unit`, and p50, p99 and memory_mb as
        [earlier, now], None where one of them has no figure.
    """
    before = _named(earlier)
    rows = []
    for what, (row, unit, *keys) in _named(now).items():
        if what in before:
            pairs = [[before[what][0].get(key), row.get(key)] for key in keys]
            both = [pair if None not in pair else None for pair in pairs]
            rows.append({"what": what, "unit": unit, **dict(zip(_FIGURES, both, strict=True))})
    return rows


_FIGURES: Final = ("p50", "p99", "memory_mb")


def _named(results: Mapping[str, Any]) -> dict[str, tuple[Row, str, str, str, str]]:
    """Rows of a run by what they measure, each with its unit and the keys of what is compared."""
    return {
        **{f"live: {row['scene']}": (row, *LIVE) for row in results["live"]},
        **{
            f"{row['method']}, contacts {row['contacts']}, {row['state']}": (row, *METHODS)
            for row in results["methods"]
        },
    }


def table_of(rows: Iterable[Row], path: Path) -> Table:
    """Lay out a comparison; what has grown noticeably is red, what has shrunk so is green."""
    shown = table("measured", "unit", "p50", "p99", "memory MB", title=f"{path}, and now")
    for row in rows:
        shown.add_row(row["what"], row["unit"], *(_change(row[figure]) for figure in _FIGURES))
    return shown


def _change(pair: list[float] | None) -> str:
    if pair is None:
        return "-"
    earlier, now = pair
    ratio = now / earlier if earlier else float("inf")
    colour = "red" if ratio > NOTICEABLE else "green" if ratio < 1 / NOTICEABLE else "default"
    return f"{earlier:.3g} > {now:.3g} [{colour}]x{ratio:.2f}[/]"

"""`tactomo bench --compare`: what has become slower or larger since an earlier `bench --json`.

Live latency in milliseconds, which holds for one machine.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from tactomo_models.foreign_file import MAX_TEXT_BYTES, read_regular

from tactomo.cli.output import table
from tactomo.errors import TactomoError

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

Row = dict[str, Any]  # see `compared`

# What is compared of a row, and its key there.
FIGURES: Final = {"p50": "latency_p50_ms", "p99": "latency_p99_ms", "memory_mb": "memory_mb"}
NOTICEABLE: Final = 1.3  # ratio that is marked; p50s of two runs on a busy machine: up to 1.3


def read_results(path: Path) -> Mapping[str, Any]:
    """Return what an earlier run has printed with --json.

    Raises TactomoError where it cannot be read, or is something else.
    """
    try:
        results = json.loads(read_regular(path, MAX_TEXT_BYTES))
        _by_scene(results)
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise TactomoError(
            f"cannot compare with {path}: {error}", "write one with: tactomo bench --json > FILE"
        ) from error
    return dict(results)


def compared(earlier: Mapping[str, Any], now: Mapping[str, Any]) -> list[Row]:
    """Set the rows of two runs beside each other.

    Returns:
        A row for each scene that both have measured: `what`, and p50, p99 (ms) and memory_mb as
        [earlier, now], None where one of them has no figure.
    """
    before = _by_scene(earlier)
    rows = []
    for scene, row in _by_scene(now).items():
        if scene in before:
            pairs = {name: [before[scene].get(key), row.get(key)] for name, key in FIGURES.items()}
            both = {name: None if None in pair else pair for name, pair in pairs.items()}
            rows.append({"what": f"live: {scene}", **both})
    return rows


def _by_scene(results: Mapping[str, Any]) -> dict[str, Row]:
    return {row["scene"]: row for row in results["live"]}


def table_of(rows: Iterable[Row], path: Path) -> Table:
    """Lay out a comparison; what has grown noticeably is red, what has shrunk so is green."""
    shown = table("measured", "p50 ms", "p99 ms", "memory MB", title=f"{path}, and now")
    for row in rows:
        shown.add_row(row["what"], *(_change(row[figure]) for figure in FIGURES))
    return shown


def _change(pair: list[float] | None) -> Text:
    from rich.text import Text

    if pair is None:
        return Text("-")
    earlier, now = pair
    ratio = now / earlier if earlier else float("inf")
    colour = "red" if ratio > NOTICEABLE else "green" if ratio < 1 / NOTICEABLE else "default"
    return Text(f"{earlier:.3g} > {now:.3g} ").append(f"x{ratio:.2f}", colour)

"""The tables of a page of documentation."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def table(page: str, heading: str, first: str = "") -> dict[str, dict[str, str]]:
    """Return the first table after a heading of a page: by the first cell, cells by their column.

    Args:
        page: its path in the repository.
        heading: the whole line.
        first: name of the table's first column; that of any table if empty.
    """
    after = (ROOT / page).read_text("utf-8").partition(f"\n{heading}\n")[2]
    assert after, f"{page} has no {heading!r}"
    start = rf"\| {first} \|" if first else r"\|"
    found = re.search(rf"^({start}.*\n)\|[-|]+\n((?:\|.*\n)+)", after, re.M)
    assert found, f"{page} has no table after {heading!r}"
    names, *rows = [cells(line) for line in (found[1] + found[2]).splitlines()]
    return {row[0].strip("`"): dict(zip(names, row, strict=True)) for row in rows}


def cells(line: str) -> list[str]:
    """Return the cells of a table's line; a bar that is escaped is one of text."""
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]

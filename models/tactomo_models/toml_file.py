"""TOML files, which users write, damage and mistake for others."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, Final

from tactomo_models.foreign_file import MAX_TEXT_BYTES, read_regular

MAX_DOTS: Final = 500  # in a line: what a key of many parts costs to read grows by its square


def read_toml(path: Path) -> dict[str, Any]:
    """Return what is in a TOML file.

    Raises:
        OSError: the file cannot be read, is no regular file, or larger than anything of ours.
        ValueError: it is not TOML, not UTF-8, or deeper than anything of ours.
    """
    # some editors mark it
    return parse_toml(read_regular(path, MAX_TEXT_BYTES).decode("utf-8-sig"))


def parse_toml(text: str) -> dict[str, Any]:
    """Return what a text of TOML says; raise ValueError where it is none."""
    if max(line.count(".") for line in text.split("\n")) > MAX_DOTS:
        raise ValueError(f"a line of it has more than {MAX_DOTS} dots; break it")
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise ValueError("its tables and lists are nested too deeply") from error

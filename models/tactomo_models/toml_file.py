"""TOML files, which users write, damage and mistake for others."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, Final

MAX_TOML_BYTES: Final = 1 << 20  # a description has some thousand


def read_toml(path: Path) -> dict[str, Any]:
    """Return what is in a TOML file.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not TOML, not UTF-8, or larger or deeper than anything of ours.
    """
    with path.open("rb") as file:
        data = file.read(MAX_TOML_BYTES + 1)
    if len(data) > MAX_TOML_BYTES:
        raise ValueError(f"it has more than {MAX_TOML_BYTES} bytes")
    return parse_toml(data.decode("utf-8-sig"))  # some editors mark it


def parse_toml(text: str) -> dict[str, Any]:
    """Return what a text of TOML says; raise ValueError where it is none."""
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise ValueError("its tables and lists are nested too deeply") from error

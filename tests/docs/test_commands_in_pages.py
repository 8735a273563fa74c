"""Commands in the pages that people read: each is one of ours, with options that it has."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from page import Page
from tactomo.cli import app
from typer.main import get_command

ROOT = Path(__file__).parents[2]
PAGES = [
    *(ROOT / "README.md", ROOT / "deploy" / "README.md"),
    *sorted((ROOT / "docs").glob("*.md")),
]
SETTINGS = sorted(
    path for path in (ROOT / "deploy").rglob("*.*") if path.suffix not in (".md", ".py", ".sh")
)


def told(page: Path) -> list[str]:
    """What follows `tactomo` in blocks of shell commands, and between backquotes."""
    read = Page(page.relative_to(ROOT).as_posix())
    lines = [line.split("#")[0] for line in read.commands()]
    if page in SETTINGS:
        lines = re.findall(r"^# +(tactomo .*)", read.text, re.M)
    spans = [" ".join(span.split()) for span in re.findall(r"`(tactomo [^`]+)`", read.text)]
    found = [re.search(r"\btactomo ([a-z][^|>]*)", line) for line in [*lines, *spans]]
    return [each[1].strip() for each in found if each]


def options_of(words: list[str]) -> tuple[str, set[str]]:
    """The command that some words name, and its options."""
    command: Any = get_command(app)
    name = "tactomo"
    for word in words:
        is_group = hasattr(command, "get_command")
        below = command.get_command(None, word) if is_group else None
        if below is None:
            assert not is_group or not word.isalpha(), f"{name} {word}"
            break
        command, name = below, f"{name} {word}"
    return name, {
        flag for each in command.params for flag in (*each.opts, *each.secondary_opts, "--help")
    }


@pytest.mark.parametrize("page", [*PAGES, *SETTINGS], ids=lambda p: p.name)
def test_each_option_is_one_that_the_command_has(page: Path) -> None:
    for line in told(page):
        name, options = options_of(line.split())
        assert name != "tactomo", line
        unknown = set(re.findall(r"(?<=\s)--[a-z][a-z0-9-]*", f" {line}")) - options
        assert not unknown, f"{name}: {line}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_each_make_has_its_target(page: Path) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.M))
    assert set(re.findall(r"(?:^|`)make ([a-z-]+)", page.read_text("utf-8"), re.M)) <= targets

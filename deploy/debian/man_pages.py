"""Write a man page of each command from what its --help says: `man_pages.py FOLDER`.

In the macros of man(7). The tools that make such pages (click-man, help2man) know neither the
commands that are imported when they are called nor the Markdown of their texts.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import typer
from tactomo.cli import app
from typer.main import get_command


def main(folder: Path) -> None:
    """Write tactomo.1, tactomo-daemon.1 and so on."""
    folder.mkdir(parents=True, exist_ok=True)
    for context in _contexts(typer.Context(get_command(app), info_name="tactomo")):
        name = context.command_path.replace(" ", "-")
        (folder / f"{name}.1").write_text("\n".join(_page(name, context)) + "\n", "utf-8")


def _contexts(context: Any) -> Iterator[Any]:
    yield context
    for name, command in _commands(context):
        yield from _contexts(typer.Context(command, info_name=name, parent=context))


def _commands(context: Any) -> list[tuple[str, Any]]:
    names = context.command.list_commands(context) if hasattr(context.command, "commands") else []
    return [(name, context.command.get_command(context, name)) for name in names]


def _page(name: str, context: Any) -> Iterator[str]:
    command = context.command
    paragraphs = (command.help or "").split("\n\n")
    yield f'.TH "{name.upper()}" 1 "" "tactomo {version("tactomo")}"'
    yield from (".SH NAME", _roff(f"{name} - {command.get_short_help_str(200)}"))
    usage = " ".join(command.collect_usage_pieces(context))
    yield from (".SH SYNOPSIS", f".B {context.command_path}", _roff(usage))
    yield ".SH DESCRIPTION"
    for paragraph in paragraphs:
        yield from (".PP", _roff(" ".join(paragraph.split())))
    options = [each.get_help_record(context) for each in command.get_params(context)]
    commands = [(each, sub.get_short_help_str(200)) for each, sub in _commands(context)]
    for title, rows in (("OPTIONS", list(filter(None, options))), ("COMMANDS", commands)):
        yield from [f".SH {title}"] if rows else []
        for term, words in rows:
            yield from (".TP", f".B {_roff(term)}", _roff(words))
    yield ".SH EXAMPLES"
    for example in re.findall(r"`([^`]+)`", command.epilog or ""):
        yield from (".PP", _roff(example))


def _roff(text: str) -> str:
    """Escape what roff would take for its own, and leave out Markdown's marks."""
    plain = re.sub(r"`|\*+(?=\w)|(?<=\w)\*+", "", text)
    return re.sub(r"^([.'])", r"\\&\1", plain.replace("\\", r"\e").replace("-", r"\-"))


if __name__ == "__main__":
    main(Path(sys.argv[1]))

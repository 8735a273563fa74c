"""STREAM.md against the programs: its tables have every field, flag, event and command, no more.

What is written there from the schema is held to it by `tests/clients/test_schema.py`.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import tactomo
import tactomo.stream.control
import tactomo.twin.control
from tables import table as cells_of
from tactomo.acquisition.port import TROUBLES
from tactomo.errors import CommandError
from tactomo.service import metrics
from tactomo_client.schema import EVENTS, TOUCHES_SEEN
from tactomo_models import Flag

DOCUMENT_FOLDER = Path(__file__).parents[3] / "clients"
DOCUMENT = (DOCUMENT_FOLDER / "STREAM.md").read_text("utf-8")


def table(heading: str, column: str = "Name") -> set[str]:
    """Return the names in the first column of the first such table after a heading or a word."""
    firsts = cells_of("clients/STREAM.md", heading, column)
    return {name for first in firsts for name in re.findall(r"\w+", first)}


def of_status(heading: str) -> dict[str, str]:
    """Return the meaning of each row of a table of the document."""
    rows = cells_of("clients/STREAM.md", heading)
    return {name: row["Meaning"] for name, row in rows.items()}


def test_every_flag_is_explained() -> None:
    assert table("## Flags", "Flag") == {flag.name.lower() for flag in Flag if flag.name}


def test_the_clients_know_of_which_flags_touches_are_seen() -> None:
    rows = cells_of("clients/STREAM.md", "## Flags")
    seen = {name for name, row in rows.items() if row["Touches seen"] == "yes"}
    assert seen == TOUCHES_SEEN
    page = (DOCUMENT_FOLDER / "viewer/tactomo_viewer/page/health.js").read_text("utf-8")
    for source in (page, DOCUMENT):
        listed = re.search(r"TOUCHES_SEEN = [{[]([^}\]]*)[}\]]", source)
        assert listed
        assert set(re.findall(r'"(\w+)"', listed[1])) == seen
    after = DOCUMENT.partition("\n## Stale, or nothing pressed?\n")[2].partition("\n1. ")[0]
    assert set(re.findall(r"`(\w+)`", after)) == seen | {"is_known"}


def test_every_state_is_listed_and_scraped() -> None:
    told = re.findall(r"`(\w+)`", of_status("### `status`")["state"])
    assert tuple(told) == metrics.STATES


@cache
def sources() -> dict[Path, ast.Module]:
    """The daemon's modules."""
    paths = Path(tactomo.__path__[0]).rglob("*.py")
    return {path: ast.parse(path.read_text("utf-8")) for path in paths}


def test_every_event_is_listed_and_told() -> None:
    assert {kind.end for kind in EVENTS.values() if kind.end} <= EVENTS.keys()
    told = {name for tree in sources().values() for name in events_told(tree)}
    assert told | {name for name, _ in TROUBLES.values()} == EVENTS.keys()


def events_told(source: ast.AST) -> Iterator[str]:
    """Yield the names that a module tells as events, written out where they are told."""
    for call in ast.walk(source):
        if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Attribute):
            continue
        name = call.args[0] if call.args else None
        if call.func.attr in ("_on_event", "_tell") and isinstance(name, ast.Constant):
            yield str(name.value)


def test_every_error_of_a_command_is_listed() -> None:
    served = [tree for path, tree in sources().items() if "cli" not in path.parts]
    raised = {name for tree in served for name in refusals(tree)}
    listed = cells_of("clients/STREAM.md", "### Errors")
    assert listed.keys() == raised | {"malformed_message"}
    commands = {*tactomo.stream.control.COMMANDS, *tactomo.twin.control.COMMANDS}
    for row in listed.values():
        assert set(re.findall(r"`(\w+)`", row["Commands"])) <= commands


def refusals(source: ast.AST) -> Iterator[str]:
    """Yield the names of the errors that a module refuses commands with."""
    for call in ast.walk(source):
        if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name):
            continue
        given = [keyword.value for keyword in call.keywords if keyword.arg == "name"]
        named = [each.value for each in [*call.args[2:3], *given] if isinstance(each, ast.Constant)]
        if call.func.id == "CommandError":
            yield str(named[0]) if named else CommandError.name
        elif call.func.id == "RecordingError" and named == ["cannot_write"]:
            yield "cannot_write"


@pytest.mark.parametrize(
    ("heading", "commands"),
    [
        ("### Commands of the daemon", tactomo.stream.control.COMMANDS),
        ("### Commands of the twin", tactomo.twin.control.COMMANDS),
    ],
)
def test_every_command_is_listed(heading: str, commands: dict[str, Any]) -> None:
    assert table(heading, "Command") == set(commands)
    rows = cells_of("clients/STREAM.md", heading)
    for names, row in rows.items():
        assert row["Since"] == "1"
        for command in re.findall(r"\w+", names):
            assert commands[command].model_fields.keys() <= set(
                re.findall(r"`(\w+)`", row["Arguments"])
            ), command

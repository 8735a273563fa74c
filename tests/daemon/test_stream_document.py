"""STREAM.md against the programs: its tables have every field, flag, event and command, no more."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import tactomo
import tactomo.control
import tactomo.twin.control
from tactomo_models import METHODS, Flag, Tier
from tactomo_models.reconstruct import BAD_MISFIT, UNSURE_MISFIT

DOCUMENT = (Path(__file__).parents[2] / "clients" / "STREAM.md").read_text("utf-8")


def table(heading: str, column: str = "Name") -> set[str]:
    """Return the names in the first column of the first such table after a heading or a word."""
    after = DOCUMENT.partition(f"\n{heading}\n")[2]
    assert after, f"STREAM.md has no {heading!r}"
    rows = re.search(rf"^\| {column} \|.*\n\|[-|]+\n((?:\|.*\n)+)", after, re.M)
    assert rows, f"STREAM.md has no table of {column} after {heading!r}"
    firsts = [row.split("|")[1] for row in rows[1].splitlines()]
    return {name for first in firsts for name in re.findall(r"`(\w+)`", first)}


ENVELOPE = table("### Envelope")


def test_every_field_is_in_a_table_and_every_row_is_sent(bench: Callable[..., Any]) -> None:
    daemon = bench(ports=1)
    daemon.tare()
    daemon.step(load=0.5)
    listener = daemon.listener
    status = listener.wait("status", lambda s: s["ports"][0]["device"] and s["reference"])
    messages = {"status": status, "map": listener.of("map")[-1]}
    messages |= {kind: listener.of(kind)[-1] for kind in ("contacts", "scan", "event")}
    for kind, fields in messages.items():
        assert fields.keys() == ENVELOPE | table(f"### `{kind}`"), kind
    contact = messages["contacts"]["contacts"][0]
    assert contact.keys() == table("Each contact:")
    assert messages["map"]["contacts"] == [contact]
    assert status["description"].keys() == table("`description`:")
    assert status["ports"][0].keys() == table("Each of `ports`:")
    assert messages["map"]["map"].keys() == table("### Arrays")
    assert daemon.ask("status").keys() == status.keys()


def test_every_flag_is_explained() -> None:
    assert table("## Flags", "Flag") == {flag.name.lower() for flag in Flag if flag.name}


def test_every_method_can_be_asked_for_by_its_name() -> None:
    asked = re.search(r"^\| `set_tier` \| `tier` \(str\): (.*?)\|", DOCUMENT, re.M)
    made = re.search(r"^\| `tier` \|.*?How much model the frame was given: (.*)\|", DOCUMENT, re.M)
    assert asked
    assert made
    assert re.findall(r"`(\S+)`", asked[1]) == list(METHODS)
    assert re.findall(r"`(\S+)`", made[1]) == [tier for tier in Tier if tier is not Tier.AUTO]


def test_it_says_from_what_misfit_on_a_frame_is_flagged() -> None:
    row = re.search(r"^\| `misfit` .*", DOCUMENT, re.M)
    assert row
    assert f"above {BAD_MISFIT:g} the frame" in row[0]
    assert f"above {UNSURE_MISFIT:g} over both" in row[0]


def test_every_event_is_listed() -> None:
    source = "".join(p.read_text("utf-8") for p in Path(tactomo.__path__[0]).glob("*.py"))
    told = set(re.findall(r"\b_?on_event\(\s*\"(\w+)\"", source))
    assert table("### `event`", "Event") == told


@pytest.mark.parametrize(
    ("heading", "commands"),
    [
        ("### Commands of the daemon", tactomo.control.COMMANDS),
        ("### Commands of the twin", tactomo.twin.control.COMMANDS),
    ],
)
def test_every_command_is_listed(heading: str, commands: dict[str, Any]) -> None:
    assert table(heading, "Command") == set(commands)

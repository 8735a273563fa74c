"""A subscriber that holds every message against STREAM.md: its tables, and the rules between them.

Written from the page alone: it shares no line with `tactomo_client`, which is asked as well.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from functools import cache
from types import UnionType
from typing import Any

import msgpack  # type: ignore[import-untyped]
from ears import listening
from tables import table
from tactomo_client.messages import EVENT, MAP, STATUS, decode_message, frame_from_message
from tactomo_client.schema import Status
from waiting import InThread

PAGE = "clients/STREAM.md"
INT64, UINT64 = range(-(2**63), 2**63), range(2**64)
MAX_ENTRIES, MAX_DEPTH, MAX_NAME_BYTES = 4096, 16, 48
NAMES = ("session", "tier", "flags", "name", "state")
CHANGING_PLACES = 64
"""Scans that are between two places of the tally when it is read: some reads of two ports."""
ITEM_BYTES = {"<f4": 4, "<f8": 8}
INSIDE = {
    ("map", "contacts"): "Each contact:",
    ("contacts", "contacts"): "Each contact:",
    ("status", "ports"): "Each of `ports`:",
    ("status", "description"): "`description`:",
    ("description", "calibration"): "`calibration`:",
}


class Subscriber(InThread):
    """Hears every kind from a thread of its own, until closed; usable in a `with` block.

    Args:
        address: of the stream.
        may_miss: whether a gap in `sequence` is none of the daemon's faults, because frames come
            faster than this reads them.

    Attributes:
        messages: how many came, by kind.
        missed: how many did not, by their sequence.
        faults: which rules they broke, in words; the first hundred.

    """

    def __init__(self, address: str, *, may_miss: bool = False) -> None:
        self.messages: dict[str, int] = {}
        self.missed = 0
        self.faults: list[str] = []
        self._sequence: dict[tuple[str, str], int] = {}
        self._may_miss = may_miss
        self._address = address
        super().__init__()

    def _run(self) -> None:
        with listening(self._address, b"") as socket:
            while not self._closing.is_set():
                if socket.poll(50):
                    self._take(socket.recv_multipart())

    def _take(self, parts: list[bytes]) -> None:
        try:
            found = list(self._broken(parts))
        except Exception as error:  # whatever a reader stumbles over is a fault of the message
            found = [f"{type(error).__name__}: {error}"]
        self.faults = (self.faults + found)[:100]

    def _broken(self, parts: list[bytes]) -> Iterator[str]:
        if len(parts) != 1:
            yield f"{len(parts)} parts"
        topic, _, body = parts[0].partition(b"\0")
        sensor, kind = topic.decode("ascii").split("/")
        fields = msgpack.unpackb(body)
        self.messages[kind] = self.messages.get(kind, 0) + 1
        if (fields["schema"], fields["sensor"], fields["kind"]) != (1, sensor, kind):
            yield f"{kind}: topic and body disagree"
        yield from broken_values(kind, fields)
        yield from broken_fields(kind, fields, "### Envelope", f"### `{kind}`")
        yield from self._broken_order(kind, fields)
        yield from broken_contacts(kind, fields.get("contacts", []))
        yield from broken_words(kind, fields)
        if kind == STATUS:
            yield from broken_tally(fields["scan_tally"])
        read_by_the_client(parts[0])

    def _broken_order(self, kind: str, fields: dict[str, Any]) -> Iterator[str]:
        at = (fields["session"], kind)
        before, now = self._sequence.get(at), fields["sequence"]
        is_repeated = kind == STATUS and now == before
        if before is not None and now != before + 1 and not is_repeated:
            if now <= before or not self._may_miss:
                yield f"{kind}: sequence {now} after {before}"
            self.missed += max(0, now - before - 1)
        self._sequence[at] = now
        age_ns = fields["age_ns"]
        if age_ns is not None and age_ns < 0:
            yield f"{kind}: age_ns {age_ns}"
        if (fields["acquired_monotonic_ns"] is None) != (age_ns is None):
            yield f"{kind}: an age without a date, or a date without an age"


def broken_values(kind: str, value: Any, path: str = "", depth: int = 0) -> Iterator[str]:
    """Yield what no value of any message may be, by the section on messages."""
    if isinstance(value, dict | list):
        if len(value) > MAX_ENTRIES or depth > MAX_DEPTH:
            yield f"{kind}{path}: {len(value)} entries, {depth} deep"
        each = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inside in each:
            yield from broken_values(kind, inside, f"{path}.{key}", depth + 1)
    elif isinstance(value, float) and not math.isfinite(value):
        yield f"{kind}{path}: {value}"
    elif isinstance(value, int) and not isinstance(value, bool):
        within = UINT64 if path == ".sequence" else INT64
        if value not in within:
            yield f"{kind}{path}: {value}"


def broken_fields(kind: str, fields: dict[str, Any], *headings: str) -> Iterator[str]:
    """Yield what breaks the tables after these headings: fields there and absent, and types."""
    rows = {name: row for heading in headings for name, row in rows_of(heading).items()}
    for name in fields.keys() - rows.keys():
        yield f"{kind}.{name} is in no table"
    for name, wanted in rows.items():
        if name not in fields:
            yield f"{kind} has no {name}"
            continue
        value = fields[name]
        if not has_type(value, wanted):
            yield f"{kind}.{name} is {str(value)[:80]}, not {wanted}"
        if name in NAMES:
            each = value if isinstance(value, list) else [value or ""]
            if any(len(text.encode()) > MAX_NAME_BYTES for text in each):
                yield f"{kind}.{name} is {value}"
        heading = INSIDE.get((kind, name))
        if heading is not None and value is not None:
            for inside in value if isinstance(value, list) else [value]:
                yield from broken_fields(name, inside, heading)


@cache
def rows_of(heading: str) -> dict[str, str]:
    """Return the type of each field in the first table after a heading."""
    rows = table(PAGE, heading, "Name")
    return {name: row["Type"] for key, row in rows.items() for name in re.findall(r"\w+", key)}


def has_type(value: Any, wanted: str) -> bool:
    """Tell whether a value is of a type as the tables write it."""
    if wanted.endswith(" or nil"):
        return value is None or has_type(value, wanted.removesuffix(" or nil"))
    if wanted.startswith("array"):
        return is_array(value, re.findall(r"`(\S+)`", wanted))
    if wanted.startswith("["):
        return isinstance(value, list) and len(value) == wanted.count(",") + 1
    if wanted.startswith(("list of ", "map of ")):
        container, _, items = wanted.partition(" of ")
        each = value.values() if container == "map" and isinstance(value, dict) else value
        kind = dict if container == "map" else list
        one = items.removesuffix("s") if items in ("maps", "ints") else items
        return isinstance(value, kind) and all(has_type(item, one) for item in each)
    kinds: dict[str, type | UnionType] = {
        **{"int": int, "str": str, "bool": bool, "map": dict, "list": list},
        "float": float | int,
    }
    return isinstance(value, kinds[wanted]) and isinstance(value, bool) == (wanted == "bool")


def is_array(value: Any, dtypes: list[str]) -> bool:
    """Tell whether a value is an array of one of these types whose data fill its shape."""
    if not isinstance(value, dict) or value.keys() != {"shape", "dtype", "data"}:
        return False
    size = math.prod(value["shape"]) * ITEM_BYTES.get(value["dtype"], 0)
    return value["dtype"] in dtypes and len(value["data"]) == size


def broken_contacts(kind: str, contacts: list[dict[str, Any]]) -> Iterator[str]:
    """Yield what contacts may not be, beyond their types."""
    identities = [contact["id"] for contact in contacts]
    if len(set(identities)) != len(identities):
        yield f"{kind}: two contacts of one id"
    for contact in contacts:
        if contact["area_mm2"] <= 0:
            yield f"{kind}: a contact of {contact['area_mm2']} mm2"
        if contact["pressure_range"] not in ("within", "below", "above", "unknown"):
            yield f"{kind}: pressure_range {contact['pressure_range']}"


def broken_words(kind: str, fields: dict[str, Any]) -> Iterator[str]:
    """Yield names that the page does not have, and contacts where there can be none."""
    flags = set(fields["flags"])
    if unlisted := flags - names_in("## Flags", "Flag"):
        yield f"{kind}: flags {unlisted}"
    if kind == EVENT and fields["name"] not in names_in("### `event`", "Event"):
        yield f"event {fields['name']}"
    if kind == STATUS and fields["state"] not in states():
        yield f"state {fields['state']}"
    is_empty = fields["tier"] == "quiet" or "no_usable_scan" in flags
    if fields.get("contacts") and is_empty:
        yield f"{kind}: contacts, and {fields['tier']} {flags}"


@cache
def names_in(heading: str, column: str) -> frozenset[str]:
    """Return the names in the first column of a table of the page."""
    return frozenset(table(PAGE, heading, column))


@cache
def states() -> frozenset[str]:
    """Return the states of a daemon that the page has."""
    return frozenset(
        re.findall(r"`(\w+)`", table(PAGE, "### `status`", "Name")["state"]["Meaning"])
    )


def broken_tally(tally: dict[str, int]) -> Iterator[str]:
    """Yield where single scans are lost from sight."""
    places = sum(tally.values()) - tally["received"]
    if abs(places - tally["received"]) > CHANGING_PLACES:
        yield f"scan_tally: {tally}"


def read_by_the_client(data: bytes) -> None:
    """Read a message as users do; raises what they would get."""
    message = decode_message(data)
    if message.kind == STATUS:
        Status.from_fields(message.fields, 0, 1.0)
    elif message.kind in (MAP, "contacts"):
        frame_from_message(message, 0, 1.0)

"""PROTOCOL.md against the codec: each field where, as what and under which name a table says."""

from __future__ import annotations

import struct
from dataclasses import fields
from enum import IntEnum
from typing import Any

import numpy as np
import pytest
from cobs import cobs
from tables import table
from tactomo_protocol import (
    Acknowledge,
    AckStatus,
    Channel,
    Command,
    CommandCode,
    CompanionReading,
    Hello,
    Packet,
    SampleFormat,
    Scan,
    ScanFlag,
    encode,
)

PAGE = "firmware_protocol/PROTOCOL.md"
CODES = {"u8": "<B", "u16": "<H", "u32": "<I", "u64": "<Q", "f32": "<f", "f64": "<d"}
LAYOUT = {"checksum", "reserved", "count", "sample_format", ""}
"""Names of what is in a frame and no field of the packet, or not of every one."""
BOTH = (Channel.MAGNITUDE, Channel.STRUCTURE)
PACKETS: list[tuple[str, Packet]] = [
    (
        "### Scan (0x01, device to host)",
        Scan(Channel.STRUCTURE, 7_000_001, 2**40 + 9, ScanFlag.LATE, np.arange(3, dtype=np.int32)),
    ),
    (
        "### Hello (0x02, device to host)",
        Hello("left", "1.2", BOTH, 16, 3, 5, 208, SampleFormat.INT32, 2.5e-9, 19.5),
    ),
    ("### Acknowledge (0x03, device to host)", Acknowledge(9, CommandCode.STOP, AckStatus.BUSY)),
    (
        "### Companion (0x04, device to host)",
        CompanionReading(3, ScanFlag.SATURATED, 2**41 + 5, 123.5),
    ),
    ("### Command (0x81, host to device)", Command(CommandCode.SET_RATE, 77, 12.5)),
]


def value_of(packet: Packet, name: str) -> Any:
    """Return what a row of this name is to hold."""
    if name == "channels":
        return sum(1 << channel.number for channel in BOTH)
    if name == "count":
        return 3
    if name == "sample_format":
        return SampleFormat.INT32
    value = getattr(packet, name)
    return value.number if isinstance(value, Channel) else value


@pytest.mark.parametrize(("heading", "packet"), PACKETS)
def test_every_field_is_where_its_row_says(heading: str, packet: Packet) -> None:
    payload = cobs.decode(encode(packet).strip(b"\0"))
    rows = table(PAGE, heading)
    named = {row["name"] for row in rows.values()}
    assert named - LAYOUT == {field.name for field in fields(packet)} - LAYOUT
    end = 2
    for offset, row in rows.items():
        assert row["since"] == "1"
        if not offset.isdecimal():
            continue
        assert int(offset) == end, row
        end = int(offset) + (int(row["size"]) if row["size"].isdecimal() else 0)
        if row["type"] in CODES and row["name"] not in ("", "checksum"):
            (found,) = struct.unpack_from(CODES[row["type"]], payload, int(offset))
            assert struct.calcsize(CODES[row["type"]]) == int(row["size"])
            assert found == value_of(packet, row["name"]), row


@pytest.mark.parametrize(
    ("heading", "column", "enumeration"),
    [
        ("### Scan (0x01, device to host)", "flag", ScanFlag),
        ("### Acknowledge (0x03, device to host)", "status", AckStatus),
        ("### Command (0x81, host to device)", "code", CommandCode),
    ],
)
def test_every_number_has_its_name(heading: str, column: str, enumeration: type[IntEnum]) -> None:
    rows = table(PAGE, heading, column)
    told = {int(number, 0): row["name"].upper() for number, row in rows.items() if row["name"]}
    assert told == {int(each): each.name for each in enumeration}

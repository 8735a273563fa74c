"""The fields of one record of a recording, as they are in the file."""

from __future__ import annotations

from typing import Any

import msgpack  # type: ignore[import-untyped]
from tactomo_client.messages import MAX_ENTRIES

from tactomo.errors import RecordingError


def read_reference_number(data: bytes) -> int | None:
    """Return which of its recording's references a message holds; None in old recordings."""
    number = record_fields(data).get("number")
    if number is not None and type(number) is not int:
        raise malformed()
    return number


def record_fields(data: bytes) -> dict[str, Any]:
    """Return the fields of a record; raise RecordingError where it has none."""
    try:
        fields = msgpack.unpackb(data, max_array_len=MAX_ENTRIES, max_map_len=MAX_ENTRIES)
    except Exception as error:  # msgpack raises of many kinds
        raise malformed() from error
    if not isinstance(fields, dict):
        raise malformed()
    return fields


def malformed() -> RecordingError:
    """The error of a record that tactomo does not write."""
    return RecordingError(
        "the recording holds records that tactomo does not write",
        "another version or another program made it: record again",
    )

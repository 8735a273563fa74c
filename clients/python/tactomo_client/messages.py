"""The stream's and the control socket's messages, between Python values and bytes.

STREAM.md is the specification and this module its only Python implementation: the daemon publishes
through it, the twin answers through it, this client and the viewer read through it. Whatever bytes
arrive, decoding either returns a message that keeps the rules checked here or raises
`MessageError`, and nothing else.

A stream message is one ZeroMQ part: topic ``<sensor>/<kind>``, a NUL byte, one MessagePack map.

NumPy is imported with the first array: a command that only asks for a status does without it.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgpack  # type: ignore[import-untyped]

from tactomo_client.errors import MessageError, control_error
from tactomo_client.filled import array_from_wire as array_from_wire
from tactomo_client.filled import array_to_wire as array_to_wire
from tactomo_client.filled import filled, readers_of
from tactomo_client.schema import Contacts, Envelope, Frame, wire_fields

SCHEMA: Final = 1
DEFAULT_STREAM: Final = "tcp://127.0.0.1:5560"
DEFAULT_CONTROL: Final = "tcp://127.0.0.1:5561"
DEFAULT_TWIN_CONTROL: Final = "tcp://127.0.0.1:5562"

MAP: Final = "map"
CONTACTS: Final = "contacts"
SCAN: Final = "scan"
STATUS: Final = "status"
EVENT: Final = "event"
KINDS: Final = (MAP, CONTACTS, SCAN, STATUS, EVENT)

MAX_MESSAGE_BYTES: Final = 16 * 1024 * 1024
MAX_REQUEST_BYTES: Final = 64 * 1024
MAX_ENTRIES: Final = 4096  #: of one list or map
MAX_DEPTH: Final = 16  #: of lists and maps in each other

_SENSOR_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_KIND_NAME = re.compile(r"[a-z][a-z_]{0,31}")


class Message(NamedTuple):
    """One decoded stream message; arrays in `fields` are still in their wire form."""

    sensor: str
    kind: str
    fields: dict[str, Any]


def check_sensor_name(name: str, of: str = "sensor") -> str:
    """Return `name` if it may stand in a topic; raise MessageError saying what is allowed."""
    if not isinstance(name, str) or not _SENSOR_NAME.fullmatch(name):
        raise MessageError(
            f"{name!r} is not a {of} name",
            "use 1 to 64 letters, digits, '_', '-' or '.', starting with a letter or digit",
        )
    return name


def topic(sensor: str, kind: str) -> bytes:
    """Return what to subscribe to for one kind of message of one sensor.

    The closing NUL belongs to it: without it `left` would also receive what `left/map2` sends.
    """
    if not isinstance(kind, str) or not _KIND_NAME.fullmatch(kind):
        raise MessageError(f"{kind!r} is not a kind of message", f"known kinds: {', '.join(KINDS)}")
    return f"{check_sensor_name(sensor)}/{kind}".encode() + b"\0"


def encode_message(sensor: str, kind: str, fields: Mapping[str, Any]) -> bytes:
    """Return the bytes of one stream message; raise MessageError where a value has no wire form.

    `fields` are the header (STREAM.md, "Envelope") without `schema`, `sensor` and `kind`, and the
    kind's own. NumPy arrays and scalars may stand anywhere; NaN is allowed in arrays, while an
    unknown value is None.
    """
    head = topic(sensor, kind)
    _check_header(fields)
    return head + _pack({"schema": SCHEMA, "sensor": sensor, "kind": kind, **fields}, "replace")


def decode_message(data: bytes) -> Message:
    """Return the message in `data`, its header checked; raise MessageError for anything else.

    Fields that this version does not know are kept: later versions may add some.
    """
    head, separator, body = bytes(data).partition(b"\0")
    if not separator:
        raise MessageError("no NUL byte between topic and body")
    sensor, slash, kind = head.decode("ascii", "replace").partition("/")
    if not slash or topic(sensor, kind) != head + b"\0":
        raise MessageError(f"topic {head[:80]!r} is not <sensor>/<kind>")
    fields = _unpack_map(body)
    if fields.get("sensor") != sensor or fields.get("kind") != kind:
        raise MessageError(f"topic {head!r} and body disagree about sensor or kind")
    _check_header(fields)
    return Message(sensor, kind, fields)


@functools.cache
def clock_id() -> str:
    """Return the identity of this computer's monotonic clock, "" where it has none.

    Two processes that see the same non-empty identity read the same monotonic clock, so that one
    may compute the exact age of what the other stamped.
    """
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()
    except OSError:
        return ""


def encode_request(command: str, arguments: Mapping[str, Any]) -> bytes:
    """Return the bytes of one control request; raise MessageError if they are too many.

    The daemon hangs up on whoever sends more, without an answer.
    """
    data = _pack({"schema": SCHEMA, "command": command, "arguments": dict(arguments)})
    if len(data) > MAX_REQUEST_BYTES:
        raise MessageError(f"a request of {len(data)} bytes is over {MAX_REQUEST_BYTES}")
    return data


def decode_request(data: bytes) -> tuple[str, dict[str, Any]]:
    """Return the command and arguments of a control request; raise MessageError if it is none."""
    fields = _unpack_map(data, object_pairs_hook=_without_repeats)
    command, arguments = fields.get("command"), fields.get("arguments", {})
    further = fields.keys() - {"schema", "command", "arguments"}
    if further or not isinstance(command, str) or not isinstance(arguments, dict):
        raise MessageError("a request is {schema, command: string, arguments: map}, no more")
    return command, arguments


def encode_reply(result: Mapping[str, Any]) -> bytes:
    """Return the bytes of the reply to a command that was carried out."""
    return _pack({"schema": SCHEMA, "ok": True, "result": dict(result)}, "replace")


def encode_error(name: str, cause: str, next_step: str = "") -> bytes:
    """Return the bytes of the reply to a command that was not carried out."""
    error = {"name": name, "cause": cause, "next_step": next_step}
    return _pack({"schema": SCHEMA, "ok": False, "error": error}, "replace")


def decode_reply(data: bytes) -> dict[str, Any]:
    """Return the result in a control reply.

    Raises:
        ControlError: the command was refused; name, cause and next step are the server's.
        MessageError: the bytes are no reply.
    """
    fields = _unpack_map(data)
    result, error = fields.get("result"), fields.get("error")
    if fields.get("ok") is True and isinstance(result, dict):
        return result
    if fields.get("ok") is False and isinstance(error, dict):
        name, cause, next_step = (error.get(key) for key in ("name", "cause", "next_step"))
        if isinstance(name, str) and isinstance(cause, str) and isinstance(next_step, str):
            raise control_error(cause, next_step, name)
    raise MessageError("a reply is {schema, ok: true, result} or {schema, ok: false, error}")


def _pack(fields: Mapping[str, Any], no_text: str = "strict") -> bytes:
    """Return what goes onto the wire; `no_text` says what becomes of a name that is no text."""
    try:
        data: bytes = msgpack.packb(fields, default=_numpy_to_wire, unicode_errors=no_text)
    except MessageError:
        raise
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise MessageError(f"a value has no wire form: {error}") from error
    if len(data) > MAX_MESSAGE_BYTES:
        raise MessageError(f"a message of {len(data)} bytes is over {MAX_MESSAGE_BYTES}")
    return data


def _numpy_to_wire(value: object) -> object:
    import numpy as np

    if isinstance(value, np.ndarray):
        return array_to_wire(value)
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _without_repeats(pairs: Iterable[tuple[Any, Any]]) -> dict[Any, Any]:
    """Return a map; a key that comes twice would mean one thing here and another elsewhere."""
    listed = list(pairs)
    fields = dict(listed)
    if len(fields) < len(listed):
        raise ValueError("a key comes twice")
    return fields


def _unpack_map(data: bytes, **options: Any) -> dict[str, Any]:
    if len(data) > MAX_MESSAGE_BYTES:
        raise MessageError(f"a message of {len(data)} bytes is over {MAX_MESSAGE_BYTES}")
    try:
        limits = {"max_array_len": MAX_ENTRIES, "max_map_len": MAX_ENTRIES}
        fields = msgpack.unpackb(data, **limits, **options)
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise MessageError(f"the body is not MessagePack: {error}") from error
    except MemoryError as error:
        raise MessageError("the body is larger than this computer's memory") from error
    _check_depth(fields)
    if not isinstance(fields, dict) or not all(isinstance(key, str) for key in fields):
        raise MessageError("the body is not a map with string keys")
    if type(fields.get("schema")) is not int or fields["schema"] != SCHEMA:
        raise MessageError(
            f"schema {str(fields.get('schema'))[:20]} is not {SCHEMA}",
            "install the tactomo-client of the daemon's version",
        )
    return fields


def _check_depth(fields: Any) -> None:
    level = [fields] if type(fields) in (dict, list) else []
    for _ in range(MAX_DEPTH):
        inner = [v for each in level for v in (each.values() if type(each) is dict else each)]
        level = [value for value in inner if type(value) is dict or type(value) is list]
        if not level:
            return
    raise MessageError(f"the body is nested more than {MAX_DEPTH} deep")


def _check_header(fields: Mapping[str, Any]) -> None:
    readers, required = readers_of(Envelope)
    if missing := required - fields.keys():
        raise MessageError(f"field {min(missing)!r} is missing")
    for name in readers.keys() & fields.keys():
        readers[name](name, fields[name])


_IMAGES = dict.fromkeys(set(wire_fields(Frame)) - set(wire_fields(Contacts)))


def frame_from_message(message: Message, received_ns: int | None, stale_after_s: float) -> Frame:
    """Return the frame in a `map` or `contacts` message, which is stale from `stale_after_s` on.

    `received_ns` is when the message came, by the monotonic clock; None for a recorded one. Raises
    MessageError where a field is missing or of the wrong type.
    """
    fields = message.fields
    has_images = message.kind == MAP
    frame = filled(
        Frame,
        fields,
        _age_at_receipt_ns=age_at_receipt_ns(fields, received_ns),
        _received_ns=received_ns,
        _stale_after_s=stale_after_s,
        **({} if has_images else _IMAGES),
    )
    if has_images and (frame.x_mm is None or frame.y_mm is None):
        raise MessageError("field 'x_mm' or 'y_mm' is missing")
    return frame


def age_at_receipt_ns(fields: dict[str, Any], received_ns: int | None) -> int:
    """Return the age in ns of a message that came at `received_ns` (monotonic; None: recorded).

    Exact where publisher and subscriber read the same clock; otherwise the age at publication,
    which leaves out the time that the message was on its way.
    """
    acquired_ns: int | None = fields["acquired_monotonic_ns"]
    age_at_publication_ns: int | None = fields["age_ns"]
    is_our_clock = bool(clock_id()) and fields.get("clock_id") == clock_id()
    if received_ns is not None and acquired_ns is not None and is_our_clock:
        return max(0, received_ns - acquired_ns)
    return max(0, age_at_publication_ns or 0)

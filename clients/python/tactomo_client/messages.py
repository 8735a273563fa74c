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
import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeGuard

import msgpack  # type: ignore[import-untyped]

from tactomo_client.errors import MessageError, control_error

if TYPE_CHECKING:
    from numpy.typing import NDArray

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
MAX_ENTRIES: Final = 4096  #: of one list or map
MAX_DEPTH: Final = 16  #: of lists and maps in each other
MAX_ARRAY_VALUES: Final = 1024 * 1024
MAX_ARRAY_DIMENSIONS: Final = 4
ARRAY_DTYPES: Final = ("<f4", "<f8", "<i2", "<i4", "<i8", "<u2", "<u4", "<u8", "|i1", "|u1")

_SENSOR_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_KIND_NAME = re.compile(r"[a-z][a-z_]{0,31}")
_INT64 = range(-(2**63), 2**63)
_UINT64 = range(2**64)

# Header field -> (accepted types, may be nil, may be left out). STREAM.md has the meanings.
_HEADER: Final[dict[str, tuple[tuple[type, ...], bool, bool]]] = {
    "session": ((str,), False, False),
    "sequence": ((int,), False, False),
    "acquired_realtime_ns": ((int,), True, False),
    "acquired_monotonic_ns": ((int,), True, False),
    "delay_ns": ((int,), True, True),
    "dated_by": ((str,), True, True),
    "device_us": ((int,), True, False),
    "skew_ms": ((float, int), True, True),
    "age_ns": ((int,), True, False),
    "tier": ((str,), True, False),
    "tier_reason": ((str,), True, False),
    "flags": ((list, tuple), False, False),
    "misfit": ((float, int), True, False),
    "confidence": ((float, int), True, True),
    "clock_id": ((str,), False, True),
}


class Message(NamedTuple):
    """One decoded stream message; arrays in `fields` are still in their wire form."""

    sensor: str
    kind: str
    fields: dict[str, Any]


def check_sensor_name(name: str) -> str:
    """Return `name` if it may stand in a topic; raise MessageError saying what is allowed."""
    if not isinstance(name, str) or not _SENSOR_NAME.fullmatch(name):
        raise MessageError(
            f"{name!r} is not a sensor name",
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
    """Return the bytes of one stream message.

    Args:
        sensor: the sensor's name.
        kind: one of KINDS.
        fields: the header (STREAM.md, "Envelope") without `schema`, `sensor` and `kind`, which are
            filled in here, and the kind's own fields. NumPy arrays and scalars may stand anywhere
            in it; NaN is allowed in arrays, while a single unknown value is None.

    Raises:
        MessageError: a header field is missing or of the wrong type, or a value has no wire form.
    """
    head = topic(sensor, kind)
    _check_header(fields)
    return head + _pack({"schema": SCHEMA, "sensor": sensor, "kind": kind, **fields})


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


def array_to_wire(array: NDArray[Any]) -> dict[str, Any]:
    """Return `array` (any shape of up to 4 dimensions, real numbers) as its wire map."""
    import numpy as np

    dtype = array.dtype.newbyteorder("<")
    if dtype.str not in ARRAY_DTYPES:
        raise MessageError(f"arrays of {array.dtype} have no wire form", f"use {ARRAY_DTYPES}")
    if array.ndim not in range(1, MAX_ARRAY_DIMENSIONS + 1) or array.size > MAX_ARRAY_VALUES:
        raise MessageError(f"an array of shape {array.shape} is too large for a message")
    data = np.ascontiguousarray(array, dtype=dtype).tobytes()
    return {"shape": list(array.shape), "dtype": dtype.str, "data": data}


def array_from_wire(value: object) -> NDArray[Any]:
    """Return the array of a wire map, read-only and without copying; raise MessageError if bad."""
    import numpy as np

    if not isinstance(value, dict):
        raise MessageError("an array is not a map of shape, dtype and data")
    shape, dtype_name, data = value.get("shape"), value.get("dtype"), value.get("data")
    if not isinstance(dtype_name, str) or dtype_name not in ARRAY_DTYPES:
        raise MessageError(f"array dtype {str(dtype_name)[:40]!r} is not one of {ARRAY_DTYPES}")
    if (
        not isinstance(shape, list)
        or not 1 <= len(shape) <= MAX_ARRAY_DIMENSIONS
        or not all(type(n) is int and 0 <= n <= MAX_ARRAY_VALUES for n in shape)
    ):
        raise MessageError(f"array shape {str(shape)[:80]} is not 1 to 4 lengths")
    dtype = np.dtype(dtype_name)
    size = math.prod(shape)
    if size > MAX_ARRAY_VALUES:
        raise MessageError(f"an array of shape {shape} is larger than {MAX_ARRAY_VALUES} values")
    if not isinstance(data, bytes) or len(data) != size * dtype.itemsize:
        raise MessageError(f"array data do not fill shape {shape} of {dtype_name}")
    return np.frombuffer(data, dtype=dtype).reshape(shape)


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
    """Return the bytes of one control request."""
    return _pack({"schema": SCHEMA, "command": command, "arguments": dict(arguments)})


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
    return _pack({"schema": SCHEMA, "ok": True, "result": dict(result)})


def encode_error(name: str, cause: str, next_step: str = "") -> bytes:
    """Return the bytes of the reply to a command that was not carried out."""
    error = {"name": name, "cause": cause, "next_step": next_step}
    return _pack({"schema": SCHEMA, "ok": False, "error": error})


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


def _pack(fields: Mapping[str, Any]) -> bytes:
    try:
        data: bytes = msgpack.packb(fields, default=_numpy_to_wire)
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


def is_integer(value: object, within: range = _INT64) -> TypeGuard[int]:
    """Whether a value is an integer that its field has room for."""
    return isinstance(value, int) and not isinstance(value, bool) and value in within


def _is_finite(value: object) -> bool:
    return not isinstance(value, float) or math.isfinite(value)


def _check_header(fields: Mapping[str, Any]) -> None:
    for name, (types, may_be_nil, may_be_absent) in _HEADER.items():
        if name not in fields:
            if may_be_absent:
                continue
            raise MessageError(f"header field {name!r} is missing")
        value = fields[name]
        if value is None and may_be_nil:
            continue
        if not isinstance(value, types) or isinstance(value, bool):
            raise MessageError(f"header field {name!r} is a {type(value).__name__}")
        within = _UINT64 if name == "sequence" else _INT64
        if not (is_integer(value, within) if types == (int,) else _is_finite(value)):
            raise MessageError(f"header field {name!r} is {value}")
    if not all(isinstance(flag, str) for flag in fields["flags"]):
        raise MessageError("header field 'flags' holds something that is not a string")

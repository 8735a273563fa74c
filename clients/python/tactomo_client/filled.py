"""Values of the wire: arrays, and dataclasses filled from maps, each checked by its annotation.

What a dataclass has no name for is left out, as STREAM.md asks of readers: later versions add
fields. What a message does not have takes the dataclass's default: earlier versions sent less.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
import types
from collections.abc import Callable, Mapping
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Final,
    Self,
    TypeAlias,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

from tactomo_client.errors import MessageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Image: TypeAlias = NDArray[np.float32]
    Volts: TypeAlias = NDArray[np.float64]
else:

    class Image:
        """A float32 array (ny, nx)."""

    class Volts:
        """A float64 array (M,)."""


T = TypeVar("T")
Reader = Callable[[str, object], Any]

MAX_ARRAY_VALUES: Final = 1024 * 1024
MAX_ARRAY_DIMENSIONS: Final = 4
ARRAY_DTYPES: Final = ("<f4", "<f8", "<i2", "<i4", "<i8", "<u2", "<u4", "<u8", "|i1", "|u1")
_INT64: Final = range(-(2**63), 2**63)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Received:
    """A message that has come, by its fields."""

    #: The whole message, as in STREAM.md
    fields: Mapping[str, Any] = dataclasses.field(default_factory=dict, repr=False, compare=False)
    _received_ns: int = dataclasses.field(default=0, repr=False, compare=False)
    _stale_after_s: float = dataclasses.field(default=math.inf, repr=False, compare=False)

    @classmethod
    def from_fields(cls, fields: Mapping[str, Any], received_ns: int, stale_after_s: float) -> Self:
        """Return the message of these fields that came at `received_ns` by the monotonic clock.

        Raises MessageError where a field is missing or of the wrong type.
        """
        return filled(
            cls, fields, fields=fields, _received_ns=received_ns, _stale_after_s=stale_after_s
        )

    @property
    def age_s(self) -> float:
        """Seconds since the message came."""
        return (time.monotonic_ns() - self._received_ns) * 1e-9

    @property
    def is_stale(self) -> bool:
        """Whether the message came longer ago than the subscription's `stale_after_s`."""
        return self.age_s > self._stale_after_s


def filled(cls: type[T], fields: Mapping[str, Any], /, **own: Any) -> T:
    """Return a dataclass with the values of a map, and those of its `own` that no message has.

    Raises:
        MessageError: a field is missing that has no default, or is of the wrong type.
    """
    kind: Any = cls
    readers, required = readers_of(kind)
    if missing := required - fields.keys() - own.keys():
        raise MessageError(f"field {min(missing)!r} is missing")
    names = fields.keys() & readers.keys() - own.keys()
    return cls(**{name: readers[name](name, fields[name]) for name in names}, **own)


@functools.cache
def readers_of(cls: Any) -> tuple[dict[str, Reader], set[str]]:
    """Return what reads each field from the wire, and the names of those without a default."""
    hints = get_type_hints(cls, include_extras=True)
    public = [field for field in dataclasses.fields(cls) if not field.name.startswith("_")]
    nothing = dataclasses.MISSING
    required = {f.name for f in public if f.default is nothing and f.default_factory is nothing}
    return {field.name: _reader(hints[field.name]) for field in public}, required


def _reader(hint: Any) -> Reader:
    """Return what turns a value from the wire into one of the annotated type, or complains."""
    kind, inner = get_origin(hint), get_args(hint)
    if hint is Any:
        return lambda _, value: value
    if hint is Image:
        return _image
    if hint is int:
        return lambda name, value: _integer(name, value, _INT64)
    if kind is Annotated:
        return lambda name, value: _integer(name, value, inner[1])
    if kind is types.UnionType:
        return _optional(_reader(inner[0]))
    if kind is Mapping:
        return _mapping(_reader(inner[1]))
    if kind in (tuple, frozenset):
        return _sequence(kind, [_reader(each) for each in inner if each is not Ellipsis])
    if dataclasses.is_dataclass(hint):
        inside: Any = hint
        return lambda name, value: filled(inside, _checked(name, value, dict))
    if hint is float:
        return _number
    return lambda name, value: _checked(name, value, hint)


def _optional(read: Reader) -> Reader:
    return lambda name, value: None if value is None else read(name, value)


def _mapping(read: Reader) -> Reader:
    def read_all(name: str, value: object) -> Mapping[str, Any]:
        items = _checked(name, value, dict).items()
        return {str(key): read(f"{name}.{key}", each) for key, each in items}

    return read_all


def _sequence(kind: Callable[[Any], Any], read: list[Reader]) -> Reader:
    def read_all(name: str, value: object) -> Any:
        values = _checked(name, value, (list, tuple))
        readers = read if len(read) > 1 else read * len(values)
        if len(readers) != len(values):
            raise MessageError(f"field {name!r} has {len(values)} values and not {len(readers)}")
        return kind(one(name, each) for one, each in zip(readers, values, strict=True))

    return read_all


def _image(name: str, value: object) -> Any:
    image = array_from_wire(value)
    if image.ndim != 2 or image.dtype.name != "float32":
        raise MessageError(f"field {name!r} is not a two-dimensional array of float32")
    return image


def _integer(name: str, value: object, within: range) -> int:
    if (number := _checked(name, value, int)) not in within:
        raise MessageError(f"field {name!r} is {number}, beyond 64 bits")
    return int(number)


def _number(name: str, value: object) -> float:
    if not math.isfinite(number := float(_checked(name, value, (int, float)))):
        raise MessageError(f"field {name!r} is {number}")
    return number


def _checked(name: str, value: object, kind: Any) -> Any:
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise MessageError(f"field {name!r} is a {type(value).__name__}")
    return value


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

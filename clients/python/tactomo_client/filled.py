"""Dataclasses filled from a message's maps, each value checked against its annotation.

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
from typing import Any, Self, TypeVar, get_args, get_origin, get_type_hints

from tactomo_client.errors import MessageError

T = TypeVar("T")
Reader = Callable[[str, object], Any]


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

        Raises:
            MessageError: a field is missing or of the wrong type.
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
    readers, required = _readers(kind)
    if missing := required - fields.keys() - own.keys():
        raise MessageError(f"field {min(missing)!r} is missing")
    names = fields.keys() & readers.keys() - own.keys()
    return cls(**{name: readers[name](name, fields[name]) for name in names}, **own)


@functools.cache
def _readers(cls: Any) -> tuple[dict[str, Reader], set[str]]:
    """Return what reads each field from the wire, and the names of those without a default."""
    hints = get_type_hints(cls)
    public = [field for field in dataclasses.fields(cls) if not field.name.startswith("_")]
    nothing = dataclasses.MISSING
    required = {f.name for f in public if f.default is nothing and f.default_factory is nothing}
    return {field.name: _reader(hints[field.name]) for field in public}, required


def _reader(hint: Any) -> Reader:
    """Return what turns a value from the wire into one of the annotated type, or complains."""
    kind, inner = get_origin(hint), get_args(hint)
    if hint is Any:
        return lambda _, value: value
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
        return lambda name, value: float(_checked(name, value, (int, float)))
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
        values = _checked(name, value, list)
        readers = read if len(read) > 1 else read * len(values)
        if len(readers) != len(values):
            raise MessageError(f"field {name!r} has {len(values)} values and not {len(readers)}")
        return kind(one(name, each) for one, each in zip(readers, values, strict=True))

    return read_all


def _checked(name: str, value: object, kind: Any) -> Any:
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise MessageError(f"field {name!r} is a {type(value).__name__}")
    return value

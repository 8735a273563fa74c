"""Finds a device protocol by its name, as python-can finds its interfaces.

A distribution brings protocols by entry points of the group `tactomo.protocols`; ours come the same
way:

    [project.entry-points."tactomo.protocols"]
    my_board = "my_module:MyProtocol"

Whoever starts a program may also name a class that no distribution registers, as
`--protocol my_module:MyProtocol`; the module is looked for in the working folder, too. From then on
this process knows the class by its `name`. Neither a recording nor a socket can name a module.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import cache
from importlib.metadata import entry_points
from typing import Any, Final, Protocol

from tactomo_models import SensorDescription

from tactomo.errors import ConfigError
from tactomo.protocols.interface import PortProtocol

GROUP: Final = "tactomo.protocols"
NATIVE: Final = "tactomo"  # the protocol of `firmware_protocol/PROTOCOL.md`
WHERE: Final = "run in its folder, or set PYTHONPATH"
_MEMBERS: Final = ("name", "baud", "recognises", "feed", "introduction", "preamble")

_named: dict[str, ProtocolClass] = {}  # by `name`: classes that the user named at the start


class ProtocolClass(Protocol):
    """The class of a protocol: what is registered."""

    name: str
    baud: int
    emulator: str

    def __call__(self, description: SensorDescription | None) -> PortProtocol:
        """Return the protocol of one port; raise ConfigError where it cannot carry the sensor."""

    def recognises(self, data: bytes) -> bool:
        """Tell whether bytes from anywhere in a stream are likely of this protocol."""


def available_protocols() -> tuple[str, ...]:
    """Return the names that may be given: the native one, then the others."""
    return tuple(sorted({*_installed(), *_named}, key=lambda name: (name != NATIVE, name)))


def find_protocol(name: str) -> ProtocolClass:
    """Return the protocol that whoever starts the program gave: a name or `my_module:MyProtocol`.

    Raises:
        ConfigError: there is no such protocol, or it cannot be imported.
    """
    if ":" not in name:
        return _registered(name)
    from tactomo_models.methods.registry import search_working_folder  # takes a second to import

    search_working_folder()
    found: ProtocolClass = _load(name)
    missing = [member for member in _MEMBERS if not hasattr(found, member)]
    if missing or not isinstance(found, type):
        raise ConfigError(
            f"{name} is no protocol: {f'no {missing[0]}' if missing else 'it is no class'}",
            "derive it from tactomo.protocols.ForeignProtocol",
        )
    if found.name in _installed():
        raise ConfigError(
            f"{name} calls itself {found.name!r}, as an installed protocol does",
            "give the class another `name`",
        )
    return _named.setdefault(found.name, found)


def protocol_named(name: str, description: SensorDescription | None) -> PortProtocol:
    """Return the protocol of that name, for one port.

    Args:
        name: one of `available_protocols`.
        description: the sensor's. The native protocol does without; foreign devices do not say
            what they measure.

    Raises:
        ConfigError: there is no such protocol, or it cannot carry the description's channels.
    """
    kind = _registered(name)
    try:
        return kind(description)
    except ConfigError:
        raise
    except Exception as error:  # somebody else's class: anything may go wrong in it
        sensor = "no sensor" if description is None else description.name
        raise ConfigError(
            f"protocol {name} cannot be set up for {sensor}: {type(error).__name__}: {error}",
            "correct its __init__, or give another description",
        ) from error


def emulator_of(name: str) -> Callable[[SensorDescription, float], Any]:
    """Return what the twin emulates a protocol's device with, see `tactomo.twin.foreign`.

    Raises:
        ConfigError: the protocol names none, or the one that it names cannot be imported.
    """
    path = _registered(name).emulator
    if not path:
        raise ConfigError(
            f"the twin does not speak the protocol {name!r}",
            "give its class `emulator = 'my_module:MyBoard'`, see tactomo.twin.foreign.Emulator",
        )
    made: Callable[[SensorDescription, float], Any] = _load(path)
    return made


def recognised(data: bytes) -> str | None:
    """Return the protocol that these bytes are of; None where they are of none."""
    for name in available_protocols():
        try:
            if _registered(name).recognises(data):
                return name
        except Exception:  # an installed protocol that is broken says nothing of other ones
            continue
    return None


def _registered(name: str) -> ProtocolClass:
    if name in _named:
        return _named[name]
    if name not in _installed():
        raise ConfigError(
            f"there is no protocol {name!r}",
            f"use one of: {', '.join(available_protocols())}; or one of your own, as "
            "my_module:MyProtocol",
        )
    kind: ProtocolClass = _load(_installed()[name])
    return kind


def _load(path: str) -> Any:
    """Return the attribute that `my_module:MyProtocol` names."""
    module_name, _, attribute = path.partition(":")
    if not all(part.isidentifier() for part in (*module_name.split("."), attribute)):
        raise ConfigError(f"{path!r} names no class", "give it as my_module:MyProtocol")
    try:
        module = importlib.import_module(module_name)
    except Exception as error:  # somebody else's module: anything may go wrong in it
        raise ConfigError(
            f"cannot import {module_name}: {type(error).__name__}: {error}", WHERE
        ) from error
    try:
        return getattr(module, attribute)
    except AttributeError as error:
        raise ConfigError(f"{module_name} has no {attribute}", "check the name") from error


@cache
def _installed() -> dict[str, str]:
    return {point.name: point.value for point in entry_points(group=GROUP)}

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
from typing import TYPE_CHECKING, Any, Final

from tactomo.errors import ConfigError
from tactomo.protocols.interface import PortProtocol

if TYPE_CHECKING:
    from tactomo_models import SensorDescription

GROUP: Final = "tactomo.protocols"
NATIVE: Final = "tactomo"  # the protocol of `firmware_protocol/PROTOCOL.md`
WHERE: Final = "run in its folder, or set PYTHONPATH"
_MEMBERS: Final = ("name", "baud", "recognises", "feed", "introduction", "preamble")

_named: dict[str, type[PortProtocol]] = {}  # by `name`: classes that the user named at the start


def available_protocols() -> tuple[str, ...]:
    """Return the names that may be given: the native one, then the others."""
    return tuple(sorted({*_installed(), *_named}, key=lambda name: (name != NATIVE, name)))


def find_protocol(name: str) -> type[PortProtocol]:
    """Return the protocol of a name or of `my_module:MyProtocol`, or raise ConfigError."""
    if ":" not in name:
        return _registered(name)
    from tactomo_models.methods.registry import search_working_folder  # takes a second to import

    search_working_folder()
    found: type[PortProtocol] = _load(name)
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
    """Return the protocol of that name, for one port; the native one needs no description.

    Raises ConfigError where there is no such protocol, or it cannot carry the sensor's channels.
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
    """Return what the twin plays a protocol's device with, see `Emulator`; ConfigError for none."""
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


def _registered(name: str) -> type[PortProtocol]:
    if name in _named:
        return _named[name]
    if name not in _installed():
        raise ConfigError(
            f"there is no protocol {name!r}",
            f"use one of: {', '.join(available_protocols())}; or one of your own, as "
            "my_module:MyProtocol",
        )
    kind: type[PortProtocol] = _load(_installed()[name])
    return kind


def _load(path: str) -> Any:
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

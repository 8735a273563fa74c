"""The languages that a port can speak: ours, and those of other people's devices.

`interface` says what a port needs of each, and has what the foreign ones share.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from tactomo_models import SensorDescription

from tactomo.errors import ConfigError
from tactomo.protocols.interface import ForeignProtocol, PortProtocol, Reading, Trouble
from tactomo.protocols.matrix import Matrix
from tactomo.protocols.openeit import OpenEit
from tactomo.protocols.ours import Ours
from tactomo.protocols.sciospec import Sciospec

__all__ = [
    "FOREIGN",
    "OURS",
    "PROTOCOLS",
    "ForeignProtocol",
    "PortProtocol",
    "Reading",
    "Trouble",
    "default_baud",
    "protocol_named",
    "recognised",
]

OURS: Final = Ours.name
FOREIGN: Final[Mapping[str, type[ForeignProtocol]]] = {
    kind.name: kind for kind in (Sciospec, OpenEit, Matrix)
}
PROTOCOLS: Final = (OURS, *FOREIGN)


def protocol_named(name: str, description: SensorDescription | None) -> PortProtocol:
    """Return the protocol of that name, for one port.

    Args:
        name: one of `PROTOCOLS`.
        description: the sensor's. Ours does without; foreign devices do not say what they measure.

    Raises:
        ConfigError: there is no such protocol, or it cannot carry the description's channels.

    """
    if name == OURS:
        return Ours()
    if name not in FOREIGN or description is None:
        raise ConfigError(f"there is no protocol {name!r}", f"use one of: {', '.join(PROTOCOLS)}")
    return FOREIGN[name](description)


def default_baud(name: str) -> int:
    """Return the baud rate of a protocol's devices, where they have a real UART."""
    return FOREIGN[name].baud if name in FOREIGN else Ours.baud


def recognised(data: bytes) -> str | None:
    """Return the foreign protocol that these bytes are of; None where they are of none."""
    return next((name for name, kind in FOREIGN.items() if kind.recognises(data)), None)

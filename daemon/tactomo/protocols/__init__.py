"""The languages that a port can speak: the native one, and those of other people's devices.

`interface` says what a port needs of each, and has what the foreign ones share; `registry` finds
them by name.
"""

from tactomo.protocols.interface import (
    ForeignProtocol,
    PortProtocol,
    Reading,
    Trouble,
)
from tactomo.protocols.lines import LineProtocol
from tactomo.protocols.registry import (
    NATIVE,
    available_protocols,
    emulator_of,
    find_protocol,
    protocol_named,
    recognised,
)

__all__ = [
    "NATIVE",
    "ForeignProtocol",
    "LineProtocol",
    "PortProtocol",
    "Reading",
    "Trouble",
    "available_protocols",
    "emulator_of",
    "find_protocol",
    "protocol_named",
    "recognised",
]

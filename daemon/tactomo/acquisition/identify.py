"""Asking whoever is at a serial port who it is.

The question is a packet of our protocol, in which no other device known here finds a command. One
that sends all the same is known by what it sends; one that waits to be started stays silent.
"""

from __future__ import annotations

import time
from typing import Final

from tactomo_protocol import Command, CommandCode, Decoder, Hello, encode

from tactomo.acquisition.connection import Connection
from tactomo.protocols import recognised

PATIENCE_S: Final = 2.5
"""A device says hello every second, and within one of the reset that opening a port may cause."""
ASK_AGAIN_S: Final = 0.5
_REMEMBERED: Final = 65_536  # bytes; several frames of any protocol


def identify(path: str, baud: int, patience_s: float = PATIENCE_S) -> Hello | str:
    """Open a port, ask for a hello for a bounded time, and close the port; raises nothing.

    Returns the hello, or in words why there is none.
    """
    connection = Connection(path, baud, lambda *_: None)
    if not connection.try_open():
        return connection.problem
    try:
        return _converse(connection, baud, patience_s)
    finally:
        connection.close()


def _converse(connection: Connection, baud: int, patience_s: float) -> Hello | str:
    decoder, received = Decoder(), b""
    end_s, ask_s = time.monotonic() + patience_s, 0.0
    while connection.is_open and (now_s := time.monotonic()) < end_s:
        if now_s >= ask_s:
            connection.write(encode(Command(CommandCode.IDENTIFY, 1)))
            ask_s = now_s + ASK_AGAIN_S
        data = connection.read()
        received = (received + data)[-_REMEMBERED:]
        for packet in decoder.feed(data):
            if isinstance(packet, Hello):
                return packet
    return connection.problem or _silence(received, decoder.counts.packets, baud)


def _silence(received: bytes, packets: int, baud: int) -> str:
    if packets:
        return "the device sends packets, but no hello"
    protocol = recognised(received)
    if protocol is not None:
        return f"no hello, but what it sends looks like --protocol {protocol}"
    if received:
        return f"bytes and no packet at {baud} baud: no skin, or another baud rate"
    return "no answer; a device of another --protocol may wait for a start command"

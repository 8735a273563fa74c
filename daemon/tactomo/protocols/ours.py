"""Our own protocol, of `firmware_protocol/PROTOCOL.md`: packets as they are."""

from __future__ import annotations

import math
from typing import Final

from tactomo_protocol import (
    MAX_FRAME_BYTES,
    Command,
    CommandCode,
    Decoder,
    DecoderCounts,
    Hello,
    Packet,
    encode,
)

from tactomo.protocols.interface import Trouble


class Ours:
    """See `PortProtocol`."""

    name: Final = "tactomo"
    baud: Final = 921_600
    patience_s: Final = 1.5
    preamble_period_s: Final = math.inf  # the device itself says hello every second
    says_hello: Final = True
    has_clock: Final = True
    trouble: Trouble | None = None

    def __init__(self) -> None:
        self._decoder = Decoder()
        self._hello: Hello | None = None
        self._tail = b""  # bytes from the last delimiter on, where a recording may begin
        self._request = 0

    @property
    def counts(self) -> DecoderCounts:
        """What the decoder has met so far."""
        return self._decoder.counts

    def feed(self, data: bytes) -> list[Packet]:
        """Decode."""
        delimiter = data.rfind(0)
        self._tail = (self._tail + data)[-MAX_FRAME_BYTES:] if delimiter < 0 else data[delimiter:]
        packets = self._decoder.feed(data)
        for packet in packets:
            if isinstance(packet, Hello):
                self._hello = packet
        return packets

    def replies(self) -> list[bytes]:
        """Return nothing: the device needs no answers."""
        return []

    def introduction(self) -> list[bytes]:
        """Ask who it is, and to start; harmless where it has started already."""
        return self._commands(CommandCode.IDENTIFY, CommandCode.START)

    def zero_counters(self) -> list[bytes]:
        """Ask to count from 0 again, and to scan."""
        return self._commands(CommandCode.ZERO_COUNTERS, CommandCode.START)

    def stop(self) -> list[bytes]:
        """Return nothing: another program may be listening on the device's other port."""
        return []

    def restart(self) -> None:
        """Forget the packet that had begun."""
        self._tail = b""

    def preamble(self) -> bytes:
        """Return the hello in force and the packet that has begun."""
        return (b"" if self._hello is None else encode(self._hello)) + self._tail

    def _commands(self, *codes: CommandCode) -> list[bytes]:
        commands = []
        for code in codes:
            self._request = (self._request + 1) % 256
            commands.append(encode(Command(code, self._request)))
        return commands

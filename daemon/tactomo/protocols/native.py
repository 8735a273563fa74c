"""Our own protocol, of `firmware_protocol/PROTOCOL.md`: packets as they are."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

from tactomo_protocol import (
    MAX_FRAME_BYTES,
    Command,
    CommandCode,
    CompanionReading,
    Decoder,
    Hello,
    Packet,
    encode,
)

from tactomo.protocols.interface import KEPT_READINGS, PortProtocol

if TYPE_CHECKING:
    from tactomo_models import SensorDescription


class NativeProtocol(PortProtocol):
    """See `PortProtocol`; `description` is not needed."""

    name = "tactomo"
    baud = 921_600
    patience_s = 1.5
    preamble_period_s = math.inf  # the device itself says hello every second
    says_hello = True
    has_clock = True
    acknowledges = True

    def __init__(self, description: SensorDescription | None = None) -> None:
        super().__init__(description)
        self._decoder = Decoder()
        self.counts = self._decoder.counts
        self._hello: Hello | None = None
        # the newest readings, by their companion's index
        self._readings: dict[int, deque[CompanionReading]] = {}
        self._tail = b""  # bytes from the last delimiter on, where a recording may begin
        self._request = 0

    def feed(self, data: bytes) -> list[Packet]:
        """Decode."""
        delimiter = data.rfind(0)
        self._tail = (self._tail + data)[-MAX_FRAME_BYTES:] if delimiter < 0 else data[delimiter:]
        packets = self._decoder.feed(data)
        for packet in packets:
            if isinstance(packet, Hello):
                self._hello = packet
            elif isinstance(packet, CompanionReading):
                kept = self._readings.setdefault(packet.index, deque(maxlen=KEPT_READINGS))
                kept.append(packet)
        self.fault = self._decoder.fault
        return packets

    def introduction(self) -> list[bytes]:
        """Ask who it is, and to start; harmless where it has started already."""
        return self._commands(CommandCode.IDENTIFY, CommandCode.START)

    def zero_counters(self) -> list[bytes]:
        """Ask to count from 0 again, and to scan."""
        return self._commands(CommandCode.ZERO_COUNTERS, CommandCode.START)

    def restart(self) -> None:
        """Forget the packet that had begun."""
        self._tail = b""
        self._decoder.restart()

    def preamble(self) -> bytes:
        """Return the hello in force, companions' newest readings, and the packet that has begun."""
        if self._hello is None:
            return self._tail
        readings = (encode(each) for kept in self._readings.values() for each in kept)
        return encode(self._hello) + b"".join(readings) + self._tail

    @classmethod
    def recognises(cls, data: bytes) -> bool:
        """Tell whether there is a whole packet in the bytes."""
        return bool(Decoder().feed(data))

    def _commands(self, *codes: CommandCode) -> list[bytes]:
        commands = []
        for code in codes:
            self._request = (self._request + 1) % 256
            commands.append(encode(Command(code, self._request)))
        return commands

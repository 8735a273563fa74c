"""What a port must know of the language that its device speaks.

There is one object for each port. The port's thread owns it; `counts`, `trouble` and the class's
constants may be read by others. Whatever a device says becomes packets of our own protocol, so that
nothing behind the port knows of another one.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar, Final, NamedTuple

import numpy as np
from tactomo_models.arrays import FloatArray, IntArray
from tactomo_protocol import (
    MAX_DEVICE_US,
    MAX_SAMPLES,
    SCAN_COUNTERS,
    Channel,
    CompanionReading,
    Decoder,
    DecoderCounts,
    Hello,
    Packet,
    SampleFormat,
    Scan,
    ScanFlag,
    UnknownPacket,
    encode,
)

from tactomo.errors import ConfigError

if TYPE_CHECKING:
    from tactomo_models import SensorDescription

KEPT_READINGS: Final = 32
"""Readings of each companion that a scan may be held against: those that come while it is taken."""


class Trouble(NamedTuple):
    """Why nothing can be made of what a device says."""

    cause: str
    next_step: str


def oriented(pairs: IntArray) -> dict[tuple[int, int], tuple[int, int]]:
    """Return each pair's row and the sign 1; of a pair that is exchanged, the sign is -1."""
    rows = list(enumerate(pairs.tolist()))
    exchanged = {(b, a): (row, -1) for row, (a, b) in rows}
    return exchanged | {(a, b): (row, 1) for row, (a, b) in rows}


TWIN_ID: Final = "twin-"
"""What the id of a simulated device begins with; its description's name follows."""


def hello_of(
    description: SensorDescription,
    channels: tuple[Channel, ...],
    device_id: str,
    firmware: str,
    rate_hz: float,
    sample_format: SampleFormat = SampleFormat.FLOAT32,
    volts_per_count: float = 1.0,
) -> Hello:
    """Return what a device that measures this sensor says of itself."""
    return Hello(
        device_id,
        firmware,
        channels,
        description.electrode_count,
        *description.offsets,
        description.measurements,
        sample_format,
        volts_per_count,
        rate_hz,
    )


class PortProtocol:
    """A language of devices, as one port speaks it; a subclass decodes with `feed`."""

    name: ClassVar[str]  #: in configurations, recordings and `status`
    baud: ClassVar[int] = 115_200  #: of a real UART, where the configuration names none
    #: ``my_module:MyBoard``, what the twin speaks the protocol with; may be empty
    emulator: ClassVar[str] = ""
    #: how long a device may send no scan before it is introduced to us again
    patience_s: float = 4.0
    #: how often a recording is given a preamble, for what comes after damage; may be inf
    preamble_period_s: float = 1.0
    says_hello: bool = False  #: whether a device says hello every second, scans or not
    has_clock: bool = False  #: whether scans say by the device's own clock when they were taken
    acknowledges: bool = False  #: whether a device answers every command
    fault: str = ""  #: which rule of the protocol the last intact message broke; empty for none
    counts: DecoderCounts  #: what was understood and what was not, over all connections
    #: why scans cannot be used at present; None where they can, or none came yet
    trouble: Trouble | None = None

    def __init__(self, description: SensorDescription | None) -> None:
        """Raise ConfigError where the protocol cannot carry the sensor."""
        if description is not None and description.measurements > MAX_SAMPLES:
            raise ConfigError(
                f"{description.name} has {description.measurements} voltages, and a scan at most "
                f"{MAX_SAMPLES}",
                "list fewer drive or measuring pairs in its [pattern]; files of any number of "
                "voltages are reconstructed by tactomo reconstruct",
            )

    @classmethod
    def recognises(cls, data: bytes) -> bool:
        """Tell whether these bytes, from anywhere in a stream, are likely of this protocol."""
        return False

    def feed(self, data: bytes) -> list[Packet]:
        """Return the packets completed by `data`; any bytes in any chunking, never raises."""
        raise NotImplementedError

    def replies(self) -> list[bytes]:
        """Return what is to be written now, after what was fed; each message is returned once."""
        return []

    def introduction(self) -> list[bytes]:
        """Return what is written to a newcomer, or one that is silent: who are you, and start."""
        return []

    def zero_counters(self) -> list[bytes]:
        """Return what has a device count from 0 again; nothing where there is no such thing."""
        return []

    def stop(self) -> list[bytes]:
        """Return what keeps a device from going on sending to nobody; nothing if it may go on."""
        return []

    def restart(self) -> None:
        """Take note that the port was opened anew: what had begun to come is not finished."""

    def preamble(self) -> bytes:
        """Return what a recording that begins now begins with.

        Fed to a new object before the bytes to come, it makes the same scans of them; fed to one
        that has lost bytes, too.
        """
        raise NotImplementedError


class Reading(NamedTuple):
    """One scan of a foreign device."""

    volts: FloatArray  #: (M,) in the description's order
    device_us: int = 0  #: by its clock; 0 where it has none
    #: readings of the description's companions by their names; NaN for one that has none now
    companions: Mapping[str, float] = MappingProxyType({})


_POSITION: Final = struct.Struct("<IQB")
_POSITION_TYPE: Final = 0x70  # PROTOCOL.md leaves it to experiments; no device of ours sends it


@dataclass
class ForeignCounts(DecoderCounts):
    """See `DecoderCounts`; what has no checksum is damaged where it cannot be read."""

    unreadable: int = 0  # no message of the protocol, or not all of one

    @property
    def damaged(self) -> int:
        """Messages that the line spoilt."""
        return super().damaged + self.unreadable


class ForeignProtocol(PortProtocol):
    """What the protocols of other people's devices have in common; a subclass parses.

    It makes up what such a device does not say: the hello, from the sensor's description, before
    the first scan, and the scans' counter, which goes on over all connections. The device carries
    the description's only channel; its scans are float32 volts in the description's order.
    Raises ConfigError where the description has two channels, or more voltages than a scan.
    """

    device_id: ClassVar[str]  #: what the device is called in `status`
    counts: ForeignCounts

    def __init__(self, description: SensorDescription | None, rate_hz: float = 0.0) -> None:
        if description is None:
            raise ConfigError(
                f"a device of protocol {self.name} does not say what it measures",
                "give the sensor's description",
            )
        if len(description.channels) != 1:
            raise ConfigError(
                f"{description.name} has two channels, and a device of protocol {self.name} "
                "carries one",
                "give the description of a sensor with one channel, such as tank_disc",
            )
        super().__init__(description)
        self.description = description
        self.counts = ForeignCounts()
        self._failure: Trouble | None = None  # a mistake of the subclass, the last one
        self.device_us = 0  #: the newest reading's time, to go on from
        #: of several that a device's clock may have, a number that `parse` understands
        self.clock_format = 0
        [self._channel] = description.channels
        self._rate_hz = rate_hz
        self._counter = 0
        self._has_greeted = False
        self._is_hello_due = True

    def feed(self, data: bytes) -> list[Packet]:
        """See `PortProtocol`."""
        packets: list[Packet] = []
        if data.startswith(b"\0"):
            data = self._resume(data, packets)
        try:
            for reading in self.parse(data):
                scan = self._scan(reading)
                if self._is_hello_due:
                    packets.append(self.hello())
                    self._has_greeted, self._is_hello_due = True, False
                packets += self._companions_of(reading)
                packets.append(scan)
                if self.trouble is self._failure:
                    self.trouble = None
        except Exception as error:  # a mistake in somebody's protocol: the port reads on
            self.counts.malformed += 1
            self.trouble = self._failure = Trouble(
                f"protocol {self.name} failed: {type(error).__name__}: {error}",
                "correct its `parse`, then start the daemon again",
            )
        return packets

    def parse(self, data: bytes) -> Iterator[Reading]:
        """Yield the readings that `data` completes, and count what was understood in `counts`."""
        raise NotImplementedError

    def begun(self) -> bytes:
        """Return the bytes of what has begun to come and is not complete, a few scans' at most.

        A recording begins with them; without them it begins with the next whole reading.
        """
        return b""

    def restart(self) -> None:
        """See `PortProtocol`: a hello is due again; a subclass forgets what has begun."""
        self._is_hello_due = True

    def preamble(self) -> bytes:
        """See `PortProtocol`: the hello, where in its scans this port is, and what has begun."""
        if not self._has_greeted:
            return b""
        body = _POSITION.pack(self._counter, self.device_us, self.clock_format)
        position = UnknownPacket(_POSITION_TYPE, body)
        return encode(self.hello()) + encode(position) + self.begun()

    def hello(self) -> Hello:
        """Return what the device would say of itself if it spoke our protocol."""
        firmware = f"protocol {self.name}"
        return hello_of(self.description, (self._channel,), self.device_id, firmware, self._rate_hz)

    def _scan(self, reading: Reading) -> Scan:
        samples = np.asarray(reading.volts, dtype=np.float32)
        if samples.shape != (self.description.measurements,):
            raise ValueError(
                f"volts of shape {samples.shape}, not ({self.description.measurements},)"
            )
        if not 0 <= reading.device_us <= MAX_DEVICE_US:
            raise ValueError(f"device_us is {reading.device_us}, not from 0 to {MAX_DEVICE_US}")
        self.device_us = reading.device_us
        counter, self._counter = self._counter, (self._counter + 1) % SCAN_COUNTERS
        return Scan(self._channel, counter, reading.device_us, ScanFlag(0), samples)

    def _companions_of(self, reading: Reading) -> Iterator[CompanionReading]:
        indices = {name: index for index, name in self.description.companion_indices.items()}
        for name, value in reading.companions.items():
            if name not in indices:
                raise ValueError(f"{self.description.name} has no companion {name}")
            yield CompanionReading(indices[name], ScanFlag(0), reading.device_us, float(value))

    def _resume(self, data: bytes, packets: list[Packet]) -> bytes:
        """Take a recording's preamble, if `data` is one; return what comes after it.

        Where nothing was lost before it, it says nothing new.
        """
        parts = data.split(b"\0", 4)  # two frames, each with both delimiters, and the rest
        if parts[0] or len(parts) < 5:
            return data
        rest = parts[4]
        match Decoder().feed(data[: len(data) - len(rest)]):
            case [Hello() as hello, UnknownPacket(type=0x70, body=body)] if (
                len(body) == _POSITION.size
            ):
                counter, device_us, clock_format = _POSITION.unpack(body)
            case _:
                return data
        if self._has_greeted and self._counter == counter:
            return b""
        self.restart()
        self._counter, self.device_us, self.clock_format = counter, device_us, clock_format
        self._has_greeted, self._is_hello_due = True, False
        packets.append(hello)
        return rest

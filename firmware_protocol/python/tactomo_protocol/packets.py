"""The packets of wire protocol v1 as values: what a device and a host can say to each other.

The classes here only hold fields; `codec` turns them into bytes and back. Byte layouts, ranges
and timing are specified in `firmware_protocol/PROTOCOL.md`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag, StrEnum, auto
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Samples: TypeAlias = NDArray[np.int16] | NDArray[np.int32] | NDArray[np.float32]


class Channel(StrEnum):
    """One of the two stacked skins, by its name; on the wire it is a number."""

    MAGNITUDE = auto()
    STRUCTURE = auto()

    @property
    def number(self) -> int:
        """The channel on the wire."""
        return _CHANNELS.index(self)

    @classmethod
    def of_number(cls, number: int) -> Channel:
        """Return the channel that a number on the wire means.

        Raises:
            ValueError: none has that number.
        """
        if number not in range(len(_CHANNELS)):
            raise ValueError(f"no channel has the number {number}")
        return _CHANNELS[number]


_CHANNELS = tuple(Channel)


class SampleFormat(IntEnum):
    """How a sample is written, always little-endian."""

    INT16 = 1
    INT32 = 2
    FLOAT32 = 3

    @property
    def dtype(self) -> np.dtype[Any]:
        """The NumPy type, in this machine's byte order, that holds these samples exactly."""
        return np.dtype(self.name.lower())


class ScanFlag(IntFlag):
    """What the device knows about the quality of a scan; bits unknown here are kept."""

    SATURATED = 1  # at least one sample is at the converter's limit
    LATE = 2  # the scan took longer, or left later, than the scan rate allows
    SIMULATED = 4  # no sensor made these samples


class CommandCode(IntEnum):
    """What a host can ask of a device."""

    IDENTIFY = 1
    START = 2
    STOP = 3
    SET_RATE = 4
    ZERO_COUNTERS = 5


class AckStatus(IntEnum):
    """What became of a command."""

    OK = 0
    UNKNOWN_COMMAND = 1
    BAD_ARGUMENT = 2
    BUSY = 3


SCAN_COUNTERS = 1 << 32  #: how many values a scan's counter has before it begins again at 0


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One channel's voltages of one scan.

    `counter` (u32, wraps to 0) is shared by the scans of both channels that belong together.
    `device_us` (below 2^53) is the device's clock, in µs, when the scan's first sample was taken.
    `samples` is 1-D, 1 to 1024 values of int16, int32 or float32; decoded ones are read-only.
    """

    channel: Channel
    counter: int
    device_us: int
    flags: ScanFlag
    samples: Samples

    def volts(self, volts_per_count: float) -> NDArray[np.float64]:
        """The samples in volts, given the scale that the device's `Hello` states."""
        with np.errstate(invalid="ignore", over="ignore"):  # signalling NaN; an absurd scale
            return self.samples.astype(np.float64) * volts_per_count

    def _header(self) -> tuple[str | int, ...]:
        return (self.channel, self.counter, self.device_us, self.flags)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Scan):
            return NotImplemented
        # Compared as bytes, so that a NaN equals itself and every bit of it counts.
        return (
            self._header() == other._header()
            and self.samples.dtype == other.samples.dtype
            and self.samples.shape == other.samples.shape
            and self.samples.tobytes() == other.samples.tobytes()
        )

    def __hash__(self) -> int:
        return hash(self._header())


@dataclass(frozen=True, slots=True)
class Hello:
    """What a device is and what its scans mean, sent every second on each of its ports.

    `channels` are those that this port carries, ascending. Drive k injects into electrode k and
    draws from k + `drive_offset`; a sample is V(m) - V(m + `measure_offset`). A sample times
    `volts_per_count` is in volts, for every sample format. `scan_rate_hz` is 0 when an external
    trigger paces the scans, else from 0.001 to 1,000,000.
    """

    device_id: str
    firmware: str
    channels: tuple[Channel, ...]
    electrodes: int
    drive_offset: int
    measure_offset: int
    samples_per_scan: int
    sample_format: SampleFormat
    volts_per_count: float
    scan_rate_hz: float


@dataclass(frozen=True, slots=True)
class Command:
    """A host's request; the device answers with an `Acknowledge` of the same `request`.

    `code` is a `CommandCode` where this version knows it and a plain int where it does not, so
    that a device can answer `AckStatus.UNKNOWN_COMMAND`. `rate_hz` belongs to `SET_RATE` alone; a
    received one may be any float, and a device answers `AckStatus.BAD_ARGUMENT` to a bad one.
    """

    code: int
    request: int
    rate_hz: float = 0.0


@dataclass(frozen=True, slots=True)
class Acknowledge:
    """A device's answer to a command; `request` and `command` are copied from it."""

    request: int
    command: int
    status: AckStatus


@dataclass(frozen=True, slots=True)
class CompanionReading:
    """A reading of a companion: a scalar beside the sheets, such as a load cell.

    `index` (u8) tells companions apart. `device_us` is the device's clock, that of the scans, in
    µs, when the reading was taken. `value` is finite, travels as a float32 and has the companion's
    own unit. Of `ScanFlag`, LATE means nothing here.
    """

    index: int
    flags: ScanFlag
    device_us: int
    value: float


@dataclass(frozen=True, slots=True)
class UnknownPacket:
    """An intact packet of this protocol version whose type is not known here; ignore it."""

    type: int
    body: bytes


Packet: TypeAlias = Scan | Hello | Acknowledge | CompanionReading | Command | UnknownPacket

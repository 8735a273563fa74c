"""What passes from the ports to imaging, into recordings and back: scans, and records of frames.

Plain values without the serial stack, so that whatever is pure may import them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

from tactomo_models.arrays import FloatArray
from tactomo_protocol import Channel, Hello, ScanFlag

if TYPE_CHECKING:
    from tactomo_models import Reference

MAX_QUADRATURE: Final = 0.3
"""Share of a signal out of phase with the current above which its real part alone misleads: at 0.3
the real part is 5 % short of the modulus."""


Volts = dict[Channel, FloatArray]
"""Voltages (M,) of each channel that a dual scan has."""


class Felt(NamedTuple):
    """What a companion says of a scan."""

    name: str
    value: float  # in its own unit; NaN where its device clipped
    since_us: int
    """For how long the sheets must have been still for that; 0 or less where it is no matter."""


@dataclass(frozen=True, slots=True, eq=False)
class ChannelScan:
    """One channel's scan as it came in."""

    channel: Channel
    counter: int
    device_us: int
    flags: ScanFlag
    volts: FloatArray
    realtime_ns: int
    monotonic_ns: int  # when the read that brought the scan's last byte had returned
    clock_ns: int
    """The same on the clock that synchronisation goes by: in a replay, the recording's."""
    recording: int  # number of the recording that has the scan's bytes; 0 for none
    port: int = 0  # index of the port that the scan came by
    delay_ns: int | None = None
    """How long the scan was held up on its way; None while the device's clock cannot tell."""
    companions: tuple[Felt, ...] = ()  # of its port

    @property
    def acquired_ns(self) -> int:
        """When it would have come without delay, or came if that is unknown, as `clock_ns`."""
        return self.clock_ns - (self.delay_ns or 0)

    @property
    def key(self) -> ScanKey:
        """What tells the scan from every other one in a recording."""
        return ScanKey(self.channel, self.counter, self.device_us)


class PortRead(NamedTuple):
    """What one read of a port brought."""

    port: int
    clock_ns: int
    scans: tuple[ChannelScan, ...]
    hello: Hello | None = None  # what the device says of itself; None before it has
    has_ended: bool = False
    """The replay behind the port is at its end: nothing more will come of this pass."""
    replay_pass: int = 0  # how often the replay had been moved when this was read


class ScanKey(NamedTuple):
    """What tells one channel's scan from every other one in a recording."""

    channel: Channel
    counter: int
    device_us: int


class Timing(NamedTuple):
    """When a dual scan was acquired, and how far its two channels are apart."""

    delay_ns: int  # from then to the arrival of its last byte
    is_dated: bool
    """Whether by the device's clock; otherwise it was acquired when its first scan arrived."""
    skew_ns: int | None
    """The magnitude scan's time less the structure scan's; None where that is not known."""
    is_skewed: bool  # whether that is so much that the two are not of one instant


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """One dual scan that the daemon reconstructed, and with what."""

    scans: tuple[ScanKey, ...]
    tier: str
    budget_ms: float | None
    reference: Reference | None = None  # a reference to be put in force just before it
    reference_number: int | None = None
    """Which of the recording's references was in force, from 1; None for none."""
    is_cold: bool = False
    """Whether what came before is unknown, so that the reconstruction starts anew with it."""
    is_disputed: bool = False  # whether it was open what lay on the skin at the tare
    timing: Timing | None = None  # None where an older version recorded
    calibration: str | None = None
    """Of pressure, to be put in force just before it: the text of its file, empty for none."""
    calibration_number: int = 0
    """Which of those that were read again meanwhile was in force, from 1; 0 for the origin's."""
    clock_ns: int = field(default=0, compare=False)
    """When it was recorded, on the recording's steady clock."""


@dataclass(frozen=True, slots=True)
class DualScan:
    """The scans of one instant; one of the two may be missing."""

    counter: int
    magnitude: ChannelScan | None
    structure: ChannelScan | None
    mark: FrameRecord | None = None  # what a recording says about it, in an exact replay

    @property
    def scans(self) -> tuple[ChannelScan, ...]:
        """Those that are there, magnitude first."""
        return tuple(scan for scan in (self.magnitude, self.structure) if scan is not None)

    @property
    def companions(self) -> dict[str, Felt]:
        """What each companion that was heard says of it."""
        return {felt.name: felt for scan in self.scans for felt in scan.companions}

    @property
    def last(self) -> ChannelScan:
        """The scan that arrived last: with it, the dual scan was complete."""
        return max(self.scans, key=lambda scan: scan.monotonic_ns)

    @property
    def recording(self) -> int:
        """Which recording holds all of its bytes; 0 where none does.

        Where its scans came before and after a recording was cut, the older file holds both.
        """
        return min(scan.recording for scan in self.scans)

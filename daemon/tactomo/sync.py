"""Joining the two channels' scans of one instant into a dual scan, by their counter.

A scan whose partner has not come yet waits for it, but never longer than `wait_ns`: then it goes
on alone, and the frame made from it is flagged. A channel that has been missing for a while is
*lost*, and nobody waits for it any more until one of its scans comes in time again.

All times here are read off one clock that the caller chooses: the computer's monotonic clock for a
device, the recording's own for a replay, whatever speed it runs at.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Protocol

from tactomo_protocol import Channel

from tactomo.port import ChannelScan
from tactomo.recording import Mark, ScanKey

LOST_AFTER_NS: Final = 1_000_000_000
LOST_AFTER_FRAMES: Final = 3
START_GRACE_NS: Final = 3_000_000_000
"""How long after the first scan a channel that was never heard still counts as about to come."""

_COUNTERS: Final = 1 << 32


@dataclass(frozen=True, slots=True)
class DualScan:
    """The scans of one instant; one of the two may be missing."""

    counter: int
    magnitude: ChannelScan | None
    structure: ChannelScan | None
    mark: Mark | None = None
    """What a recording says about it, in an exact replay."""

    @property
    def scans(self) -> tuple[ChannelScan, ...]:
        """Those that are there, magnitude first."""
        return tuple(scan for scan in (self.magnitude, self.structure) if scan is not None)

    @property
    def last(self) -> ChannelScan:
        """The scan that arrived last: with it, the dual scan was acquired."""
        return max(self.scans, key=lambda scan: scan.monotonic_ns)

    @property
    def recording(self) -> int:
        """Which recording holds all of its bytes; 0 where none does.

        Where its scans came before and after a recording was cut, the older file holds both.
        """
        return min(scan.recording for scan in self.scans)


class Joiner(Protocol):
    """Turns single scans into dual scans: `Sync`, or `MarkedSync` in an exact replay."""

    lost: set[Channel]
    late: int
    resets: int

    def push(self, scan: ChannelScan) -> list[DualScan]:
        """Take one scan and return the dual scans that are complete now, in order."""
        ...

    def advance(self, now_ns: int) -> list[DualScan]:
        """Return the dual scans whose wait is over at `now_ns`."""
        ...

    def finish(self) -> list[DualScan]:
        """Return whatever still waits: no scan will come any more."""
        ...

    @property
    def deadline_ns(self) -> int | None:
        """When `advance` will next have something to return; None when nothing waits."""
        ...


class Sync:
    """Joins by counter with a bounded wait. For use by one thread.

    Attributes:
        lost: channels that nobody waits for at present.
        late: scans dropped because their dual scan had gone on without them.
        resets: how often a counter went back: the device restarted or zeroed its counters.

    """

    def __init__(self, expected: tuple[Channel, ...], wait_ns: int) -> None:
        self.lost: set[Channel] = set()
        self.late = 0
        self.resets = 0
        self._expected = expected
        self._wait_ns = wait_ns
        self._waiting: dict[int, ChannelScan] = {}  # by counter, in order of arrival
        self._newest: dict[Channel, int] = {}  # the last counter that each channel said
        self._joined_ns: dict[Channel, int] = {}  # when each channel was last part of a dual scan
        self._missed: dict[Channel, int] = dict.fromkeys(expected, 0)  # dual scans in a row
        self._gone: ChannelScan | None = None  # the last scan of the newest dual scan sent on

    def push(self, scan: ChannelScan) -> list[DualScan]:
        """Take one scan and return the dual scans that are complete now, in order."""
        if len(self._expected) == 1:
            return [_dual(scan)]
        for channel in self._expected:
            self._joined_ns.setdefault(channel, scan.clock_ns + START_GRACE_NS - LOST_AFTER_NS)
        if not self._is_new(scan):
            self.late += 1
            return []
        # A channel's scans come in order: what still waits for an earlier one waits in vain.
        ready = [
            self._send(waiting)
            for waiting in list(self._waiting.values())
            if waiting.channel != scan.channel and _is_after(scan.counter, waiting.counter)
        ]
        partner = self._waiting.get(scan.counter)
        if partner is not None and partner.channel != scan.channel:
            return [*ready, self._send(scan, partner)]
        if partner is not None:  # its own namesake, from before the counters were zeroed
            ready.append(self._send(partner))
        if self._partner_of(scan.channel) in self.lost:
            return [*ready, self._send(scan)]
        self._waiting[scan.counter] = scan
        return ready

    def advance(self, now_ns: int) -> list[DualScan]:
        """Return the dual scans whose wait is over at `now_ns`."""
        over = [s for s in self._waiting.values() if s.clock_ns + self._wait_ns <= now_ns]
        return [self._send(scan) for scan in over]

    def finish(self) -> list[DualScan]:
        """Return whatever still waits: no scan will come any more."""
        return [self._send(scan) for scan in list(self._waiting.values())]

    @property
    def deadline_ns(self) -> int | None:
        """When `advance` will next have something to return; None when nothing waits."""
        oldest = next(iter(self._waiting.values()), None)
        return None if oldest is None else oldest.clock_ns + self._wait_ns

    def _is_new(self, scan: ChannelScan) -> bool:
        """Note the scan's counter; False for a repeated scan or one that comes too late."""
        before = self._newest.get(scan.channel)
        self._newest[scan.channel] = scan.counter
        if before == scan.counter:
            return False
        if before is not None and not _is_after(scan.counter, before):
            self.resets += 1
            self._gone = None
        gone = self._gone
        if gone is None or _is_after(scan.counter, gone.counter):
            return True
        in_time = scan.clock_ns - gone.clock_ns <= self._wait_ns
        if scan.counter == gone.counter and scan.channel in self.lost and in_time:
            self._found(scan)  # had anybody waited for it, it would have come in time
        return False

    def _send(self, scan: ChannelScan, partner: ChannelScan | None = None) -> DualScan:
        self._waiting.pop(scan.counter, None)
        self._gone = scan
        self._found(scan)
        if partner is not None:
            self._found(partner)
        else:
            self._missing(self._partner_of(scan.channel), scan.clock_ns)
        return _dual(scan, partner)

    def _found(self, scan: ChannelScan) -> None:
        self._joined_ns[scan.channel] = scan.clock_ns
        self._missed[scan.channel] = 0
        self.lost.discard(scan.channel)

    def _missing(self, channel: Channel, now_ns: int) -> None:
        self._missed[channel] += 1
        silent_ns = now_ns - self._joined_ns[channel]
        if silent_ns >= LOST_AFTER_NS and self._missed[channel] >= LOST_AFTER_FRAMES:
            self.lost.add(channel)

    def _partner_of(self, channel: Channel) -> Channel:
        return next(other for other in self._expected if other != channel)


class MarkedSync:
    """Joins exactly those scans that a recording's marks join, in their order, without waiting.

    Attributes:
        late: marked dual scans that could not be rebuilt, because the bytes of one of their
            scans are not in the recording.

    """

    def __init__(self, marks: list[Mark]) -> None:
        self.lost: set[Channel] = set()
        self.late = 0
        self.resets = 0
        self._marks = marks
        self._next = 0  # the mark to be sent on next
        self._arrived: dict[ScanKey, ChannelScan] = {}
        self._wanted = {key: index for index, mark in enumerate(marks) for key in mark.scans}

    def push(self, scan: ChannelScan) -> list[DualScan]:
        """Take one scan and return the dual scans that are complete now, in order."""
        key = ScanKey(scan.channel, scan.counter, scan.device_us)
        index = self._wanted.get(key)
        if index is None or index < self._next:
            return []
        self._arrived[key] = scan
        ready: list[DualScan] = []
        while self._next < len(self._marks) and self._is_settled(scan.channel, index):
            ready += self._settle()
        return ready

    def finish(self) -> list[DualScan]:
        """Return whatever still waits: no scan will come any more."""
        ready: list[DualScan] = []
        while self._next < len(self._marks):
            ready += self._settle()
        return ready

    def _is_settled(self, channel: Channel, index: int) -> bool:
        """Whether the next mark has its scans, or one of `channel` has been passed over."""
        absent = [key for key in self._marks[self._next].scans if key not in self._arrived]
        passed = index > self._next
        return not absent or (passed and any(key.channel == channel for key in absent))

    def _settle(self) -> list[DualScan]:
        """Send the next mark's dual scan on if its scans are there; go on to the mark after it."""
        mark = self._marks[self._next]
        self._next += 1
        scans = [self._arrived.pop(key) for key in mark.scans if key in self._arrived]
        if len(scans) < len(mark.scans):
            self.late += 1
            return []
        return [_dual(*scans, mark=mark)]

    def advance(self, now_ns: int) -> list[DualScan]:
        """Return nothing: marks do not wait by the clock."""
        return []

    @property
    def deadline_ns(self) -> int | None:
        """None: marks do not wait by the clock."""
        return None


def _dual(*scans: ChannelScan | None, mark: Mark | None = None) -> DualScan:
    by_channel = {scan.channel: scan for scan in scans if scan is not None}
    counter = next(iter(by_channel.values())).counter
    return DualScan(
        counter, by_channel.get(Channel.MAGNITUDE), by_channel.get(Channel.STRUCTURE), mark
    )


def _is_after(counter: int, other: int) -> bool:
    """Whether `counter` comes after `other`, across the wrap of 32 bits."""
    return 0 < (counter - other) % _COUNTERS < _COUNTERS // 2

"""Joining the two channels' scans of one instant into a dual scan, by their counter.

A scan whose partner has not come yet waits for it, but never longer than `wait_ns`: then it goes
on alone, and the frame made from it is flagged. A channel that has been missing for a while is
*lost*, and nobody waits for it any more until one of its scans comes in time again.

A counter that goes back begins a new *epoch* of its channel, and scans are joined within an epoch
alone: one port may lag behind the other while both begin anew. Resets of a device and zeroed
counters are told apart by its clock, so a board that was reset alone is in an epoch of its own.
Once scans of a newer epoch had to go on alone, the other channel is taken to be in it, too.

All times here are read off one clock that the caller chooses: the computer's monotonic clock for a
device, the recording's own for a replay, whatever speed it runs at.
"""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

from tactomo_protocol import SCAN_COUNTERS, Channel

from tactomo.scans import ChannelScan, DualScan, FrameRecord, ScanKey

LOST_AFTER_NS: Final = 1_000_000_000
LOST_AFTER_FRAMES: Final = 3
FOUND_SHARE: Final = 0.75
"""A lost channel is waited for again once a scan comes within this share of the wait: one about as
late as the wait is long would be lost and back without end."""
REMEMBERED: Final = 256
"""Scans of a channel, to tell one that comes again from one that comes after its successor."""
START_GRACE_NS: Final = 3_000_000_000
"""How long after the first scan a channel that was never heard still counts as about to come."""
STALE_US: Final = 2_000_000
"""A counter and a clock that are back by no more than this belong to a scan sent once again."""

_ZEROED, _RESET = 1, 2  # epochs further; both boards of a pair, so the same for both


class ScanPairer:
    """Turns single scans into dual scans. For use by one thread; others may read.

    Every scan that is pushed waits, is part of one dual scan, or is counted in one of these.
    """

    def __init__(self) -> None:
        self.lost: set[Channel] = set()  # channels that nobody waits for at present
        # scans dropped because their dual scan, or channel, had gone on without them; and those of
        # them that came after their own channel's next
        self.late = self.disordered = 0
        self.repeated = 0  # scans dropped because they had come before
        self.unmarked = 0  # scans dropped because the recorded run did not use them
        # how often counters went back with their clocks: once for a device of two channels
        self.resets = 0
        self.zeroed = 0  # how often counters alone went back

    def push(self, scan: ChannelScan) -> list[DualScan]:
        """Take one scan and return the dual scans that are complete now, in order."""
        raise NotImplementedError

    def advance(self, now_ns: int) -> list[DualScan]:
        """Return the dual scans whose wait is over at `now_ns`."""
        return []

    def finish(self) -> list[DualScan]:
        """Return whatever still waits: no scan will come any more."""
        raise NotImplementedError

    def carry_on(self, before: ScanPairer) -> None:
        """Count on from another one, whose place this one takes."""
        self.late, self.repeated, self.unmarked = before.late, before.repeated, before.unmarked
        self.disordered = before.disordered
        self.resets, self.zeroed = before.resets, before.zeroed

    @property
    def deadline_ns(self) -> int | None:
        """When `advance` will next have something to return; None when nothing waits."""
        return None


class _Instant(NamedTuple):
    """What the scans of one instant have in common."""

    epoch: int
    counter: int

    def is_after(self, other: _Instant) -> bool:
        if self.epoch != other.epoch:
            return self.epoch > other.epoch
        return counts_between(other.counter, self.counter) > 0


class CounterPairer(ScanPairer):
    """Pairs by counter with a bounded wait."""

    def __init__(self, expected: tuple[Channel, ...], wait_ns: int) -> None:
        super().__init__()
        self._expected = expected
        self._wait_ns = wait_ns
        self._waiting: dict[_Instant, ChannelScan] = {}  # in order of arrival
        self._newest: dict[Channel, ChannelScan] = {}
        self._came: dict[Channel, deque[ScanKey]] = {}  # the newest few
        self._epochs: dict[Channel, int] = {}
        # channels not heard since the last reset (True), or zeroing, of another: theirs is the same
        self._to_follow: dict[bool, set[Channel]] = {True: set(), False: set()}
        self._joined_ns: dict[Channel, int] = {}  # when each channel was last part of a dual scan
        self._missed: dict[Channel, int] = dict.fromkeys(expected, 0)  # dual scans in a row
        self._gone: tuple[_Instant, int] | None = None  # the newest dual scan sent on, and when

    def push(self, scan: ChannelScan) -> list[DualScan]:
        """Take one scan and return the dual scans that are complete now, in order."""
        keys = self._came.setdefault(scan.channel, deque(maxlen=REMEMBERED))
        is_repeated = scan.key in keys
        if not self._is_new(scan):
            self.repeated += is_repeated
            self.late += not is_repeated
            self.disordered += not is_repeated
            return []
        keys.append(scan.key)
        if len(self._expected) == 1:
            return [_dual(scan)]
        for channel in self._expected:
            self._joined_ns.setdefault(channel, scan.clock_ns + START_GRACE_NS - LOST_AFTER_NS)
        instant = _Instant(self._epochs[scan.channel], scan.counter)
        if not self._is_in_time(instant, scan):
            self.late += 1
            return []
        # A channel's scans come in order: what still waits for an earlier one waits in vain.
        ready = [
            self._send(earlier, waiting)
            for earlier, waiting in list(self._waiting.items())
            if waiting.channel != scan.channel and instant.is_after(earlier)
        ]
        partner = self._waiting.get(instant)
        if partner is not None and partner.channel != scan.channel:
            return [*ready, self._send(instant, scan, partner)]
        if partner is not None:  # its own namesake, from half a round of the counter ago
            ready.append(self._send(instant, partner))
        partner_of = self._partner_of(scan.channel)
        if partner_of in self.lost or self._is_past(partner_of, instant):
            return [*ready, self._send(instant, scan)]
        self._waiting[instant] = scan
        return ready

    def advance(self, now_ns: int) -> list[DualScan]:
        """Return the dual scans whose wait is over at `now_ns`."""
        over = [w for w in self._waiting.items() if w[1].clock_ns + self._wait_ns <= now_ns]
        return [self._send(instant, scan) for instant, scan in over]

    def finish(self) -> list[DualScan]:
        """Return whatever still waits: no scan will come any more."""
        return [self._send(instant, scan) for instant, scan in list(self._waiting.items())]

    @property
    def deadline_ns(self) -> int | None:
        """When `advance` will next have something to return; None when nothing waits."""
        oldest = next(iter(self._waiting.values()), None)
        return None if oldest is None else oldest.clock_ns + self._wait_ns

    def _is_new(self, scan: ChannelScan) -> bool:
        """Note how far its channel is with this scan; False for one that came before."""
        before = self._newest.get(scan.channel)
        if before is None:
            self._epochs[scan.channel] = max(self._epochs.values(), default=0)
        elif counts_between(before.counter, scan.counter) <= 0:
            back_us = before.device_us - scan.device_us
            if 0 < back_us <= STALE_US or (back_us == 0 and scan.counter == before.counter):
                return False
            self._begin_epoch(scan.channel, is_reset=back_us > 0)
        for channels in self._to_follow.values():
            channels.discard(scan.channel)
        self._newest[scan.channel] = scan
        return True

    def _begin_epoch(self, channel: Channel, is_reset: bool) -> None:
        self._epochs[channel] += _RESET if is_reset else _ZEROED
        if channel in self._to_follow[is_reset]:
            return
        self._to_follow[is_reset] = set(self._epochs) - {channel}
        self.resets += is_reset
        self.zeroed += not is_reset

    def _is_past(self, channel: Channel, instant: _Instant) -> bool:
        """Tell whether a channel has gone on beyond an instant: its scan of it was lost."""
        newest = self._newest.get(channel)
        return newest is not None and _Instant(self._epochs[channel], newest.counter).is_after(
            instant
        )

    def _is_in_time(self, instant: _Instant, scan: ChannelScan) -> bool:
        """Tell whether a scan's dual scan is still to go on."""
        if self._gone is None:
            return True
        gone, gone_ns = self._gone
        if instant.is_after(gone):
            return True
        is_soon = scan.clock_ns - gone_ns <= FOUND_SHARE * self._wait_ns
        if instant == gone and scan.channel in self.lost and is_soon:
            self._found(scan)  # had anybody waited for it, it would have come in time
        return False

    def _send(
        self, instant: _Instant, scan: ChannelScan, partner: ChannelScan | None = None
    ) -> DualScan:
        self._waiting.pop(instant, None)
        self._gone = (instant, scan.clock_ns)
        self._found(scan)
        if partner is not None:
            self._found(partner)
        else:
            self._missing(self._partner_of(scan.channel), instant, scan.clock_ns)
        return _dual(scan, partner)

    def _found(self, scan: ChannelScan) -> None:
        self._joined_ns[scan.channel] = scan.clock_ns
        self._missed[scan.channel] = 0
        self.lost.discard(scan.channel)

    def _missing(self, channel: Channel, instant: _Instant, now_ns: int) -> None:
        if channel in self._epochs:
            self._epochs[channel] = max(self._epochs[channel], instant.epoch)
        self._missed[channel] += 1
        silent_ns = now_ns - self._joined_ns[channel]
        if silent_ns >= LOST_AFTER_NS and self._missed[channel] >= LOST_AFTER_FRAMES:
            self.lost.add(channel)

    def _partner_of(self, channel: Channel) -> Channel:
        return next(other for other in self._expected if other != channel)


class RecordPairer(ScanPairer):
    """Pairs exactly those scans that a recording's marks pair, in their order, without waiting.

    Late are scans whose partner's bytes are not in the recording.
    """

    def __init__(self, marks: list[FrameRecord]) -> None:
        super().__init__()
        self._marks = marks
        self._next = 0  # the mark to be sent on next
        self._arrived: dict[ScanKey, ChannelScan] = {}
        self._wanted = {key: index for index, mark in enumerate(marks) for key in mark.scans}

    def push(self, scan: ChannelScan) -> list[DualScan]:
        """Take one scan and return the dual scans that are complete now, in order."""
        key = scan.key
        index = self._wanted.get(key)
        if index is None:
            self.unmarked += 1
            return []
        if index < self._next or key in self._arrived:
            self.repeated += 1
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
            self.late += len(scans)
            return []
        return [_dual(*scans, mark=mark)]


def _dual(*scans: ChannelScan | None, mark: FrameRecord | None = None) -> DualScan:
    by_channel = {scan.channel: scan for scan in scans if scan is not None}
    counter = next(iter(by_channel.values())).counter
    return DualScan(
        counter, by_channel.get(Channel.MAGNITUDE), by_channel.get(Channel.STRUCTURE), mark
    )


def counts_between(earlier: int, later: int) -> int:
    """Return how much further one counter is than another, across the wrap of 32 bits."""
    return (later - earlier + SCAN_COUNTERS // 2) % SCAN_COUNTERS - SCAN_COUNTERS // 2

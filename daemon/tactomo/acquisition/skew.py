"""How far apart in time the two channels are: of each dual scan, and of their counters.

Scans are paired by counter, which counts the pulses of a sync line that two boards share. A board
that missed pulses still counts on, and then the same counter is no longer the same instant. That
shows in the times: scans that are n counts apart should be n periods apart.
"""

from __future__ import annotations

import math
from typing import Final

from tactomo_protocol import Channel

from tactomo.acquisition.scan_pairer import counts_between
from tactomo.scans import ChannelScan, DualScan, Timing
from tactomo.timing import Durations

IN_A_ROW: Final = 9
"""Findings that must agree before the channels count as out of step, or in step again. Each scan is
in two of them, so these are five dual scans."""
ALIKE: Final = 0.05
"""Share by which they may differ: the period is an estimate, and counters may be far apart."""
MIN_LIMIT_NS: Final = 5_000_000
"""The least delays of two ports are unknown and may differ by some milliseconds."""
UNDATED_NS: Final = 1_000_000_000  # what arrivals alone may be apart by, beyond a period
MAX_GAP_NS: Final = 2_000_000_000
"""Scans of two counters farther apart than this are not compared: one channel is silent."""
_SMOOTHING: Final = 0.125


class Skew:
    """Measures; for use by one thread, others may read."""

    def __init__(self) -> None:
        self.is_skewed = False  # whether the counters are out of step, for several scans in a row
        # by how much, when last measured; positive if the magnitude channel's counter is behind
        self.out_of_step_ns = 0
        self.sizes = Durations()  # of the skew of each dual scan, without its sign
        self._newest: dict[Channel, ChannelScan] = {}
        self._compared: ChannelScan | None = None  # the newest one that found its counterpart
        self._periods_ns: dict[Channel, float] = {}
        self._in_a_row = 0  # findings that contradict `is_skewed`
        self._row_ns = 0.0  # by how much the first of them did

    def take(self, scan: ChannelScan) -> None:
        """Hold a scan, in order of arrival, against the other channel's newest."""
        self._follow_period(scan)
        self._newest[scan.channel] = scan
        other = next((s for c, s in self._newest.items() if c != scan.channel), None)
        if other is not None and other is not self._compared:
            self._compared = other
            self._compare(scan, other)

    def timing(self, dual: DualScan) -> Timing:
        """Return when a dual scan was acquired: when the older one of its two scans was."""
        acquired_ns = min(scan.acquired_ns for scan in dual.scans)
        skew_ns = None
        if dual.magnitude is not None and dual.structure is not None:
            skew_ns = skew_of(dual.magnitude, dual.structure)
        is_skewed = self.is_skewed
        if skew_ns is not None:
            is_skewed = is_skewed or abs(skew_ns) > self._limit_ns(*dual.scans)
        return Timing(
            delay_ns=max(scan.clock_ns for scan in dual.scans) - acquired_ns,
            is_dated=all(scan.delay_ns is not None for scan in dual.scans),
            skew_ns=skew_ns,
            is_skewed=is_skewed,
        )

    def note(self, timing: Timing) -> None:
        """Take a dual scan's skew into the statistics."""
        if timing.skew_ns is not None:
            self.sizes.add(abs(timing.skew_ns) * 1e-9)

    def _follow_period(self, scan: ChannelScan) -> None:
        before = self._newest.get(scan.channel)
        if before is None:
            return
        period_ns = (scan.device_us - before.device_us) * 1e3
        # A gap may be scans that were lost, several periods long, or pulses that were missed.
        if counts_between(before.counter, scan.counter) == 1 and period_ns > 0:
            known_ns = self._periods_ns.get(scan.channel, period_ns)
            self._periods_ns[scan.channel] = known_ns + _SMOOTHING * (period_ns - known_ns)

    def _compare(self, scan: ChannelScan, other: ChannelScan) -> None:
        period_ns = self._periods_ns.get(scan.channel)
        if period_ns is None:
            return
        skew_ns = skew_of(scan, other)
        is_dated = skew_ns is not None
        if skew_ns is None:
            skew_ns = scan.acquired_ns - other.acquired_ns
        if abs(skew_ns) > MAX_GAP_NS and not (is_dated and scan.counter == other.counter):
            return
        step_ns = skew_ns - counts_between(other.counter, scan.counter) * period_ns
        limit_ns = self._limit_ns(scan, other) + (0 if is_dated else UNDATED_NS)
        self.out_of_step_ns = round(step_ns if scan.channel == Channel.MAGNITUDE else -step_ns)
        self._conclude(self.out_of_step_ns, limit_ns)

    def _conclude(self, step_ns: float, limit_ns: float) -> None:
        """Count findings; boards that missed pulses stay apart by as much, an overload's do not."""
        is_skewed = abs(step_ns) > limit_ns
        alike_ns = max(limit_ns / 2, ALIKE * abs(self._row_ns))
        is_another = is_skewed and abs(step_ns - self._row_ns) > alike_ns
        if is_another or is_skewed == self.is_skewed:
            self._in_a_row, self._row_ns = 0, step_ns
        self._in_a_row += is_skewed != self.is_skewed
        if self._in_a_row >= IN_A_ROW:
            self.is_skewed, self._in_a_row = is_skewed, 0

    def _limit_ns(self, scan: ChannelScan, other: ChannelScan) -> float:
        """Return how far apart two scans of one counter may be.

        One device may scan its channels one after the other, two boards scan on the same pulse.
        """
        period_ns = self._periods_ns.get(scan.channel, math.inf)
        return period_ns if scan.port == other.port else max(period_ns / 2, MIN_LIMIT_NS)


def skew_of(scan: ChannelScan, other: ChannelScan) -> int | None:
    """Return by how many nanoseconds `scan` was acquired after `other`; None if that is unknown.

    Exact where one device dated both.
    """
    if scan.port == other.port:
        return (scan.device_us - other.device_us) * 1000
    if scan.delay_ns is None or other.delay_ns is None:
        return None
    return scan.acquired_ns - other.acquired_ns

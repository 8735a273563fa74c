"""A device's clock on the computer's: when a scan would have come, had nothing held it back.

On its way from the device a scan waits in buffers, so it arrives late by some delay that is never
negative. What an arrival and the device's time differ by, the *lag*, is the offset between the two
clocks plus that delay. Seen over minutes, the smallest lags lie on a line whose slope is the rate
at which the clocks drift apart, and whatever lies above the line came late by its distance from it.

The line is the linear-programming fit of Moon, Skelly and Towsley, "Estimation and removal of clock
skew from network delay measurements" (INFOCOM 1999): below all lags and on average as near to them
as can be, hence the edge of their lower convex hull that spans their mean time. As NTP's clock
filter does (Mills, RFC 5905, section 10), it goes by the least delayed samples alone: one for each
two seconds, so that it costs next to nothing. The second least counts, so one wild sample does not.

A line that has proved itself follows what crystals do, some parts per million in minutes, and no
faster. Lags that rise all at once are data that wait somewhere, and the age that they have is told;
if they stay high for longer than any buffer lasts, or fall below the line, or if the device's time
goes back, its clock has jumped and the fit begins anew.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from enum import StrEnum
from statistics import median
from typing import Final, NamedTuple

from tactomo_protocol import Channel

from tactomo.timing import Durations

MAX_RATE: Final = 500e-6  # how fast the clocks may drift apart; the protocol asks for 200 ppm
BUCKET_NS: Final = 2_000_000_000
BUCKETS: Final = 64
SETTLE_NS: Final = 10_000_000_000
"""How long a clock must have been seen before it is used, and before it has a rate."""
MIN_SCANS: Final = 20
PROVEN_NS: Final = (BUCKETS - 4) * BUCKET_NS
"""How long until its rate is certain: one that cannot be is found out, another one is trusted."""
ROUGH_NS: Final = 50_000_000
"""How far from the line the usual point may be; those of a clock that stands still are seconds."""
WANDER: Final = 50e-6
"""How fast a line that has proved itself may become later than it was headed for."""
RATE_STEP: Final = 1e-6  # what its rate may change by at a time while it does
EARLY_NS: Final = 5_000_000
LATE_NS: Final = 1_000_000_000
"""Scans earlier than the one, or later than the other, may mean that the clock has jumped."""
ODD_SCANS: Final = 5
EARLY_PATIENCE_NS: Final = 1_000_000_000
LATE_PATIENCE_NS: Final = 10_000_000_000
"""They do if so many come, and no other, for so long. No buffer lasts 10 s; a stall may, but ends
in a burst."""
APART_US: Final = 10_000_000
"""What one channel's times may lie behind the other's, beyond two of its scans: the scans of one
dual scan come in either order, but soon after one another."""


class ClockState(StrEnum):
    """Whether scans are dated by the device's clock."""

    SETTLING = "settling"  # not yet: too little was seen of it
    SETTLED = "settled"
    UNUSABLE = "unusable"  # no: it stands still, or its rate cannot be


class Point(NamedTuple):
    """A scan with little delay."""

    arrived_ns: int
    lag_ns: int


class Line(NamedTuple):
    """The least lag over arrival times; anchored where it is used, so that floats do."""

    at_ns: int
    lag_ns: int
    rate: float

    def lag_at(self, arrived_ns: int) -> int:
        """Return the least lag at a time."""
        return self.lag_ns + round(self.rate * (arrived_ns - self.at_ns))

    def delay_of(self, arrived_ns: int, lag_ns: int) -> int:
        """Return by how much a scan came late; negative if it came early.

        The least lag counts as it was when the scan should have come, not when it came.
        """
        return round((lag_ns - self.lag_at(arrived_ns)) / (1.0 - self.rate))


class DeviceClock:
    """Dates one device's scans by its own clock. One thread calls it, others may read."""

    def __init__(self) -> None:
        self.jumps = 0  # how often the clock jumped, or went back
        # by how much scans came later than need be, while the clock is used
        self.delays = Durations()
        self._fit = _Fit()
        self._newest_us: dict[Channel, int] = {}
        self._backward = 0  # scans in a row that were taken before their predecessors
        self._apart = 0  # scans by another clock than the other channel's, in a row of dual scans
        self._odd = 0  # scans in a row that came too early, or (positive) far too late
        self._odd_since_ns = 0

    @property
    def state(self) -> ClockState:
        """Whether the device's clock is used."""
        return ClockState.UNUSABLE if self._apart >= ODD_SCANS else self._fit.state

    @property
    def line(self) -> Line | None:
        """The computer's time less the device's, and its rate; None while it is not used."""
        return self._fit.line if self.state is ClockState.SETTLED else None

    def date(self, channel: Channel, device_us: int, arrived_ns: int) -> int | None:
        """Take note of a scan that arrived; return how many nanoseconds it was held up.

        None where the device's clock cannot tell. Never negative: nothing comes before it is sent.
        """
        if self._is_of_another_clock(channel, device_us) or self._has_gone_back(channel, device_us):
            return None
        lag_ns = arrived_ns - device_us * 1000
        delay_ns = self._fit.delay_of(arrived_ns, lag_ns)
        if self.state is ClockState.SETTLED and self._is_odd(delay_ns, arrived_ns):
            return None if delay_ns < 0 or self.state is not ClockState.SETTLED else delay_ns
        self._newest_us[channel] = device_us
        self._fit.take(delay_ns, Point(arrived_ns, lag_ns))
        if self.state is not ClockState.SETTLED:
            return None
        delay_ns = max(0, delay_ns)
        self.delays.add(delay_ns * 1e-9)
        return delay_ns

    def _has_gone_back(self, channel: Channel, device_us: int) -> bool:
        """Tell a scan from before its predecessor. A second one says that the clock was reset."""
        if device_us >= self._newest_us.get(channel, 0):
            self._backward = 0
            return False
        self._backward += 1
        if self._backward > 1:
            self._newest_us.clear()
            self._backward = 0
            self._jump()
        return True

    def _is_of_another_clock(self, channel: Channel, device_us: int) -> bool:
        """Tell a scan from long before the other channel's: a device has one clock for both."""
        own_us = self._newest_us.get(channel, device_us)
        other_us = max((us for c, us in self._newest_us.items() if c is not channel), default=None)
        if other_us is None or device_us < own_us:  # the first ones, or a reset
            return False
        if other_us - device_us <= APART_US + 2 * (device_us - own_us):
            self._apart = self._apart if device_us < other_us else max(0, self._apart - 1)
            return False
        self._newest_us[channel] = device_us
        self._apart = min(2 * ODD_SCANS, self._apart + 2)
        return True

    def _jump(self) -> None:
        self.jumps += 1
        self._apart = 0
        self._fit, self._odd = _Fit(), 0

    def _is_odd(self, delay_ns: int, arrived_ns: int) -> bool:
        """Tell what is no delay. Should it go on, the clock has jumped."""
        is_early = self._fit.is_early(delay_ns, arrived_ns)
        if not is_early and delay_ns < LATE_NS:
            self._odd = 0
            return False
        if self._odd == 0 or (self._odd < 0) != is_early:
            self._odd, self._odd_since_ns = 0, arrived_ns
        self._odd += -1 if is_early else 1
        patience_ns = EARLY_PATIENCE_NS if is_early else LATE_PATIENCE_NS
        if abs(self._odd) >= ODD_SCANS and arrived_ns - self._odd_since_ns >= patience_ns:
            self._jump()
        return True


class _Fit:
    """The line below the lags, from when a clock is first seen until it jumps."""

    def __init__(self) -> None:
        self.state = ClockState.SETTLING
        self.line: Line | None = None
        self._is_proven = False
        self._settle_ns = SETTLE_NS
        self._points: deque[Point] = deque(maxlen=BUCKETS)
        self._scans = 0
        self._bucket = -1  # the number of the one that is filled at present
        self._least: list[tuple[int, Point]] = []  # its two least delayed scans
        self._fitted_ns = 0

    def delay_of(self, arrived_ns: int, lag_ns: int) -> int:
        if self.line is None:
            self.line = Line(arrived_ns, lag_ns, 0.0)
        return self.line.delay_of(arrived_ns, lag_ns)

    def is_early(self, delay_ns: int, arrived_ns: int) -> bool:
        return delay_ns < -EARLY_NS - round(WANDER * (arrived_ns - self._fitted_ns))

    def take(self, delay_ns: int, point: Point) -> None:
        """Take note of a scan; with the first one of a new bucket, fit the line again."""
        bucket = point.arrived_ns // BUCKET_NS
        if bucket != self._bucket:
            self._close_bucket(point.arrived_ns)
            self._bucket = bucket
        self._scans += 1
        least = self._least
        if len(least) < 2 or delay_ns < least[1][0]:
            least.append((delay_ns, point))
            least.sort()
            del least[2:]

    def _close_bucket(self, now_ns: int) -> None:
        points = self._points
        if self._least:
            points.append(self._least[-1][1])
            self._least = []
        while points and now_ns - points[0].arrived_ns > BUCKETS * BUCKET_NS:
            points.popleft()
        if points and self.line is not None:
            self.line = self._fit(self.line, now_ns)
            self._fitted_ns = now_ns

    def _fit(self, before: Line, now_ns: int) -> Line:
        points = list(self._points)
        span_ns = points[-1].arrived_ns - points[0].arrived_ns
        slope = slope_below(points) if span_ns >= SETTLE_NS else before.rate
        line = line_below(points, max(-MAX_RATE, min(MAX_RATE, slope)))
        if self._is_proven:
            return self._restrain(line, before, now_ns)
        is_certain = span_ns >= PROVEN_NS
        if is_certain and abs(slope) > MAX_RATE:
            self.state, self._settle_ns = ClockState.UNUSABLE, PROVEN_NS
        elif span_ns >= self._settle_ns and self._scans >= MIN_SCANS:
            is_smooth = median(p.lag_ns - line.lag_at(p.arrived_ns) for p in points) < ROUGH_NS
            self.state = ClockState.SETTLED if is_smooth else ClockState.UNUSABLE
            self._is_proven = is_certain and is_smooth
        return line

    def _restrain(self, line: Line, before: Line, now_ns: int) -> Line:
        """Return the line, or one that is as late as a clock may have become since `before`."""
        latest_ns = before.lag_at(now_ns) + round(WANDER * (now_ns - self._fitted_ns))
        if line.lag_at(now_ns) <= latest_ns:
            return line
        step = max(-RATE_STEP, min(RATE_STEP, line.rate - before.rate))
        return Line(now_ns, latest_ns, before.rate + step)


def line_below(points: Sequence[Point], rate: float) -> Line:
    """Return the highest line of that rate that no point lies below."""
    at_ns = points[-1].arrived_ns
    return Line(at_ns, min(p.lag_ns - round(rate * (p.arrived_ns - at_ns)) for p in points), rate)


def slope_below(points: Sequence[Point]) -> float:
    """Return the slope of the lower convex hull's edge that spans the points' mean time.

    The line along it has the least sum of distances of all lines that no point lies below.
    `points` are at least two, their times ascending.
    """
    mean_ns = sum(point.arrived_ns for point in points) / len(points)
    hull = lower_hull(points)
    right = next(i for i, p in enumerate(hull) if p.arrived_ns >= mean_ns)
    before, after = hull[right - 1], hull[right]
    return (after.lag_ns - before.lag_ns) / (after.arrived_ns - before.arrived_ns)


def lower_hull(points: Sequence[Point]) -> list[Point]:
    """Return the corners of the points' lower convex hull, from left to right (Andrew's chain)."""
    hull: list[Point] = []
    for point in points:
        while len(hull) > 1 and not _turns_up(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    return hull


def _turns_up(a: Point, b: Point, c: Point) -> bool:
    """Whether the way from a by b to c bends upwards at b; in integers, so exactly."""
    first = (b.lag_ns - a.lag_ns) * (c.arrived_ns - b.arrived_ns)
    return first < (c.lag_ns - b.lag_ns) * (b.arrived_ns - a.arrived_ns)

"""Judging by what comes over an open port whether a device is well, and when to try it anew.

Four kinds of bytes count, each including the next: any, whole packets, scans. Where one kind stays
out for `PATIENCE_S`, the device is in trouble of that kind. A device that answers with nothing
that can be understood may have been left so by its USB bridge, which often comes to its senses
when the port is closed and opened; so that is due after a while, and ever more rarely.

A device that takes seconds for a scan is late after a few of its own periods, not sooner; what it
says of its rate and what was seen of it tell how long those are. One that says hello in between is
known to be silent as soon as any other.

Nothing here reads a clock: times are handed in, in seconds on any one clock.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Final

from tactomo.timing import LATE_PERIODS, LONGEST_PERIOD_S, Pace

PATIENCE_S: Final = 3.0
"""A device says hello every second; without a word for so long it counts as silent, and without a
scan as idle, unless it is slow by nature."""
REOPEN_S: Final = 6.0
REOPEN_MOST_S: Final = 60.0


class DeviceState(StrEnum):
    """How the device at an open port does."""

    STARTING = "starting"  # opened a moment ago
    RUNNING = "running"  # scans come
    IDLE = "idle"  # it speaks, but sends no scans
    GARBLED = "garbage"  # bytes come, but no packet
    SILENT = "silent"  # nothing comes


class Liveness:
    """Follows what comes; says how the device does. For use by one thread."""

    def __init__(
        self,
        says_hello: bool = True,  # every second, scans or not, so that silence tells
        first_s: float = 0.0,  # how long it may take until its pace is known
    ) -> None:
        self.state = DeviceState.STARTING  # as of the last call
        self._says_hello = says_hello
        self._first_s = first_s
        self._stated_s = 0.0  # a few periods, by the rate that the device says
        self._pace = Pace()  # of scans, as they come
        self._bytes_s = self._packet_s = self._scan_s = 0.0  # when each kind last came
        self._since_s: float | None = None  # when they began, after silence or an opening
        self._has_scan = False  # since the port was opened
        self._reopen_wait_s = self._reopen_after_s
        self._reopen_s = 0.0

    @property
    def patience_s(self) -> float:
        """How long it may send no scan, in seconds."""
        few_s = max(self._stated_s, self._pace.few_s)
        return max(PATIENCE_S, few_s or self._first_s)

    @property
    def silence_s(self) -> float:
        """How long it may say nothing, in seconds."""
        return PATIENCE_S if self._says_hello else self.patience_s

    @property
    def _reopen_after_s(self) -> float:
        return max(REOPEN_S, 2 * self.silence_s)

    def note_rate(self, rate_hz: float) -> None:
        """Take note of the scans a second that the device says it sends; 0 for no steady rate."""
        self._stated_s = LATE_PERIODS * min(1 / rate_hz, LONGEST_PERIOD_S) if rate_hz > 0 else 0.0

    def opened(self, now_s: float) -> None:
        """Take note that a device was plugged in: it gets its time to answer."""
        self.state = DeviceState.STARTING
        self._stated_s = 0.0
        self._pace.clear()
        self._reopen_wait_s = self._reopen_after_s
        self.reopened(now_s)

    def reopened(self, now_s: float) -> None:
        """Take note that the port was opened anew; what ails the device still does."""
        self._bytes_s = self._packet_s = self._scan_s = now_s
        self._since_s = None
        self._has_scan = False
        self._reopen_s = now_s + self._reopen_wait_s

    def heard(self, now_s: float, packets: int, scans: int) -> None:
        """Take note of what a read brought: bytes, with so many packets, so many of them scans."""
        if self._since_s is None or now_s - self._bytes_s >= self.silence_s:
            self._since_s = now_s
        self._bytes_s = now_s
        if scans:
            if self._has_scan:  # how soon after the opening the first one comes is chance
                self._pace.add(now_s - self._scan_s)
            self._scan_s, self._has_scan = now_s, True
            self.state = DeviceState.RUNNING
        if packets:
            self._packet_s = now_s
            self._reopen_wait_s = self._reopen_after_s
            self._reopen_s = now_s + self._reopen_wait_s

    def judge(self, now_s: float) -> DeviceState:
        """Return how the device does; a trouble lasts until what was missing comes again."""
        since_s = self._bytes_s if self._since_s is None else self._since_s
        if now_s - self._bytes_s >= self.silence_s:
            self.state = DeviceState.SILENT
        elif self._packet_s < since_s:  # what comes may yet become a packet
            if now_s - since_s >= self.silence_s:
                self.state = DeviceState.GARBLED
        elif now_s - self._packet_s >= self.silence_s:
            self.state = DeviceState.GARBLED
        elif now_s - self._scan_s >= self.patience_s:
            self.state = DeviceState.IDLE
        return self.state

    def is_reopening_due(self, now_s: float) -> bool:
        """Whether to close the port and open it again now; if so, the next time comes later."""
        is_mute = self.state in (DeviceState.SILENT, DeviceState.GARBLED)
        if not is_mute or now_s < self._reopen_s:
            return False
        self._reopen_wait_s = min(2 * self._reopen_wait_s, REOPEN_MOST_S)
        return True

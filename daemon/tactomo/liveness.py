"""Judging by what comes over an open port whether a device is well, and when to try it anew.

Four kinds of bytes count, each including the next: any, whole packets, scans. Where one kind stays
out for `PATIENCE_S`, the device is in trouble of that kind. A device that answers with nothing
that can be understood may have been left so by its USB bridge, which often comes to its senses
when the port is closed and opened; so that is due after a while, and ever more rarely.

Nothing here reads a clock: times are handed in, in seconds on any one clock.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Final

PATIENCE_S: Final = 3.0
"""A device says hello every second; without a word for so long it counts as silent."""
REOPEN_S: Final = 6.0
REOPEN_MOST_S: Final = 60.0


class DeviceState(StrEnum):
    """How the device at an open port does."""

    STARTING = "starting"
    """Opened a moment ago."""
    RUNNING = "running"
    """Scans come."""
    IDLE = "idle"
    """It speaks, but sends no scans."""
    GARBAGE = "garbage"
    """Bytes come, but no packet."""
    SILENT = "silent"
    """Nothing comes."""


class Liveness:
    """Told what comes; says how the device does. For use by one thread.

    Attributes:
        state: as of the last call.

    """

    def __init__(self) -> None:
        self.state = DeviceState.STARTING
        self._bytes_s = self._packet_s = self._scan_s = 0.0  # when each kind last came
        self._reopen_wait_s = REOPEN_S
        self._reopen_s = 0.0

    def opened(self, now_s: float) -> None:
        """Take note that a device was plugged in: it gets its time to answer."""
        self.state = DeviceState.STARTING
        self._reopen_wait_s = REOPEN_S
        self.reopened(now_s)

    def reopened(self, now_s: float) -> None:
        """Take note that the port was opened anew; what ails the device still does."""
        self._bytes_s = self._packet_s = self._scan_s = now_s
        self._reopen_s = now_s + self._reopen_wait_s

    def heard(self, now_s: float, packets: int, scans: int) -> None:
        """Take note of what a read brought: bytes, with so many packets, so many of them scans."""
        self._bytes_s = now_s
        if packets:
            self._packet_s = now_s
            self._reopen_wait_s = REOPEN_S
            self._reopen_s = now_s + REOPEN_S
        if scans:
            self._scan_s = now_s
            self.state = DeviceState.RUNNING

    def judge(self, now_s: float) -> DeviceState:
        """Return how the device does; a trouble lasts until what was missing comes again."""
        if now_s - self._bytes_s >= PATIENCE_S:
            self.state = DeviceState.SILENT
        elif now_s - self._packet_s >= PATIENCE_S:
            self.state = DeviceState.GARBAGE
        elif now_s - self._scan_s >= PATIENCE_S:
            self.state = DeviceState.IDLE
        return self.state

    def is_reopening_due(self, now_s: float) -> bool:
        """Whether to close the port and open it again now; if so, the next time comes later."""
        is_mute = self.state in (DeviceState.SILENT, DeviceState.GARBAGE)
        if not is_mute or now_s < self._reopen_s:
            return False
        self._reopen_wait_s = min(2 * self._reopen_wait_s, REOPEN_MOST_S)
        return True

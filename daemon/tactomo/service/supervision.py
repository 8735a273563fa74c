"""What the daemon tells the service manager: that it is ready, how it is, and that it gets on.

systemd's notify protocol is one datagram of lines to the socket that $NOTIFY_SOCKET names; where
that is not set, nobody is told. A watchdog that is fed by a timer only proves that the timer runs.
This one is fed while each part's thread gets on with its loop: one that hangs, alone or because
it waits for another, starves it, and the daemon is killed and started again. A device that says
nothing is no hang, since its port's loop goes on waiting.
"""

from __future__ import annotations

import faulthandler
import os
import socket
import time
from collections.abc import Callable, Mapping
from typing import Final

import structlog

STATUS_PERIOD_S: Final = 2.0
FEED_AT: Final = 0.5  # share of the watchdog's time after which it is fed; systemd advises half
TELL_AT: Final = 0.8
"""Share after which the log says which part hangs, while there is still time to say it."""

log = structlog.get_logger()


def notify(*lines: str) -> None:
    """Tell the service manager, such as ``READY=1``; do nothing where there is none."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
            sender.setblocking(False)
            # "@" stands for the NUL byte that a name outside the file system begins with.
            sender.sendto("\n".join(lines).encode(), address.replace("@", "\0", 1))
    except OSError as error:  # the next message may get through
        log.warning("service_manager_unreachable", detail=str(error))


class Supervision:
    """Feeds the watchdog and the status line; for the main thread, which calls `turn` often."""

    def __init__(self, turns: Callable[[], Mapping[str, int]], summary: Callable[[], str]) -> None:
        self._turns = turns  # how often each part's thread went round its loop
        self._summary = summary  # how the daemon is, in one line
        self._period_s = watchdog_s()
        self._fed_s = self._told_s = time.monotonic()
        self._at_feed = turns()
        self._is_hang_told = False
        self._told = ""
        if self._period_s:  # SIGABRT, which ends a hang, then shows in the log where it was
            faulthandler.enable()

    def turn(self) -> None:
        """Tell what is due."""
        now_s = time.monotonic()
        if self._period_s and now_s - self._fed_s >= self._period_s * FEED_AT:
            self._feed(now_s)
        if now_s - self._told_s >= STATUS_PERIOD_S:
            self._told_s = now_s
            self._tell(self._summary())

    def _feed(self, now_s: float) -> None:
        turns = self._turns()
        stuck = [name for name, count in turns.items() if count == self._at_feed.get(name)]
        if not stuck:
            notify("WATCHDOG=1")
            self._fed_s, self._at_feed, self._is_hang_told = now_s, turns, False
        elif not self._is_hang_told and now_s - self._fed_s >= self._period_s * TELL_AT:
            self._is_hang_told = True
            log.error("thread_hangs", threads=stuck, watchdog_s=self._period_s)
            notify(f"STATUS=hangs: {', '.join(stuck)}")

    def _tell(self, summary: str) -> None:
        if summary != self._told and not self._is_hang_told:
            self._told = summary
            notify(f"STATUS={summary}")


def watchdog_s() -> float:
    """Return how long the service manager waits for a sign of life; 0 where it does not wait."""
    if os.environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return 0.0
    return int(os.environ.get("WATCHDOG_USEC", "0")) * 1e-6

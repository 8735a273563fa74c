"""Signals that ask a program to end: each is an orderly end, whoever sends it.

A closed terminal (HUP), Ctrl-\\ (QUIT), and what nobody here has another use for (USR1, USR2) would
end a process at once, its recording unclosed. Who had one of these ignored, as `nohup` does, keeps
that.
"""

from __future__ import annotations

import signal
from collections.abc import Callable
from typing import Any, Final

ASKED: Final = (signal.SIGTERM, signal.SIGINT)
AS_WELL: Final = (signal.SIGHUP, signal.SIGQUIT, signal.SIGUSR1, signal.SIGUSR2)


def that_end() -> tuple[signal.Signals, ...]:
    """The signals that ask this process to end."""
    as_well = (each for each in AS_WELL if signal.getsignal(each) is not signal.SIG_IGN)
    return (*ASKED, *as_well)


def at_end(handler: Callable[[int, Any], Any]) -> None:
    """Have a handler called by whatever asks this process to end; for the main thread."""
    for number in that_end():
        signal.signal(number, handler)

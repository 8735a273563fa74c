r"""What ends a program: signals, whoever sends them, and the end of the program that started it.

A closed terminal (HUP), Ctrl-\\ (QUIT), and what nobody here has another use for (USR1, USR2) would
end a process at once, its recording unclosed. Who had one of these ignored, as `nohup` does, keeps
that.

A parent holds a pipe open to its child's standard input and never writes to it. The operating
system closes it when the parent ends, by `kill -9` too, and the child then stops as it would on
SIGTERM. No process is left behind, and nothing but a pipe is needed for it.
"""

from __future__ import annotations

import os
import signal
import threading
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


VARIABLE = "TACTOMO_PARENT_WATCH"
STDIN = 0
HARD_STOP_S = 3.0


def watch_parent() -> None:
    """In a child that was started with VARIABLE set: stop when standard input ends."""
    if os.environ.pop(VARIABLE, "") == "stdin":
        stop_at_end_of(STDIN)


def stop_at_end_of(pipe: int) -> None:
    """Stop this process when the other end of a pipe, a descriptor, is closed."""
    threading.Thread(
        target=_wait_for_the_end, args=(pipe,), name="parent watch", daemon=True
    ).start()


def _wait_for_the_end(pipe: int) -> None:
    # The descriptor itself: a thread inside sys.stdin would hold its lock when Python shuts down.
    while os.read(pipe, 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    # Nobody is left to lose patience with a process that does not stop.
    threading.Event().wait(HARD_STOP_S)
    os._exit(1)

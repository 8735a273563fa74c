"""Child processes that end with the one that started them, however that one ends.

The parent holds a pipe open to the child's standard input and never writes to it. The operating
system closes it when the parent ends, by `kill -9` too, and the child then stops as it would on
SIGTERM. No process is left behind, and nothing but a pipe is needed for it.
"""

from __future__ import annotations

import os
import signal
import threading

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

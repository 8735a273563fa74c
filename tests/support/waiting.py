"""Wait for what another thread or process does, and no longer than it takes."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Self, TypeVar

PATIENCE_S = 60.0
_T = TypeVar("_T")


class InThread(ABC):
    """Runs `_run` in a thread of its own until closed; usable in a `with` block.

    A class that derives from it calls `__init__` last: that starts the thread.
    """

    def __init__(self) -> None:
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=type(self).__name__)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._closing.set()
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def _run(self) -> None:
        """What the thread does until it is to close."""


@contextmanager
def repeated(say: Callable[[], object], step_s: float = 0.05) -> Iterator[None]:
    """Call a function over and over meanwhile, in a thread of its own."""
    stop = threading.Event()

    def run() -> None:
        while not stop.wait(step_s):
            say()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def wait_until(
    condition: Callable[[], _T],
    what: str = "what a test waits for",
    patience_s: float = PATIENCE_S,
    step_s: float | None = None,
    meanwhile: Callable[[], object] = lambda: None,
) -> _T:
    """Return the first true value of a condition, asked again and again.

    Args:
        condition: gives a true value once it holds.
        what: named if it never holds.
        patience_s: how long, seconds.
        step_s: seconds between two times; None: few at first, more the longer it takes.
        meanwhile: called before each time that the condition is asked.

    Raises:
        AssertionError: the condition did not hold within `patience_s`.

    """
    deadline_s = time.monotonic() + patience_s
    pause_s = 0.002 if step_s is None else step_s
    while True:
        meanwhile()
        if value := condition():
            return value
        assert time.monotonic() < deadline_s, f"waited {patience_s:g} s in vain for {what}"
        time.sleep(pause_s)
        if step_s is None:
            pause_s = min(1.2 * pause_s, 0.02)

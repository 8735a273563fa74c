"""The base of the daemon's threads: started, watched and stopped in one way.

Who writes what: a worker's attributes without an underscore are written by its own thread alone, or
before it starts; every thread may read them. Other threads hand a worker something through a queue,
an event or a future, never by setting an attribute. Where that is not so, a comment says it.
"""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from typing import Any

from tactomo.errors import TactomoError


class Worker:
    """One thread; a subclass has the work in `_run`, which returns soon once `_stopping` is set.

    An exception that ends the thread is in the log; then `is_alive` is False.
    """

    def __init__(
        self,
        name: str,  # the thread's
        # how long `stop` waits for a thread that may hang in the operating system; None: for ever
        join_s: float | None = None,
    ) -> None:
        self.name = name
        self.turns = 0  # how often the thread went round its loop; the watchdog goes by them
        self._join_s = join_s
        self._stopping = threading.Event()
        self._asked: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = queue.SimpleQueue()
        # A thread that may hang for ever must not keep the process from ending.
        self._thread = threading.Thread(target=self._run, name=name, daemon=join_s is not None)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread, and give back what it holds."""
        self._stopping.set()
        self._wake()
        if self._thread.is_alive():
            self._thread.join(self._join_s)
        self._close()

    @property
    def is_alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    def ask(self, work: Callable[[], Any]) -> Future[Any]:
        """Have the thread do something between its turns; for any thread, and never waits."""
        answer: Future[Any] = Future()
        self._asked.put((work, answer))
        self._wake()
        return answer

    def _do_asked(self) -> None:
        """Do what was asked for. A TactomoError is for who asked; any other ends the thread."""
        while not self._asked.empty():
            work, answer = self._asked.get()
            with contextlib.suppress(InvalidStateError):  # nobody waits for it any more
                try:
                    answer.set_result(work())
                except TactomoError as error:
                    answer.set_exception(error)

    def _run(self) -> None:
        raise NotImplementedError

    def _wake(self) -> None:
        """Have a thread that waits look at `_stopping`."""

    def _close(self) -> None:
        """Give back sockets, ports and files, once the thread has ended."""


class Wakeup:
    """Wakes a thread that polls, with its `reader` among what it polls."""

    def __init__(self) -> None:
        self.reader, self._writer = socket.socketpair()
        self.reader.setblocking(False)
        self._writer.setblocking(False)

    def set(self) -> None:
        """Wake the thread; for any thread."""
        with contextlib.suppress(OSError):  # full of reasons to wake up already, or closed
            self._writer.send(b"\0")

    def drain(self) -> None:
        """Forget that it was set; for the thread that polls."""
        with contextlib.suppress(BlockingIOError):
            self.reader.recv(4096)

    def close(self) -> None:
        """Give back the sockets."""
        self.reader.close()
        self._writer.close()

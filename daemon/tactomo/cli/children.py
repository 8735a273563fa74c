"""Commands of ours that one command starts, watches and stops together.

Each child is a `tactomo` command of its own process. It says on one line when it is ready, the last
of what else it prints is kept for the case that it fails, and it ends when this process does (see
`parent_watch`).
"""

from __future__ import annotations

import collections
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Self

from tactomo.ending import AS_WELL, ASKED, VARIABLE, at_end
from tactomo.errors import TactomoError

VIEWER_SAYS = "viewer: "
KEPT_LINES = 12
STOP_S = 10.0
START_S = 180.0


class ManagedProcess:
    """One running `tactomo` command."""

    def __init__(
        self, name: str, arguments: list[str], ended: queue.SimpleQueue[ManagedProcess]
    ) -> None:
        self.name = name
        self._lines: collections.deque[str] = collections.deque(maxlen=KEPT_LINES)
        self._ready: Mapping[str, Any] | None = None
        self._changed = threading.Event()
        self._ended = ended
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tactomo.cli", *arguments],
            stdin=subprocess.PIPE,  # of the parent watch
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env={**os.environ, VARIABLE: "stdin"},
            start_new_session=True,  # Ctrl-C is for this process, which then stops them in order
        )
        self._reader = threading.Thread(target=self._read, name=f"output of {name}", daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Identity of the process."""
        return self._process.pid

    @property
    def is_running(self) -> bool:
        """Whether the process has not ended."""
        return self._process.poll() is None

    @property
    def is_lasting(self) -> bool:
        """Whether it has said that it is ready, as programs do that are to keep running."""
        return self._ready is not None

    @property
    def status(self) -> int:
        """Exit status of the process; waits for its end."""
        return self._process.wait()

    def wait_ready(self) -> Mapping[str, Any]:
        """Return what the child announced; raise TactomoError where it ended or takes too long."""
        if not self._changed.wait(START_S):
            raise TactomoError(
                f"the {self.name} was not ready after {START_S:g} s", self._last_lines()
            )
        if self._ready is None:
            raise self.failure()
        return self._ready

    def wait_done(self) -> None:
        """Wait until a child that does one thing has done it; TactomoError where it failed."""
        if self.status != 0:
            self._reader.join()
            raise self.failure()

    def failure(self) -> TactomoError:
        """Return the error that says how the child ended and what it said last."""
        return TactomoError(
            f"the {self.name} stopped (exit status {self.status})", self._last_lines()
        )

    def stop(self, patience_s: float) -> None:
        """Send SIGTERM and wait for the end; after `patience_s` seconds, kill."""
        if self.is_running:
            self._process.terminate()
        try:
            self._process.wait(max(0.0, patience_s))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()

    def _last_lines(self) -> str:
        return "it said last:\n  " + "\n  ".join(self._lines or ["(nothing)"])

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            ready = _announcement(line)
            if ready is None:
                self._lines.append(_readable(line))
            else:
                self._ready = ready
                self._changed.set()
        self._process.wait()
        self._changed.set()
        self._ended.put(self)


class ProcessGroup:
    """Children that are stopped together when the block ends, however it ends."""

    def __init__(self) -> None:
        self._children: list[ManagedProcess] = []
        self._ended: queue.SimpleQueue[ManagedProcess] = queue.SimpleQueue()

    def start(self, name: str, *arguments: str) -> ManagedProcess:
        """Start one child."""
        self._children.append(ManagedProcess(name, list(arguments), self._ended))
        return self._children[-1]

    def wait_for_an_end(self) -> ManagedProcess:
        """Wait until a child has ended that has not done what it was for, and return it."""
        while (child := self._ended.get()).status == 0 and not child.is_lasting:
            pass
        return child

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with no_interruption():
            # The last one started first: whoever reads stops before what is read from.
            deadline_s = time.monotonic() + STOP_S
            for number, child in enumerate(reversed(self._children), start=1):
                left_s = deadline_s - time.monotonic()
                child.stop(left_s * number / len(self._children))


@contextmanager
def no_interruption() -> Iterator[None]:
    """Ignore signals to end during a block: what stops everything must finish."""
    before = {number: signal.signal(number, signal.SIG_IGN) for number in (*ASKED, *AS_WELL)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def new_group() -> ProcessGroup:
    """Return a new group, which any signal to end ends as Ctrl-C does."""
    interrupt_at_end()
    return ProcessGroup()


def interrupt_at_end() -> None:
    """Let any signal to end, such as a closed terminal's, unwind the main thread as Ctrl-C does.

    Ctrl-C does, too, where a shell had it ignored, as it does for what it starts with `&`.
    """

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    at_end(interrupt)


def stop_asked() -> threading.Event:
    """Return an event that every signal to end sets, which otherwise do nothing from then on."""
    stop = threading.Event()
    at_end(lambda *_: stop.set())
    return stop


def print_ready(addresses: Mapping[str, object]) -> None:
    """Print the one line of JSON by which other programs know that this one is ready."""
    print(json.dumps({"ready": True, **addresses}), flush=True)


def _announcement(line: str) -> Mapping[str, Any] | None:
    """Return what a line says if it says that a program is ready, otherwise None.

    The twin announces itself, the daemon logs it, and the viewer, which is also served without
    tactomo, prints its URL.
    """
    if line.startswith(VIEWER_SAYS):
        return {"url": line.removeprefix(VIEWER_SAYS).strip()}
    fields = _json(line)
    return fields if fields.get("ready") is True or fields.get("event") == "ready" else None


def _readable(line: str) -> str:
    """Return a line of a JSON log as text, and any other line as it is."""
    fields = _json(line)
    if "event" not in fields:
        return line.rstrip()
    head = f"{fields.pop('level', 'info')}: {fields.pop('event')}"
    fields.pop("timestamp", None)
    return " ".join([head, *(f"{name}={value}" for name, value in fields.items())])


def _json(line: str) -> dict[str, Any]:
    try:
        value = json.loads(line) if line.startswith("{") else {}
    except ValueError:
        value = {}
    return value if isinstance(value, dict) else {}

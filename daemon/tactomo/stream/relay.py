"""What carries streams from where they are to where they are asked for: opened, run, closed.

One thread, the main one, touches everything, and nobody waits for a slow reader.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Final

import structlog
import zmq
from tactomo_client import Keys
from tactomo_client.connection import connect_subscriber

from tactomo.ending import at_end
from tactomo.endpoint import allow_connections
from tactomo.stream.access_control import Context

QUEUED: Final = 256  # messages of all sensors together; a daemon keeps 64 of its one
PASSED_AT_ONCE: Final = 64
POLL_MS: Final = 200
LOOK_S: Final = 1.0
SILENT_S: Final = 5.0  # a source that has not answered so long after the start is missed

log = structlog.get_logger()


class Relay:
    """Passes messages on from sources; `open` it, `run` it until `stop`, `close` it."""

    def __init__(self, sources: Sequence[str]) -> None:
        self.address = ""  # where it is bound, once open; empty where nowhere
        self.sources = sources  # where messages come from
        self._stopping = threading.Event()
        self._context: Context = zmq.Context()

    def open(self) -> None:
        """Open what it passes messages by."""
        raise NotImplementedError

    def run(self) -> None:
        """Pass messages on until `stop`."""
        raise NotImplementedError

    def stop(self) -> None:
        """Have `run` return; from any thread or a signal's handler."""
        self._stopping.set()

    def close(self) -> None:
        """Close everything, whatever `open` came to."""
        self._context.term()


class StreamInlet:
    """The connection to one daemon's stream."""

    def __init__(
        self,
        context: Context,
        address: str,
        keys: Keys | None,
    ) -> None:
        self.address = address
        self.socket: zmq.Socket[bytes] = context.socket(zmq.SUB)
        self.socket.setsockopt(zmq.RCVHWM, QUEUED)
        self._connection = connect_subscriber(self.socket, address, [b""], keys=keys)
        self._told: str | None = None
        self._missed_at_s = time.monotonic() + SILENT_S
        self._is_missed = False

    def knock_again(self) -> None:
        """Connect anew where we were not let in, and say so now and then."""
        refusal = self._connection.knock_again()
        if refusal is not None and refusal.name != self._told:
            tell(refusal.name, "error", refusal.cause, refusal.next_step)
        self._told = None if refusal is None else refusal.name
        if refusal is None:
            self._tell_missed()

    def _tell_missed(self) -> None:
        """Say once that this source has never answered, and that it does now."""
        answers = self._connection.handshakes.have_succeeded
        if self._is_missed and answers:
            self._is_missed, self._missed_at_s = False, math.inf
            tell("source_came", "info", f"{self.address} is there now")
        elif not answers and not self._is_missed and time.monotonic() > self._missed_at_s:
            self._is_missed = True
            tell(
                "source_silent",
                "warning",
                f"nothing from {self.address}",
                "start its daemon, or give --from the address that its daemon logs as `stream`",
            )

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()


def waiting(socket: zmq.Socket[bytes]) -> Iterator[bytes]:
    """Yield what waits, a bounded number: the others have their turn."""
    for _ in range(PASSED_AT_ONCE):
        try:
            yield socket.recv(zmq.DONTWAIT)
        except zmq.Again:
            return


def serve(relay: Relay) -> None:
    """Open a relay, serve until a signal asks to end, and close it; for the main thread."""
    at_end(lambda *_: relay.stop())
    allow_connections()
    try:
        relay.open()
        log.info("ready", stream=relay.address or None, sources=list(relay.sources))
        relay.run()
    finally:
        relay.close()
    log.info("stopped")


def tell(name: str, severity: str, detail: str, next_step: str = "") -> None:
    """Log what happened."""
    getattr(log, severity)(name, detail=detail, next_step=next_step)

"""One address of this computer for the streams of several skins.

A daemon serves one skin. This process subscribes to each daemon's stream, most often an ``ipc://``
file, or to Zenoh's (`zenoh_bridge`), to just what its own subscribers ask for, and passes it on at
one address. Sensors are told apart by their topics, as ever. Daemons may come and go.

It never waits for a subscriber: what does not fit into a slow one's queue is lost to that one
alone. One thread, the main one, touches everything.
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
from tactomo_client.messages import STATUS
from tactomo_client.schema import EVENTS, STALE_AFTER_S

from tactomo.ending import at_end
from tactomo.endpoint import allow_connections
from tactomo.events import RateLimit
from tactomo.stream.access_control import STREAM, Context
from tactomo.stream.subscriptions import SUBSCRIBERS_CUT, Subscribers

QUEUED_PER_SUBSCRIBER: Final = 256  # of all sensors together; a daemon keeps 64 of its one
PASSED_AT_ONCE: Final = 64
POLL_MS: Final = 200
LOOK_S: Final = 1.0
SILENT_S: Final = 5.0  # a source that has not answered so long after the start is missed
LINGER_MS: Final = 200
MAX_SENSORS: Final = 64
MAX_TOPIC_BYTES: Final = 128

log = structlog.get_logger()


class Relay:
    """Passes messages on from sources; `open` it, `run` it until `stop`, `close` it."""

    def __init__(self, sources: Sequence[str]) -> None:
        self.address = ""  # where it is bound, once open; empty where nowhere
        self.sources = sources  # where messages come from
        self._stopping = threading.Event()
        self._context: Context = zmq.Context()
        self._inlets: list[Inlet] = []

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
        for inlet in self._inlets:
            inlet.close()
        self._context.term()


class Proxy(Relay):
    """Passes on the streams of several daemons."""

    def __init__(
        self,
        sources: Sequence[str],  # the daemons' stream addresses
        endpoint: str,  # where to bind; no other computer may reach it
    ) -> None:
        super().__init__(sources)
        self._endpoint = endpoint
        self._sensors: dict[bytes, tuple[str, float]] = {}  # who sent it last, and when
        self._statuses: dict[bytes, tuple[bytes, float]] = {}
        self._look_at_s = 0.0
        self._told: set[bytes] = set()
        self._flood = RateLimit()

    def open(self) -> None:
        """Bind, and connect to the sources, whether or not they are there.

        Raises:
            AddressError: the address cannot be had, or can be reached from other computers.
            ControlError: a source's address is not one.
        """
        self._outlet: zmq.Socket[bytes] = self._context.socket(zmq.XPUB)
        self._outlet.setsockopt(zmq.SNDHWM, QUEUED_PER_SUBSCRIBER)
        self._readers = Subscribers(
            self._outlet, self._endpoint, STREAM, self._on_event, None, "--bind"
        )
        self.address = self._readers.address
        for source in self.sources:
            self._inlets.append(self._connect(source))

    def _connect(self, source: str) -> Inlet:
        return StreamInlet(self._context, source)

    def run(self) -> None:
        """Pass messages on until `stop`."""
        poller = zmq.Poller()
        poller.register(self._outlet, zmq.POLLIN)
        for inlet in self._inlets:
            poller.register(inlet.socket, zmq.POLLIN)
        while not self._stopping.is_set():
            ready = dict(poller.poll(POLL_MS))
            if self._outlet in ready:
                self._pass_subscriptions()
            for inlet in self._inlets:
                if inlet.socket in ready:
                    self._pass_messages(inlet)
            self._readers.peers.check()
            self._look_after()

    def close(self) -> None:
        """Close everything, whatever `open` came to."""
        if self.address:
            self._readers.close()
            self._outlet.close(LINGER_MS)
        super().close()

    def _pass_subscriptions(self) -> None:
        """Ask the sources for what the first one asks for here, and no more for what none does."""
        before, cuts = set(self._readers.prefixes), self._readers.cuts
        joined = {prefix for joins, prefix in self._readers.changes() if joins}
        now = set(self._readers.prefixes)
        for inlet in self._inlets:
            inlet.ask(now - before, before - now)
        # To the first of a prefix the daemon says again how it is, to the others we do.
        self._repeat_statuses(joined & before)
        if self._readers.cuts > cuts and self._flood.allows():
            self._on_event("subscribers_cut", *SUBSCRIBERS_CUT)

    def _on_event(self, name: str, detail: str, next_step: str = "", *_: str, **__: str) -> None:
        tell(name, EVENTS[name].severity, detail, next_step)

    def _repeat_statuses(self, prefixes: set[bytes]) -> None:
        oldest_s = time.monotonic() - STALE_AFTER_S
        for topic, (message, came_s) in self._statuses.items():
            if came_s > oldest_s and any(topic.startswith(prefix) for prefix in prefixes):
                self._outlet.send(message, zmq.DONTWAIT)

    def _pass_messages(self, inlet: Inlet) -> None:
        for message in waiting(inlet.socket):
            self._note(inlet.address, message)
            self._outlet.send(message, zmq.DONTWAIT)

    def _note(self, source: str, message: bytes) -> None:
        """Keep the last status of each sensor, and see whether two daemons use one name."""
        topic, _, _ = message[:MAX_TOPIC_BYTES].partition(b"\0")
        sensor, _, kind = topic.partition(b"/")
        now_s = time.monotonic()
        if len(self._sensors) >= MAX_SENSORS and sensor not in self._sensors:
            return
        if kind == STATUS.encode():
            self._statuses[topic + b"\0"] = message, now_s
        other, seen_s = self._sensors.get(sensor, (source, 0.0))
        if other != source and now_s - seen_s < STALE_AFTER_S and sensor not in self._told:
            self._told.add(sensor)
            tell(
                "same_sensor_twice",
                "warning",
                f"{other} and {source} both publish a sensor {sensor.decode('ascii', 'replace')!r}",
                "give one of the daemons another name",
            )
        self._sensors[sensor] = source, now_s

    def _look_after(self) -> None:
        if time.monotonic() < self._look_at_s:
            return
        self._look_at_s = time.monotonic() + LOOK_S
        for inlet in self._inlets:
            inlet.knock_again()


class Inlet:
    """Where messages come from."""

    address: str  # of the source, to tell of it
    socket: zmq.Socket[bytes]  # what to wait for and receive from

    def ask(self, more: set[bytes], less: set[bytes]) -> None:
        """Subscribe to some prefixes, and no more to others."""
        raise NotImplementedError

    def knock_again(self) -> None:
        """Look after the connection, every second."""

    def close(self) -> None:
        """Close the connection."""
        raise NotImplementedError


class StreamInlet(Inlet):
    """The connection to one daemon's stream."""

    def __init__(
        self,
        context: Context,
        address: str,
        keys: Keys | None = None,
        prefixes: Sequence[bytes] = (),
    ) -> None:
        self.address = address
        self.socket: zmq.Socket[bytes] = context.socket(zmq.SUB)
        self.socket.setsockopt(zmq.RCVHWM, QUEUED_PER_SUBSCRIBER)
        self._connection = connect_subscriber(self.socket, address, prefixes, keys=keys)
        self._told: str | None = None
        self._missed_at_s = time.monotonic() + SILENT_S
        self._is_missed = False

    def ask(self, more: set[bytes], less: set[bytes]) -> None:
        """Subscribe to some prefixes, and no more to others."""
        for prefix in more:
            self.socket.subscribe(prefix)
        for prefix in less:
            self.socket.unsubscribe(prefix)

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
    """Open a relay, serve until a signal asks to end, and close it; for the main thread.

    Raises what its `open` raises.
    """
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

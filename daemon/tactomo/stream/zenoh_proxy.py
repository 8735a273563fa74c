"""Zenoh's streams at one address of this computer, for subscribers of ZeroMQ.

Zenoh is asked for just what subscribers ask for. Sensors are told apart by their topics, as ever.
What does not fit into a slow subscriber's queue is lost to that one alone.
"""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any, Final

import zenoh
import zmq
from tactomo_client import MessageError
from tactomo_client.messages import KINDS, STATUS, check_sensor_name
from tactomo_client.schema import EVENTS

from tactomo.events import RateLimit
from tactomo.stream.access_control import STREAM, Context
from tactomo.stream.peers import SUBSCRIBERS_CUT, Subscribers
from tactomo.stream.zenoh_bridge import (
    LOOK_S,
    MAX_SENSORS,
    POLL_MS,
    QUEUED,
    Relay,
    open_session,
    tell,
    waiting,
)

LINGER_MS: Final = 200
MAX_KEYS: Final = 256
"""Beyond as many, all that there is is subscribed to."""


class ZenohProxy(Relay):
    """One address of this computer for what a robot's skins send; ``*`` is every robot."""

    def __init__(self, robot: str, endpoint: str, configuration: Path | None = None) -> None:
        super().__init__([f"tactomo/{robot}"])
        self._endpoint = endpoint
        self._configuration = configuration
        self._inlet: _Inlet | None = None
        self._flood = RateLimit()

    def open(self) -> None:
        """Bind, and open Zenoh.

        Raises AddressError where other computers can reach the address or it cannot be had, and as
        `open_session` does.
        """
        self._outlet: zmq.Socket[bytes] = self._context.socket(zmq.XPUB)
        self._outlet.setsockopt(zmq.SNDHWM, QUEUED)
        self._readers = Subscribers(
            self._outlet, self._endpoint, STREAM, self._on_event, None, "--bind"
        )
        self.address = self._readers.peers.address
        session = open_session(self._configuration, "connect")
        self._inlet = _Inlet(self._context, session, self.sources[0])

    def run(self) -> None:
        """Pass messages on until `stop`."""
        inlet, look_at_s = self._inlet, 0.0
        assert inlet is not None
        poller = zmq.Poller()
        poller.register(self._outlet, zmq.POLLIN)
        poller.register(inlet.socket, zmq.POLLIN)
        while not self._stopping.is_set():
            ready = dict(poller.poll(POLL_MS))
            if self._outlet in ready:
                self._pass_subscriptions(inlet)
            for message in waiting(inlet.socket) if inlet.socket in ready else ():
                self._outlet.send(message, zmq.DONTWAIT)
            self._readers.peers.check()
            if time.monotonic() >= look_at_s:
                look_at_s = time.monotonic() + LOOK_S
                inlet.ask_status()  # as a daemon sends one every second

    def close(self) -> None:
        """Close everything, whatever `open` came to."""
        if self.address:
            self._readers.peers.close()
            self._outlet.close(LINGER_MS)
        if self._inlet is not None:
            self._inlet.close()
        super().close()

    def _pass_subscriptions(self, inlet: _Inlet) -> None:
        """Ask for what somebody here asks for; whoever joins gets the last statuses at once."""
        cuts = self._readers.cuts
        joined = {prefix for joins, prefix in self._readers.changes() if joins}
        inlet.ask(set(self._readers.prefixes), joined)
        if self._readers.cuts > cuts and self._flood.allows():
            self._on_event("subscribers_cut", *SUBSCRIBERS_CUT)

    def _on_event(self, name: str, detail: str, next_step: str = "", *_: str, **__: str) -> None:
        tell(name, EVENTS[name].severity, detail, next_step)


class _Inlet:
    """Where Zenoh's messages come from, owned by the proxy's thread but where said otherwise."""

    def __init__(self, context: Context, session: zenoh.Session, address: str) -> None:
        self.address = address
        self.socket: zmq.Socket[bytes] = context.socket(zmq.PULL)
        self._arriving: zmq.Socket[bytes] = context.socket(zmq.PUSH)
        for socket in (self.socket, self._arriving):
            socket.set_hwm(QUEUED)
        self.socket.bind("inproc://zenoh")
        self._arriving.connect("inproc://zenoh")
        self._session = session
        self._subscribers: dict[str, Any] = {}
        self._lock = threading.Lock()  # of what follows, and of `_arriving`
        self._counts: dict[str, int] = {}
        self._statuses: dict[str, bytes] = {}  # the newest of each key
        self._robots: dict[str, str] = {}  # whose skin each is here
        self._lost = 0
        self._loss_limit, self._name_limit = RateLimit(), RateLimit()
        self._tokens = session.liveliness().declare_subscriber(
            f"{self.address}/*", self._tell_presence, history=True
        )

    def ask(self, prefixes: set[bytes], anew: set[bytes]) -> None:
        """Subscribe to these prefixes alone, and ask for the last status of some of them."""
        wanted = {_key(self.address, prefix) for prefix in prefixes} - {""}
        if len(wanted) > MAX_KEYS:
            wanted = {_key(self.address, b"")}
        if wanted != self._subscribers.keys():
            with self._lock:
                self._counts.clear()  # what was not asked for was not lost
        for key in self._subscribers.keys() - wanted:
            self._subscribers.pop(key).undeclare()
        for key in wanted - self._subscribers.keys():
            self._subscribers[key] = self._session.declare_subscriber(key, self._take)
        self.ask_status({_key(self.address, prefix) for prefix in anew})

    def ask_status(self, keys: set[str] | None = None) -> None:
        """Ask for the last status of some keys; of all that somebody wants, for news alone."""
        only_news = keys is None
        for key in self._subscribers if keys is None else keys:
            above, _, kind = key.rpartition("/")
            if kind in ("*", STATUS):
                self._session.get(
                    f"{above}/{STATUS}",
                    lambda reply: self._arrive(reply.ok, only_news) if reply.ok else None,
                    consolidation=zenoh.ConsolidationMode.NONE,
                )

    def _take(self, sample: zenoh.Sample) -> None:
        """Hand over a sample, once where several subscriptions bring it; in Zenoh's thread."""
        key, count = str(sample.key_expr), _count(sample)
        with self._lock:
            last = self._counts.get(key, 0)
            if count == last:
                return
            if len(self._counts) < MAX_SENSORS * len(KINDS) or last:
                self._counts[key] = count
            self._lost += max(0, count - last - 1) if last else 0
            if self._lost and self._loss_limit.allows():
                tell("messages_lost", "warning", f"{self._lost} so far, of {key} the last")
        self._arrive(sample)

    def _tell_presence(self, sample: zenoh.Sample) -> None:
        """Tell that a skin came or went, and whose name is free again; in Zenoh's thread."""
        came = sample.kind == zenoh.SampleKind.PUT
        tell("skin_came" if came else "skin_gone", "info", str(sample.key_expr))
        _, robot, sensor = str(sample.key_expr).split("/")
        with self._lock:
            if not came and self._robots.get(sensor) == robot:
                del self._robots[sensor]

    def _arrive(self, sample: zenoh.Sample, only_news: bool = False) -> None:
        key = str(sample.key_expr)
        _, robot, sensor, kind = key.split("/")
        data = f"{sensor}/{kind}".encode() + b"\0" + sample.payload.to_bytes()
        with self._lock:
            if self._arriving.closed or (only_news and self._statuses.get(key) == data):
                return  # of a daemon that has gone, the bridge still has the last status
            if (other := self._robots.setdefault(sensor, robot)) != robot:
                if self._name_limit.allows():
                    one, two = sorted((robot, other))
                    detail = f"{one} and {two} both have a skin {sensor!r}"
                    next_step = f"--robot {robot} serves the one that is left out"
                    tell("same_sensor_twice", "warning", detail, next_step)
                return
            if kind == STATUS:
                self._statuses[key] = data
            try:
                self._arriving.send(data, zmq.DONTWAIT)
            except zmq.Again:
                self._lost += 1

    def close(self) -> None:
        """Close the session, then the sockets."""
        self._session.close()  # type: ignore[no-untyped-call]
        with self._lock:
            self._arriving.close(0)
        self.socket.close(0)


def _key(above: str, prefix: bytes) -> str:
    """Return the key expression of the topics that begin so; empty where none can."""
    sensor, slash, rest = prefix.decode("ascii", "replace").partition("/")
    kind = rest.removesuffix("\0")
    is_whole = kind != rest
    try:
        known = check_sensor_name(sensor) if slash else "*"
    except MessageError:
        return ""
    if is_whole and kind not in KINDS:
        return ""
    return f"{above}/{known}/{kind if is_whole else '*'}"


def _count(sample: zenoh.Sample) -> int:
    try:
        return int(sample.attachment.to_string()) if sample.attachment else 0
    except ValueError:
        return 0

"""The stream over Eclipse Zenoh: daemons' messages into Zenoh, and Zenoh's into one stream.

Inward, `ZenohBridge` subscribes to daemons' streams, and publishes what comes
(`zenoh_publication`). Outward, `ZenohProxy` has one address for subscribers of ZeroMQ and
asks Zenoh for what they ask for. Who may connect, and by what encryption, is up to Zenoh's own
configuration. Nobody waits for a slow reader.
Source: https://zenoh.io/docs/manual/abstractions
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Literal

import zenoh
import zmq
from tactomo_client import Keys, MessageError
from tactomo_client.messages import KINDS, STATUS, check_sensor_name

from tactomo.errors import AddressError, ConfigError
from tactomo.events import RateLimit
from tactomo.stream.access_control import Context
from tactomo.stream.proxy import LOOK_S, POLL_MS, Inlet, Proxy, Relay, StreamInlet, tell, waiting
from tactomo.stream.zenoh_publication import MAX_SENSORS, Publication

LOCAL: Final = "tcp/127.0.0.1:7447"
"""Without a configuration of its own: Zenoh's port, on this computer alone."""
QUEUED: Final = 256
"""Messages on their way from Zenoh's threads."""
MAX_KEYS: Final = 256
"""Beyond as many, all that there is is subscribed to."""


def open_session(
    configuration: Path | None, without: Literal["listen", "connect"]
) -> zenoh.Session:
    """Open a Zenoh session as a configuration file has it; without one, at or to `LOCAL`.

    Raises:
        ConfigError: the file cannot be read, or is no configuration of Zenoh.
        AddressError: an address of it cannot be listened on or connected to.
    """
    zenoh.init_log_from_env_or("error")
    try:
        if configuration is None:
            config = zenoh.Config()
            config.insert_json5("scouting/multicast/enabled", "false")
            config.insert_json5("listen/endpoints", "[]")
            config.insert_json5(f"{without}/endpoints", json.dumps([LOCAL]))
        else:
            config = zenoh.Config.from_file(str(configuration))
    except zenoh.ZError as error:
        raise ConfigError(
            f"{configuration} is no configuration of Zenoh: {_words(error)}",
            "see deploy/examples/zenoh_robot.json5, or Zenoh's own DEFAULT_CONFIG.json5",
        ) from error
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise AddressError(
            f"Zenoh cannot be opened as {configuration or LOCAL} asks: {_words(error)}",
            "where another program listens there, give --config with a file that connects to it",
        ) from error


class ZenohBridge(Relay):
    """Publishes daemons' streams in Zenoh.

    Args:
        sources: addresses of the streams.
        robot: under which name.
        configuration: Zenoh's file; None: this computer alone.
        keys: this bridge's own, for sources that want some.
    """

    def __init__(
        self,
        sources: Sequence[str],
        robot: str,
        configuration: Path | None = None,
        keys: Keys | None = None,
    ) -> None:
        super().__init__(sources)
        self._robot = robot
        self._configuration = configuration
        self._keys = keys
        self._session: zenoh.Session | None = None

    def open(self) -> None:
        """Open Zenoh, and connect to the sources, whether or not they are there.

        Raises:
            AddressError, ConfigError: as `open_session` does.
            ControlError: a source's address is not one.
        """
        self._session = open_session(self._configuration, "listen")
        self._publication = Publication(self._session, self._robot)
        for source in self.sources:
            self._inlets.append(StreamInlet(self._context, source, self._keys, [b""]))

    def run(self) -> None:
        """Publish messages until `stop`."""
        poller = zmq.Poller()
        for inlet in self._inlets:
            poller.register(inlet.socket, zmq.POLLIN)
        check_at_s = 0.0
        while not self._stopping.is_set():
            ready = dict(poller.poll(POLL_MS))
            for inlet in self._inlets:
                for data in waiting(inlet.socket) if inlet.socket in ready else ():
                    self._publication.take(inlet.address, data)
            if time.monotonic() >= check_at_s:
                check_at_s = time.monotonic() + LOOK_S
                self._publication.forget_silent()
                for inlet in self._inlets:
                    inlet.knock_again()

    def close(self) -> None:
        """Close everything, whatever `open` came to."""
        super().close()
        if self._session is not None:
            self._session.close()  # type: ignore[no-untyped-call]


class ZenohProxy(Proxy):
    """One address of this computer for what Zenoh has.

    Args:
        robot: whose skins; ``*`` for every robot's.
        endpoint: where to bind; no other computer may reach it.
        configuration: Zenoh's file; None: this computer alone.
    """

    def __init__(self, robot: str, endpoint: str, configuration: Path | None = None) -> None:
        super().__init__([f"tactomo/{robot}"], endpoint)
        self._configuration = configuration

    def _connect(self, source: str) -> Inlet:
        return _ZenohInlet(self._context, open_session(self._configuration, "connect"), source)


class _ZenohInlet(Inlet):
    """Zenoh as a proxy's source, owned by the proxy's thread but where said otherwise."""

    def __init__(self, context: Context, session: zenoh.Session, address: str) -> None:
        self.address = address
        self.socket: zmq.Socket[bytes] = context.socket(zmq.PULL)
        self._arriving: zmq.Socket[bytes] = context.socket(zmq.PUSH)
        for socket in (self.socket, self._arriving):
            socket.set_hwm(QUEUED)
        self.socket.bind("inproc://zenoh")
        self._arriving.connect("inproc://zenoh")
        self._session = session
        self._prefixes: set[bytes] = set()
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

    def ask(self, more: set[bytes], less: set[bytes]) -> None:
        """Subscribe to some prefixes, and no more to others; the last status comes at once."""
        self._prefixes = (self._prefixes | more) - less
        wanted = {_key(self.address, prefix) for prefix in self._prefixes} - {""}
        if len(wanted) > MAX_KEYS:
            wanted = {_key(self.address, b"")}
        if wanted != self._subscribers.keys():
            with self._lock:
                self._counts.clear()  # what was not asked for was not lost
        for key in self._subscribers.keys() - wanted:
            self._subscribers.pop(key).undeclare()
        for key in wanted - self._subscribers.keys():
            self._subscribers[key] = self._session.declare_subscriber(key, self._take)
        self._ask_status({_key(self.address, prefix) for prefix in more}, only_news=False)

    def knock_again(self) -> None:
        """Ask for each status that somebody wants, as a daemon sends one every second."""
        self._ask_status(set(self._subscribers), only_news=True)

    def _ask_status(self, keys: set[str], only_news: bool) -> None:
        for key in keys:
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
                    detail = f"{robot} and {other} both have a skin {sensor!r}"
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


def _words(error: zenoh.ZError) -> str:
    """Return what Zenoh says, without the place in its source."""
    return str(error).partition(" at /")[0].rstrip(".")

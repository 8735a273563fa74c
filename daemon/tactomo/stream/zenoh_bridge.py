"""The stream over Eclipse Zenoh: daemons' messages into Zenoh, and Zenoh's into one stream.

Inward, this process subscribes to daemons' streams, most often ``ipc://`` files, and publishes what
comes (`zenoh_publication`). Outward, it binds one address for subscribers of ZeroMQ and asks Zenoh
for what they ask for. Who may connect, and by what encryption, is up to Zenoh's own configuration.

Nobody waits for a slow reader: what does not fit into a queue is lost to that reader alone. The
main thread owns ZeroMQ's sockets, but for the one by which Zenoh's threads hand over.
Source: https://zenoh.io/docs/manual/abstractions
"""

from __future__ import annotations

import json
import math
import signal
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import structlog
import zenoh
import zmq
from tactomo_client import Keys, MessageError
from tactomo_client.connection import connect_subscriber
from tactomo_client.messages import KINDS, STATUS, check_sensor_name

from tactomo.endpoint import allow_connections
from tactomo.errors import AddressError, ConfigError
from tactomo.events import RateLimit, Severity
from tactomo.stream.access_control import STREAM, Context
from tactomo.stream.subscriptions import SUBSCRIBERS_CUT, Subscribers
from tactomo.stream.zenoh_publication import MAX_SENSORS, Publication

LOCAL: Final[Mapping[str, object]] = {
    "mode": "peer",
    "listen/endpoints": ["tcp/127.0.0.1:7447"],
    "scouting/multicast/enabled": False,
}
"""Without a configuration of its own: Zenoh's port, for this computer alone."""
QUEUED: Final = 256
"""Messages for each subscriber of ZeroMQ, from each source, and on their way between threads; of
all sensors together, where a daemon keeps 64 of its one."""
PASSED_AT_ONCE: Final = 64
POLL_MS: Final = 200
CHECK_S: Final = 1.0
SILENT_S: Final = 5.0
"""A source that has not answered so long after the start is missed."""
LINGER_MS: Final = 200
MAX_KEYS: Final = 256
"""Beyond as many, subscribers of ZeroMQ are served with all that there is."""

log = structlog.get_logger()


def open_session(configuration: Path | None) -> zenoh.Session:
    """Open a Zenoh session as a configuration file has it; without one, on this computer alone.

    Raises:
        ConfigError: the file cannot be read, or is no configuration of Zenoh.
        AddressError: an address of it cannot be listened on or connected to.
    """
    zenoh.init_log_from_env_or("error")
    where = configuration or LOCAL["listen/endpoints"]
    try:
        if configuration is None:
            config = zenoh.Config()
            for key, value in LOCAL.items():
                config.insert_json5(key, json.dumps(value))
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
            f"Zenoh cannot be opened as {where} asks: {_words(error)}",
            "where another program listens there, give --config with a file that connects to it",
        ) from error


class ZenohBridge:
    """Passes messages between ZeroMQ and Zenoh; `open` it, `run` it until `stop`, `close` it.

    Args:
        sources: addresses of daemons' streams, to be published in Zenoh.
        robot: under which name; of what is bound, whose skins: ``*`` for all.
        endpoint: where to bind a stream of what Zenoh has; None: nowhere.
        configuration: Zenoh's file; None: this computer alone.
        keys: this bridge's own, for sources that want some.

    Attributes:
        address: where it is bound, once open; empty where nowhere.
    """

    def __init__(
        self,
        sources: Sequence[str],
        robot: str,
        endpoint: str | None = None,
        configuration: Path | None = None,
        keys: Keys | None = None,
    ) -> None:
        self.address = ""
        self.sources = sources
        self._robot = robot
        self._endpoint = endpoint
        self._configuration = configuration
        self._keys = keys
        self._stopping = threading.Event()
        self._context: Context = zmq.Context()
        self._inlets: list[_Inlet] = []
        self._outlet: _Outlet | None = None
        self._session: zenoh.Session | None = None

    def open(self) -> None:
        """Open Zenoh, bind, and connect to the sources, whether or not they are there.

        Raises:
            AddressError: an address cannot be had, or can be reached from other computers.
            ConfigError: Zenoh's configuration is none.
            ControlError: a source's address is not one.
        """
        self._session = open_session(self._configuration)
        if self.sources:
            self._publication = Publication(self._session, self._robot)
        if self._endpoint is not None:
            self._outlet = _Outlet(self._context, self._endpoint, self._session, self._robot)
            self.address = self._outlet.address
        for source in self.sources:
            self._inlets.append(_Inlet(self._context, source, self._keys))

    def run(self) -> None:
        """Pass messages on until `stop`."""
        poller = zmq.Poller()
        for inlet in self._inlets:
            poller.register(inlet.socket, zmq.POLLIN)
        for socket in self._outlet.sockets if self._outlet else ():
            poller.register(socket, zmq.POLLIN)
        check_at_s = 0.0
        while not self._stopping.is_set():
            ready = dict(poller.poll(POLL_MS))
            for inlet in self._inlets:
                if inlet.socket in ready:
                    for data in _waiting(inlet.socket):
                        self._publication.take(inlet.address, data)
            if self._outlet is not None:
                self._outlet.pass_on()
            if time.monotonic() >= check_at_s:
                check_at_s = time.monotonic() + CHECK_S
                if self.sources:
                    self._publication.forget_silent()
                for inlet in self._inlets:
                    inlet.knock_again()

    def stop(self) -> None:
        """Have `run` return; from any thread or a signal's handler."""
        self._stopping.set()

    def close(self) -> None:
        """Close everything, whatever `open` came to."""
        if self._session is not None:
            self._session.close()  # type: ignore[no-untyped-call]
        for inlet in self._inlets:
            inlet.close()
        if self._outlet is not None:
            self._outlet.close()
        self._context.term()


class _Outlet:
    """A bound XPUB socket with what Zenoh has of what its subscribers ask for."""

    def __init__(self, context: Context, endpoint: str, session: zenoh.Session, robot: str) -> None:
        self._session = session
        self._robot = robot
        self._socket: zmq.Socket[bytes] = context.socket(zmq.XPUB)
        self._socket.setsockopt(zmq.SNDHWM, QUEUED)
        self._readers = Subscribers(self._socket, endpoint, STREAM, _tell, None, "--bind")
        self.address = self._readers.address
        self._subscribers: dict[str, Any] = {}
        self._counts: dict[str, int] = {}
        self._lost = 0
        self._loss_limit, self._flood = RateLimit(), RateLimit()
        self._lock = threading.Lock()
        self._leaving, self._arriving = context.socket(zmq.PULL), context.socket(zmq.PUSH)
        for socket in (self._leaving, self._arriving):
            socket.set_hwm(QUEUED)
        self._leaving.bind("inproc://arrivals")
        self._arriving.connect("inproc://arrivals")
        self._tokens = session.liveliness().declare_subscriber(
            f"tactomo/{robot}/*", _tell_presence, history=True
        )

    @property
    def sockets(self) -> tuple[zmq.Socket[bytes], ...]:
        """What to wait for before `pass_on`."""
        return self._socket, self._leaving

    def pass_on(self) -> None:
        """Ask Zenoh for what is asked for here, and pass on what it has brought."""
        cuts = self._readers.cuts
        joined = {prefix for joins, prefix in self._readers.changes() if joins}
        self._ask({_key(self._robot, prefix) for prefix in self._readers.prefixes} - {""})
        for key in {_key(self._robot, prefix) for prefix in joined}:
            above, _, kind = key.rpartition("/")
            if kind in ("*", STATUS):
                self._session.get(
                    f"{above}/{STATUS}",
                    lambda reply: self._arrive(reply.ok) if reply.ok else None,
                    consolidation=zenoh.ConsolidationMode.NONE,
                )
        for data in _waiting(self._leaving):
            self._socket.send(data, zmq.DONTWAIT)
        self._readers.check()
        if self._readers.cuts > cuts and self._flood.allows():
            _tell("subscribers_cut", "warning", *SUBSCRIBERS_CUT)

    def _ask(self, wanted: set[str]) -> None:
        if len(wanted) > MAX_KEYS:
            wanted = {_key(self._robot, b"")}
        if wanted == self._subscribers.keys():
            return
        with self._lock:
            self._counts.clear()  # what was not asked for was not lost
        for key in self._subscribers.keys() - wanted:
            self._subscribers.pop(key).undeclare()
        for key in wanted - self._subscribers.keys():
            self._subscribers[key] = self._session.declare_subscriber(key, self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        """Pass on a sample, once where several subscriptions bring it; in Zenoh's thread."""
        key, count = str(sample.key_expr), _count(sample)
        with self._lock:
            last = self._counts.get(key, 0)
            if count == last:
                return
            if len(self._counts) < MAX_SENSORS * len(KINDS) or last:
                self._counts[key] = count
            self._lost += max(0, count - last - 1) if last else 0
            if self._lost and self._loss_limit.allows():
                _tell("messages_lost", "warning", f"{self._lost} so far, of {key} the last")
        self._arrive(sample)

    def _arrive(self, sample: zenoh.Sample) -> None:
        _, _, sensor, kind = str(sample.key_expr).split("/")
        data = f"{sensor}/{kind}".encode() + b"\0" + sample.payload.to_bytes()
        with self._lock:
            if self._arriving.closed:
                return
            try:
                self._arriving.send(data, zmq.DONTWAIT)
            except zmq.Again:
                self._lost += 1

    def close(self) -> None:
        """Close all sockets, after the session."""
        self._readers.close()
        self._socket.close(LINGER_MS)
        with self._lock:
            self._leaving.close(0)
            self._arriving.close(0)


class _Inlet:
    """The connection to one daemon's stream."""

    def __init__(self, context: Context, address: str, keys: Keys | None) -> None:
        self.address = address
        self.socket: zmq.Socket[bytes] = context.socket(zmq.SUB)
        self.socket.setsockopt(zmq.RCVHWM, QUEUED)
        self._connection = connect_subscriber(self.socket, address, [b""], keys=keys)
        self._told: str | None = None
        self._missed_at_s = time.monotonic() + SILENT_S
        self._is_missed = False

    def knock_again(self) -> None:
        """Connect anew where this bridge was not let in, and say so now and then."""
        refusal = self._connection.knock_again()
        if refusal is not None and refusal.name != self._told:
            _tell(refusal.name, "error", refusal.cause, refusal.next_step)
        self._told = None if refusal is None else refusal.name
        if refusal is None:
            self._tell_missed()

    def _tell_missed(self) -> None:
        """Say once that this source has never answered, and that it does now."""
        answers = self._connection.handshakes.have_succeeded
        if self._is_missed and answers:
            self._is_missed, self._missed_at_s = False, math.inf
            _tell("source_came", "info", f"{self.address} is there now")
        elif not answers and not self._is_missed and time.monotonic() > self._missed_at_s:
            self._is_missed = True
            _tell(
                "source_silent",
                "warning",
                f"nothing from {self.address}",
                "start its daemon, or give --from the address that its daemon logs as `stream`",
            )

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()


def serve(bridge: ZenohBridge) -> None:
    """Open a bridge, serve until SIGTERM or SIGINT, and close it; for the main thread.

    Raises what `ZenohBridge.open` raises.
    """
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: bridge.stop())
    allow_connections()
    try:
        bridge.open()
        log.info("ready", stream=bridge.address or None, sources=list(bridge.sources))
        bridge.run()
    finally:
        bridge.close()
    log.info("stopped")


def _key(robot: str, prefix: bytes) -> str:
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
    return f"tactomo/{robot}/{known}/{kind if is_whole else '*'}"


def _waiting(socket: zmq.Socket[bytes]) -> Iterator[bytes]:
    """Yield what waits, a bounded number: the others have their turn."""
    for _ in range(PASSED_AT_ONCE):
        try:
            yield socket.recv(zmq.DONTWAIT)
        except zmq.Again:
            return


def _count(sample: zenoh.Sample) -> int:
    try:
        return int(sample.attachment.to_string()) if sample.attachment else 0
    except ValueError:
        return 0


def _tell_presence(sample: zenoh.Sample) -> None:
    came = sample.kind == zenoh.SampleKind.PUT
    _tell("skin_came" if came else "skin_gone", "info", str(sample.key_expr))


def _words(error: zenoh.ZError) -> str:
    """Return what Zenoh says, without the place in its source."""
    return str(error).partition(" at /")[0].rstrip(".")


def _tell(name: str, severity: Severity, detail: str, next_step: str = "") -> None:
    getattr(log, severity)(name, detail=detail, next_step=next_step)

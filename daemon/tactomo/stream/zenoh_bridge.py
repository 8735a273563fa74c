"""The stream over Eclipse Zenoh: daemons' messages by key, counted, answered on query.

Each message's MessagePack map goes under ``tactomo/ROBOT/SENSOR/KIND``. A skin on which nothing
changes is sent by a heartbeat alone. An attachment counts what was sent under a key, so that a
reader tells what was lost from what was held back; a liveliness token ``tactomo/ROBOT/SENSOR`` is
there while the daemon is; a query gets the newest status and contacts (STREAM.md, "Zenoh").

One thread, the main one, touches everything, and nobody waits for a slow reader. The other way is
`zenoh_proxy`. Who may connect, and by what encryption, is up to Zenoh's own configuration.
Source: https://zenoh.io/docs/manual/abstractions
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal

import structlog
import zenoh
import zmq
from tactomo_client import Keys, MessageError
from tactomo_client.connection import connect_subscriber
from tactomo_client.messages import CONTACTS, EVENT, KINDS, MAP, STATUS, Message, decode_message
from tactomo_client.schema import STALE_AFTER_S

from tactomo.ending import at_end
from tactomo.endpoint import allow_connections
from tactomo.errors import AddressError, ConfigError
from tactomo.events import RateLimit
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

    def retry_refused_connection(self) -> None:
        """Connect anew where we were not let in, and say so now and then."""
        refusal = self._connection.retry_refused_connection()
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


LOCAL: Final = "tcp/127.0.0.1:7447"
"""Without a configuration of its own: Zenoh's port, on this computer alone."""


def open_session(
    configuration: Path | None, without: Literal["listen", "connect"]
) -> zenoh.Session:
    """Open a Zenoh session as a configuration file has it; without one, at or to `LOCAL`.

    Raises ConfigError where the file is unusable, AddressError where an address of it is.
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
    """Publishes daemons' streams under a robot's name; `keys` are for sources that want some."""

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
        self._inlets: list[StreamInlet] = []

    def open(self) -> None:
        """Open Zenoh, and connect to the sources, whether or not they are there.

        Raises AddressError or ConfigError as `open_session` does, ControlError for a bad source.
        """
        self._session = open_session(self._configuration, "listen")
        self._publication = Publication(self._session, self._robot)
        for source in self.sources:
            self._inlets.append(StreamInlet(self._context, source, self._keys))

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
                    inlet.retry_refused_connection()

    def close(self) -> None:
        """Close everything, whatever `open` came to."""
        for inlet in self._inlets:
            inlet.close()
        super().close()
        if self._session is not None:
            self._session.close()  # type: ignore[no-untyped-call]


def _words(error: zenoh.ZError) -> str:
    """Return what Zenoh says, without the place in its source."""
    return str(error).partition(" at /")[0].rstrip(".")


HEARTBEAT_S: Final = 0.3
"""Of a skin on which nothing changes. A client takes a frame older than 0.5 s for stale, so 0.2 s
are left for the network; at 20 frames a second it is every sixth one."""
STATUS_HEARTBEAT_S: Final = 5.0
"""Of a status that says what the last one said: with contacts, a skin at rest then sends a sixth of
what it sends by the clock. That a daemon is gone, the token tells; its numbers are asked for."""
MAX_SENSORS: Final = 1024
ENCODING: Final = "application/msgpack"

_MOMENTARY: Final = frozenset(
    {
        *("sequence", "acquired_realtime_ns", "acquired_monotonic_ns", "delay_ns", "device_us"),
        *("skew_ms", "age_ns", "tier_reason", "misfit", "confidence", "scan_counter"),
    }
)
"""Fields that differ from frame to frame of a skin at rest."""
_COUNTED: Final = frozenset(
    {
        *("uptime_s", "ports", "rates", "scans", "frames", "last_minute", "scan_tally", "events"),
        *("channel_skew_ms", "wall_clock", "stage_ms", "latency_ms", "baseline", "process"),
        *("recording", "companions"),
    }
)
"""Fields of a status that differ from second to second; some of them say something beside that."""
_HELD: Final = (MAP, CONTACTS, STATUS)
_ANSWERED: Final = (STATUS, CONTACTS)
_PRIORITIES: Final[Mapping[str, zenoh.Priority]] = {
    CONTACTS: zenoh.Priority.INTERACTIVE_HIGH,
    EVENT: zenoh.Priority.INTERACTIVE_HIGH,
    STATUS: zenoh.Priority.DATA,
}
"""What a narrow link sends first; images come last."""


class Publication:
    """Publishes messages of ZeroMQ's form in Zenoh, under one robot's name. For one thread."""

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        self._session = session
        self._prefix = f"tactomo/{robot}"
        self._skins: dict[str, _Skin] = {}
        self._doubts = RateLimit()
        # For as long as the session lives; called from one of Zenoh's threads.
        session.declare_queryable(f"{self._prefix}/**", self._answer)

    def take(self, source: str, data: bytes) -> None:
        """Publish a message that came from an address, unless it can be held back."""
        try:
            message = decode_message(data)
        except MessageError:
            return  # another program publishes there
        now_s = time.monotonic()
        skin = self._skins.get(message.sensor)
        if skin is None:
            if len(self._skins) >= MAX_SENSORS:
                return
            skin = _Skin(self._session, f"{self._prefix}/{message.sensor}", source)
            self._skins[message.sensor] = skin
        elif skin.source != source and self._doubts.allows():
            log.warning(
                "same_sensor_twice",
                detail=f"{skin.source} and {source} both publish a sensor {message.sensor!r}",
                next_step="give one of the daemons another name",
            )
        skin.take(message, data.partition(b"\0")[2], now_s)
        skin.source = source

    def forget_silent(self) -> None:
        """Withdraw the skins whose daemons are gone."""
        for name, skin in list(self._skins.items()):
            if time.monotonic() - skin.came_s > STALE_AFTER_S:
                self._skins.pop(name).withdraw()

    def _answer(self, query: zenoh.Query) -> None:
        for skin in list(self._skins.values()):
            for key, (body, count) in list(skin.newest.items()):
                if query.key_expr.intersects(zenoh.KeyExpr(key)):
                    query.reply(key, body, encoding=ENCODING, attachment=str(count))


class _Skin:
    """One sensor in Zenoh: its publishers, and a liveliness token."""

    def __init__(self, session: zenoh.Session, prefix: str, source: str) -> None:
        self.source = source
        self.came_s = math.inf
        self.newest: dict[str, tuple[bytes, int]] = {}
        self._prefix = prefix
        self._counts: Counter[str] = Counter()
        self._sent: dict[str, tuple[float, dict[str, Any]]] = {}
        self._token = session.liveliness().declare_token(prefix)
        self._publishers = {
            kind: session.declare_publisher(
                f"{prefix}/{kind}",
                encoding=ENCODING,
                priority=_PRIORITIES.get(kind, zenoh.Priority.DATA_LOW),
            )
            for kind in KINDS
        }

    def take(self, message: Message, body: bytes, now_s: float) -> None:
        """Send a message, unless it tells nothing new and no heartbeat is due."""
        kind = message.kind
        self.came_s = now_s
        if kind not in _HELD or self._is_news(message, now_s):
            self._counts[kind] += 1
            self._publishers[kind].put(body, attachment=str(self._counts[kind]))
        if kind in _ANSWERED:
            self.newest[f"{self._prefix}/{kind}"] = body, self._counts[kind]

    def _is_news(self, message: Message, now_s: float) -> bool:
        fields, kind = message.fields, message.kind
        content = {name: v for name, v in fields.items() if name not in _MOMENTARY}
        if kind == STATUS:
            content = {name: v for name, v in content.items() if name not in _COUNTED}
            ports, events = fields.get("ports"), fields.get("events")
            if isinstance(ports, list):
                content["ports"] = [p.get("state") for p in ports if isinstance(p, dict)]
            if isinstance(events, dict):
                content["events"] = events.get("counts")
            if isinstance(recording := fields.get("recording"), dict):
                content["recording"] = recording.get("path")
        sent_s, last = self._sent.get(kind, (0.0, {}))
        heartbeat_s = STATUS_HEARTBEAT_S if kind == STATUS else HEARTBEAT_S
        if content == last and now_s - sent_s < heartbeat_s:
            return False
        self._sent[kind] = now_s, content
        return True

    def withdraw(self) -> None:
        """Take publishers and token back."""
        self._token.undeclare()  # type: ignore[no-untyped-call]
        for publisher in self._publishers.values():
            publisher.undeclare()  # type: ignore[no-untyped-call]

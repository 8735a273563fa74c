"""The bridge: what a daemon publishes, served over Foxglove's WebSocket protocol.

One thread, `run`'s caller, reads the stream and draws; foxglove-sdk's own threads send to whoever
looks, through a proxy (`origin_proxy`) that no web page but Foxglove's passes. Each of those who
look has a queue of a second or so, of which the oldest is dropped: who is slow sees the newest, and
nobody waits. Nothing that a client sends reaches the daemon.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any, Final, Self
from urllib.parse import urlencode

import foxglove
import zmq
from foxglove.channels import FrameTransformsChannel
from foxglove.websocket import StatusLevel, WebSocketServer
from tactomo_client import ClientError, Frame, Keys, MessageError, schema
from tactomo_client.connection import connect_subscriber
from tactomo_client.messages import (
    EVENT,
    MAP,
    STATUS,
    Message,
    decode_message,
    frame_from_message,
    topic,
)

from tactomo_foxglove.origin_proxy import FOXGLOVE_ORIGIN, OriginProxy, hidden_address
from tactomo_foxglove.topics import SensorTopics

DEFAULT_HOST: Final = "127.0.0.1"
DEFAULT_PORT: Final = 8765
LOOK_PERIOD_S: Final = 0.2
REMIND_PERIOD_S: Final = 1.0
BACKLOG: Final = 128


class BridgeError(ClientError):
    """The bridge cannot be served as asked."""


class Bridge:
    """Serves one or several sensors of one stream. Use it in a `with` block.

    Raises BridgeError where the address is unusable, ClientError for a bad name or stream.
    """

    def __init__(
        self,
        sensors: Sequence[str],  # their names in the stream
        stream: str,  # the daemon's stream, or that of `tactomo zenoh --bind`
        host: str = DEFAULT_HOST,  # the address to listen on
        port: int = DEFAULT_PORT,  # the port to listen on; 0 takes a free one
        keys: Keys | None = None,  # for a daemon beyond this computer
        # of further web pages that may look, such as ``http://localhost:8080``
        origins: Sequence[str] = (),
    ) -> None:
        topics = [topic(sensor, kind) for sensor in sensors for kind in (MAP, STATUS, EVENT)]
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.SUB)
        self._connection = connect_subscriber(self._socket, stream, topics, keys=keys)
        try:
            self._context = foxglove.Context()  # its channels close when it is gone
            self._door, self._server = _serve(sensors, host, port, origins, self._context)
        except ClientError:
            self._connection.close()
            raise
        self.host = host
        transforms = FrameTransformsChannel("/tf", context=self._context)
        self._sensors = {
            sensor: _Sensor(SensorTopics(sensor, self._context, transforms), stream)
            for sensor in sensors
        }

    @property
    def url(self) -> str:
        """Where Foxglove finds it."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"ws://{host}:{self._door.port}"

    @property
    def app_url(self) -> str:
        """The page of Foxglove's web app that opens it."""
        query = urlencode({"ds": "foxglove-websocket", "ds.url": self.url})
        return f"{FOXGLOVE_ORIGIN}?{query}"

    def run(self, stop: threading.Event) -> None:
        """Serve until `stop` is set; raise KeysError where the daemon does not let us in."""
        next_look_s = time.monotonic()
        while not stop.is_set():
            wait_s = max(0.0, next_look_s - time.monotonic())
            if self._socket.poll(round(wait_s * 1e3) + 1):
                self._take(self._socket.recv())
            now_s = time.monotonic()
            if now_s >= next_look_s:
                next_look_s = now_s + LOOK_PERIOD_S
                for sensor in self._sensors.values():
                    sensor.look_around(self._server)
                if refusal := self._connection.refusal():
                    raise refusal

    def close(self) -> None:
        """Stop serving; clients are told goodbye."""
        self._server.stop()
        self._door.close()
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _take(self, data: bytes) -> None:
        try:
            message = decode_message(data)
            if sensor := self._sensors.get(message.sensor):
                sensor.take(message)
        except MessageError:
            return  # another program publishes there; ours will show, or its silence will


class _Sensor:
    """The newest that is known of one sensor, and what has been said about its age."""

    def __init__(self, topics: SensorTopics, stream: str) -> None:
        self._topics = topics
        self._stream = stream
        self._frame: Frame | None = None
        self._status: Mapping[str, Any] = {}
        self._status_s = time.monotonic()
        self._age = _Problem(f"{topics.sensor} stale")
        self._issues = _Problem(f"{topics.sensor} issues")

    def take(self, message: Message) -> None:
        now_ns = time.time_ns()
        if message.kind == MAP:
            self._frame = frame_from_message(
                message, time.monotonic_ns(), schema.FRAME_STALE_AFTER_S
            )
            if not self._frame.is_stale:
                self._topics.frame(self._frame, now_ns, self._frame.age_s)
        elif message.kind == STATUS:
            self._status, self._status_s = message.fields, time.monotonic()
            self._topics.sheet(message.fields["description"], now_ns)
        else:
            self._topics.event(message.fields, now_ns)

    def look_around(self, server: WebSocketServer) -> None:
        """Complain about old data, and about what the daemon finds wrong, as long as that is so."""
        trouble, issues = self._trouble(), self._status.get("issues") or ()
        if self._age.tell(server, trouble) and self._frame is not None:
            self._topics.stale(self._frame, trouble, time.time_ns())
        self._issues.tell(server, "\n".join(f"{i['what']}: {i['next_step']}" for i in issues))

    def _trouble(self) -> str:
        """Return in words why what is shown is not what is now; empty while it is."""
        name = self._topics.sensor
        if time.monotonic() - self._status_s > schema.STALE_AFTER_S:
            return f"STALE: no daemon answers at {self._stream} for {name!r}: is it running?"
        if not self._status:
            return ""
        state = f"the daemon says: {self._status['state']}"
        if self._frame is None:
            return f"{name!r}: no frame yet; {state}"
        if self._frame.is_stale:
            return f"STALE: {name!r} was felt {self._frame.age_s:.1f} s ago; {state}"
        return ""


class _Problem:
    """One entry of Foxglove's list of problems."""

    def __init__(self, identity: str) -> None:
        self._identity = identity
        self._told_s: float | None = None  # None while there is no such problem

    def tell(self, server: WebSocketServer, words: str) -> bool:
        """List the problem, or none where there are no words; return whether it was told now."""
        now_s = time.monotonic()
        if not words and self._told_s is not None:
            server.remove_status([self._identity])
            self._told_s = None
        elif words and (self._told_s is None or now_s - self._told_s >= REMIND_PERIOD_S):
            self._told_s = now_s
            server.publish_status(words, StatusLevel.Warning, self._identity)
            return True
        return False


def _serve(
    sensors: Sequence[str], host: str, port: int, origins: Sequence[str], context: foxglove.Context
) -> tuple[OriginProxy, WebSocketServer]:
    behind = hidden_address()
    try:
        proxy = OriginProxy(host, port, {FOXGLOVE_ORIGIN, *origins})
        server = foxglove.start_server(
            name=f"tactomo: {', '.join(sensors)}",
            host=behind,
            port=0,
            context=context,
            message_backlog_size=BACKLOG,
        )
    except (OSError, OverflowError, RuntimeError) as error:
        raise BridgeError(
            f"cannot listen on {host} port {port}: {getattr(error, 'strerror', None) or error}",
            "stop the program that uses it, or give another with --foxglove-port (0: a free one)",
            name="cannot_listen",
        ) from error
    proxy.open(behind, server.port)
    return proxy, server

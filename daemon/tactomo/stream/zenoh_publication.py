"""The stream's messages in Zenoh: published by key, counted, present, answered on query.

Each message's MessagePack map goes under ``tactomo/ROBOT/SENSOR/KIND``. A skin on which nothing
changes is sent by a heartbeat alone. An attachment counts what was sent under a key, so that a
reader tells what was lost from what was held back; a liveliness token ``tactomo/ROBOT/SENSOR`` is
there while the daemon is; a query gets the newest status and contacts (STREAM.md, "Zenoh").
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Mapping
from typing import Any, Final

import structlog
import zenoh
from tactomo_client import MessageError
from tactomo_client.messages import CONTACTS, EVENT, KINDS, MAP, STATUS, Message, decode_message
from tactomo_client.schema import STALE_AFTER_S

from tactomo.events import RateLimit

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
_HEARTBEATS_S: Final[Mapping[str, float]] = {STATUS: STATUS_HEARTBEAT_S}
_HELD: Final = (MAP, CONTACTS, STATUS)
_ANSWERED: Final = (STATUS, CONTACTS)
_PRIORITIES: Final[Mapping[str, zenoh.Priority]] = {
    CONTACTS: zenoh.Priority.INTERACTIVE_HIGH,
    EVENT: zenoh.Priority.INTERACTIVE_HIGH,
    STATUS: zenoh.Priority.DATA,
}
"""What a narrow link sends first; images come last."""

log = structlog.get_logger()


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
        if content == last and now_s - sent_s < _HEARTBEATS_S.get(kind, HEARTBEAT_S):
            return False
        self._sent[kind] = now_s, content
        return True

    def withdraw(self) -> None:
        """Take publishers and token back."""
        self._token.undeclare()  # type: ignore[no-untyped-call]
        for publisher in self._publishers.values():
            publisher.undeclare()  # type: ignore[no-untyped-call]

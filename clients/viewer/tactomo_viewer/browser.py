"""One open page: sends it the newest frame it has room for, and does what it asks.

Newest wins, for each page by itself: a page confirms each frame, at most two are on their way to
it, and when it has room again it gets the newest one, not the next. So a page on a slow link sees
fewer frames, none of them old, and no other page notices.

Frames go to the page as binary messages, everything else as JSON text. A binary message is one
frame: the length of its header (32 bits, little-endian), the header (JSON, padded with spaces to a
multiple of four bytes), then the images' values (float32, little-endian, row 0 at the bottom), in
the order in which the header's `images` names them. `page/link.js` reads it.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
import math
import time
import uuid
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from aiohttp import WSMessage, WSMsgType, web
from tactomo_client import ClientError, ControlError, Event, Frame, Keys, KeysError, Status, aio
from tactomo_client.appearance import companion_words

IMAGES = ("map", "pressure_kpa", "structure")
FRAME_FIELDS = (
    *("session", "sequence", "scan_counter", "tier", "tier_reason", "misfit", "confidence"),
    *("x_mm", "y_mm"),
)


def frame_message(frame: Frame) -> bytes:
    """Return the binary message of a frame; its age is the age now."""
    images = {name: image for name in IMAGES if (image := getattr(frame, name)) is not None}
    header = {
        "sent_ms": sent_ms(),
        "age_ms": frame.age_s * 1e3,
        **{name: getattr(frame, name) for name in FRAME_FIELDS},
        "flags": sorted(frame.flags),
        "contacts": [dataclasses.asdict(contact) for contact in frame.contacts],
        "images": [{"name": name, "shape": image.shape} for name, image in images.items()],
    }
    text = json_text(header).encode()
    text += b" " * (-len(text) % 4)
    values = [np.ascontiguousarray(image, "<f4").tobytes() for image in images.values()]
    return b"".join([len(text).to_bytes(4, "little"), text, *values])


def sent_ms() -> float:
    """Return when a message is sent, in ms of this process's clock, by which a page dates it."""
    return time.monotonic() * 1e3


def json_text(value: Any) -> str:
    """Return `value` as JSON; what JSON cannot say, such as NaN and bytes, becomes null."""
    return json.dumps(_plain(value), ensure_ascii=False, separators=(",", ":"))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, str | int) or value is None else None


EVENTS_KEPT = 100


class Heard(NamedTuple):
    """An event as it came."""

    number: int  # from 1
    heard_s: float  # monotonic: its envelope has the time of the newest dual scan
    event: Event


class Feed:
    """Reads one sensor's stream. `on_change` is called after each message that was taken in.

    Raises MessageError where `sensor` cannot be a name, ControlError where `address` is none.
    """

    def __init__(
        self, sensor: str, address: str, keys: Keys | None, on_change: Callable[[], None]
    ) -> None:
        self.frame: Frame | None = None  # the newest frame, or None before the first
        self.status: Status | None = None  # the newest status, or None before the first
        self.events: deque[Heard] = deque(maxlen=EVENTS_KEPT)  # the recent ones, oldest first
        self._events_seen = 0
        self._on_change = on_change
        self._news = aio.subscribe(
            sensor, address=address, kind=("map", "status", "event"), keys=keys
        )

    async def run(self) -> None:
        """Read until cancelled, then close the subscription."""
        async with self._news:
            while True:
                try:
                    self._take(await anext(self._news))
                except KeysError:  # it knocks again by itself; the page shows the silence
                    continue

    def _take(self, item: Frame | Status | Event) -> None:
        if isinstance(item, Frame):
            self.frame = item
        elif isinstance(item, Status):
            self.status = item
        else:
            self._events_seen += 1
            self.events.append(Heard(self._events_seen, time.monotonic(), item))
        self._on_change()


MAX_UNCONFIRMED = 2
MAX_ANSWERS = 16
ALIVE_S = 1.0
PRESS_TIMEOUT_S = 2.0
# What a page may ask of the daemon: the arguments it may give and how long the answer may take.
DAEMON_COMMANDS: Mapping[str, tuple[frozenset[str], float]] = {
    "tare": (frozenset(), 15.0),
    "set_tier": (frozenset({"tier"}), 5.0),
    "record_start": (frozenset(), 5.0),
    "record_stop": (frozenset(), 5.0),
    "replay": (frozenset({"paused", "position_s", "speed", "loop", "step"}), 5.0),
}
PRESS_ARGUMENTS = ("x_mm", "y_mm", "pressure_kpa", "radius_mm", "shape")


@dataclasses.dataclass(eq=False)
class Browser:
    """One websocket. `wake` it whenever there may be something new to send."""

    _socket: web.WebSocketResponse
    _feed: Feed
    _daemon: aio.Control | None
    _twin: aio.Control | None

    def __post_init__(self) -> None:
        self._name = uuid.uuid4().hex[:8]
        self._changed = asyncio.Event()
        self._unconfirmed = 0
        self._sent: dict[str, object] = {}  # by kind, what was sent last
        self._last_event = 0
        self.presses: set[str] = set()  # their ids; to be released when the page goes away
        self._answers: set[asyncio.Task[None]] = set()
        self.twin_presses: Sequence[str] | None = None  # their ids; None where no twin answers

    def wake(self) -> None:
        """Have another look at what there is to send."""
        self._changed.set()

    async def run(self) -> None:
        """Serve the page until it closes."""
        self.wake()
        sender = asyncio.create_task(self._send_newest())
        try:
            async for message in self._socket:
                await self._take(message)
        finally:
            sender.cancel()
            # A lost connection may cancel this handler, at any moment: what is pressed is lifted
            # all the same.
            self._leaving = asyncio.create_task(self._leave())
            await asyncio.shield(self._leaving)

    # To the page

    async def _send_newest(self) -> None:
        with contextlib.suppress(ConnectionError):  # the page has gone; run() notices
            while True:
                try:
                    async with asyncio.timeout(ALIVE_S):
                        await self._changed.wait()
                except TimeoutError:
                    await self._send("alive")  # so that the page can tell silence from a hang
                self._changed.clear()
                await self._send_texts()
                frame = self._feed.frame
                if (
                    frame is not None
                    and self._unconfirmed < MAX_UNCONFIRMED
                    and self._is_new(frame)
                ):
                    self._unconfirmed += 1
                    await self._socket.send_bytes(frame_message(frame))

    async def _send_texts(self) -> None:
        own = f"page-{self._name}-"
        presses = self.twin_presses
        twin = {
            "answers": presses is not None,
            "others_press": any(not press.startswith(own) for press in presses or ()),
        }
        if self._sent.get("twin") != twin:
            self._sent["twin"] = twin
            await self._send("twin", **twin)
        status = self._feed.status
        if status is not None and self._is_new(status):
            words = {name: companion_words(each) for name, each in status.companions.items()}
            fields = {**status.fields, "companion_words": words}
            await self._send("status", age_ms=status.age_s * 1e3, status=fields)
        for heard in [e for e in self._feed.events if e.number > self._last_event]:
            self._last_event = heard.number
            age_ms = (time.monotonic() - heard.heard_s) * 1e3
            await self._send("event", age_ms=age_ms, event=heard.event.fields)

    def _is_new(self, item: object) -> bool:
        kind = type(item).__name__
        if self._sent.get(kind) is item:
            return False
        self._sent[kind] = item
        return True

    async def _send(self, kind: str, **fields: Any) -> None:
        await self._socket.send_str(json_text({"type": kind, "sent_ms": sent_ms(), **fields}))

    # From the page

    async def _take(self, message: WSMessage) -> None:
        asked = _asked(message)
        if asked.get("type") == "confirm":
            self._unconfirmed = max(0, self._unconfirmed - 1)
            self.wake()
        elif asked:
            # At most so many at once: a page that asks faster than it is answered has to wait.
            while len(self._answers) >= MAX_ANSWERS:
                await asyncio.wait(self._answers, return_when=asyncio.FIRST_COMPLETED)
            task = asyncio.create_task(self._answer(asked))
            self._answers.add(task)
            task.add_done_callback(self._answers.discard)

    async def _answer(self, asked: dict[str, Any]) -> None:
        try:
            outcome: dict[str, Any] = {"ok": True, "result": await self._obey(asked)}
        except ClientError as error:
            texts = {"name": error.name, "cause": error.cause, "next_step": error.next_step}
            outcome = {"ok": False, "error": texts}
        request = asked.get("request")
        with contextlib.suppress(ConnectionError):
            await self._send(
                "reply", request=request if isinstance(request, int) else None, **outcome
            )

    async def _obey(self, asked: dict[str, Any]) -> dict[str, Any]:
        kind, press = asked.get("type"), f"page-{self._name}-{asked.get('press')}"[:64]
        if kind == "command":
            return await self._command(asked.get("command"), asked.get("arguments", {}))
        if kind == "press":
            if asked.get("hold"):  # it stays, even when the page goes away
                self.presses.discard(press)
            else:
                self.presses.add(press)
            arguments = {name: asked[name] for name in PRESS_ARGUMENTS if name in asked}
            return await self._ask_twin("press", {"id": press, **arguments})
        if kind == "release":
            self.presses.discard(press)
            return await self._ask_twin("release", {"id": press})
        if kind == "clear":
            self.presses.clear()
            return await self._ask_twin("clear", {})
        raise ControlError("the page sent an unknown request", name="unknown_command")

    async def _command(self, command: object, arguments: object) -> dict[str, Any]:
        if not isinstance(command, str) or command not in DAEMON_COMMANDS:
            raise ControlError(
                f"a page may not send the command {command!r}", name="unknown_command"
            )
        allowed, timeout_s = DAEMON_COMMANDS[command]
        if not isinstance(arguments, dict) or not arguments.keys() <= allowed:
            raise ControlError(
                f"a page may not give {command} these arguments", name="bad_argument"
            )
        if self._daemon is None:
            raise _read_only()
        return await self._daemon.request(command, timeout_s, **arguments)

    async def _ask_twin(self, command: str, arguments: dict[str, Any]) -> dict[str, Any]:
        if self._daemon is None:
            raise _read_only()
        if self._twin is None:
            raise ControlError(
                "there is no simulated skin to press",
                "give the viewer a twin's control socket with --twin-control",
                name="no_twin",
            )
        return await self._twin.request(command, PRESS_TIMEOUT_S, **arguments)

    async def _leave(self) -> None:
        # Commands under way are finished first: a release must not overtake its press.
        await asyncio.gather(*self._answers, return_exceptions=True)
        for press in self.presses:
            with contextlib.suppress(ClientError):
                await self._ask_twin("release", {"id": press})


def _asked(message: WSMessage) -> dict[str, Any]:
    """Return what a page asks, or an empty map if it cannot be made out."""
    if message.type is not WSMsgType.TEXT:
        return {}
    try:
        asked = json.loads(message.data)
    except (ValueError, RecursionError):
        return {}
    return asked if isinstance(asked, dict) else {}


def _read_only() -> ControlError:
    return ControlError(
        "this viewer takes no commands, because other computers can open it",
        "open it on that computer, for example through `ssh -L 8750:127.0.0.1:8750`",
        name="read_only",
    )

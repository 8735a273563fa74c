"""Somebody who looks through Foxglove's WebSocket protocol, and protobuf by its own schemas."""

from __future__ import annotations

import asyncio
import base64
import json
import struct
import threading
from typing import Any

import aiohttp
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from waiting import PATIENCE_S, InThread, wait_until

PROTOCOL = "foxglove.sdk.v1"
MESSAGE_DATA = 1


class FoxgloveClient(InThread):
    """A client that subscribes to all topics, in a thread; `reads` False: connects and stops there.

    Attributes:
        channels: what the server advertises, by topic.
        said: the server's other messages in JSON.

    """

    def __init__(self, url: str, *, reads: bool = True) -> None:
        self.channels: dict[str, dict[str, Any]] = {}
        self.said: list[dict[str, Any]] = []
        self._messages: list[tuple[str, bytes]] = []
        self._url, self._reads = url, reads
        self._connected = threading.Event()
        self._error: BaseException | None = None
        super().__init__()
        assert self._connected.wait(PATIENCE_S), "no connection"
        if self._error:
            raise self._error

    def wait(self, topic: str, condition: Any = lambda _: True, *, anew: bool = False) -> Any:
        """Wait for a message on a topic that satisfies the condition, and return it decoded.

        `anew` looks only at what comes from now on.
        """
        seen = len(self._messages) if anew else 0

        def found() -> list[Any]:
            nonlocal seen
            while seen < len(self._messages):
                on, data = self._messages[seen]
                seen += 1
                if on == topic and condition(message := self.decode(topic, data)):
                    return [message]
            return []

        return wait_until(found, f"such a message on {topic}")[0]

    def wait_said(self, condition: Any) -> dict[str, Any]:
        """Wait for another message in JSON."""
        return wait_until(
            lambda: next((said for said in list(self.said) if condition(said)), {}),
            "such a message in JSON",
        )

    def counts(self) -> dict[str, int]:
        """Return how many messages came on each topic."""
        topics = [topic for topic, _ in list(self._messages)]
        return {topic: topics.count(topic) for topic in topics}

    def decode(self, topic: str, data: bytes) -> Any:
        """Return a message: a dict, or protobuf by the schema that the server gave."""
        channel = self.channels[topic]
        if channel["encoding"] == "json":
            return json.loads(data)
        return protobuf(channel["schemaName"], base64.b64decode(channel["schema"]), data)

    def _run(self) -> None:
        try:
            asyncio.run(self._look())
        except Exception as error:
            self._error = error
        finally:
            self._connected.set()

    async def _look(self) -> None:
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(self._url, protocols=[PROTOCOL], max_msg_size=0) as socket,
        ):
            assert socket.protocol == PROTOCOL
            while not self._closing.is_set():
                if not self._reads and self._connected.is_set():
                    await asyncio.sleep(0.05)
                    continue
                try:
                    message = await socket.receive(timeout=0.05)
                except TimeoutError:
                    continue
                if message.type is aiohttp.WSMsgType.TEXT:
                    await self._hear(socket, json.loads(message.data))
                elif message.type is aiohttp.WSMsgType.BINARY:
                    self._take(message.data)
                else:
                    return

    async def _hear(self, socket: aiohttp.ClientWebSocketResponse, said: dict[str, Any]) -> None:
        self.said.append(said)
        if said["op"] == "advertise":
            self.channels |= {channel["topic"]: channel for channel in said["channels"]}
            ids = [{"id": c["id"], "channelId": c["id"]} for c in said["channels"]]
            await socket.send_str(json.dumps({"op": "subscribe", "subscriptions": ids}))
            self._connected.set()

    def _take(self, data: bytes) -> None:
        opcode, channel, _ = struct.unpack_from("<BIQ", data)
        if opcode == MESSAGE_DATA:
            topic = next(t for t, c in self.channels.items() if c["id"] == channel)
            self._messages.append((topic, data[13:]))


def protobuf(name: str, schema: bytes, data: bytes) -> Any:
    """Decode a protobuf message by its file descriptors, as MCAP and the WebSocket carry them."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
        pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
    return kind.FromString(data)

"""The proxy to foxglove-sdk's server, which lets in whoever connects: no web page but Foxglove's.

A browser connects for any page to any port, and says in `Origin` whose page it is. So the proxy
reads the head of each request before it passes on a byte. The server behind it listens where no
page finds it, at one of this computer's 16 million loopback addresses.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import secrets
import socket
import threading
from collections.abc import Collection
from http.client import HTTPException, parse_headers
from typing import Any, Final

from tactomo_client.connection import names_this_computer

FOXGLOVE_ORIGIN: Final = "https://app.foxglove.dev"
HEAD_S: Final = 3.0  # who has not sent a request's head by then is cut off, as on the stream
GOODBYE_S: Final = 0.5
MAX_HEAD_BYTES: Final = 16 * 1024
PASSED_BYTES: Final = 64 * 1024


def hidden_address() -> str:
    """Return a loopback address that no web page can find by trying."""
    return ".".join(map(str, (127, *(1 + secrets.randbelow(254) for _ in range(3)))))


class OriginProxy:
    """Listens in the server's stead, from a thread of its own; `open` it to a server, `close` it.

    Raises OSError where the address cannot be listened on.
    """

    def __init__(self, host: str, port: int, origins: Collection[str]) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._listener = socket.create_server((host, port), family=family)
        self.port: int = self._listener.getsockname()[1]  # where it listens
        self._host = host
        self._origins = frozenset(origins)
        self._behind = ("", 0)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name="foxglove-proxy")

    def open(self, host: str, port: int) -> None:
        """Let clients in to the server that listens there."""
        self._behind = host, port
        self._thread.start()

    def close(self) -> None:
        """Listen no more, and cut off who is in."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
        self._listener.close()
        self._loop.close()

    def _run(self) -> None:
        loop = self._loop
        loop.run_until_complete(
            asyncio.start_server(self._receive, sock=self._listener, limit=MAX_HEAD_BYTES)
        )
        loop.run_forever()
        loop.run_until_complete(_finish(asyncio.all_tasks(loop)))

    async def _receive(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(
            OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError
        ):
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HEAD_S)
            if why := self._refusal(head):
                body = f"{why}\n".encode()
                length = f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode()
                writer.write(b"HTTP/1.1 403 Forbidden\r\n" + length + body)
                await writer.drain()
            else:
                await self._relay(head, reader, writer)
        writer.close()

    async def _relay(
        self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        answers, requests = await asyncio.open_connection(*self._behind)
        try:
            requests.write(head)
            ways = [_pass(reader, requests), _pass(answers, writer)]
            tasks = [asyncio.ensure_future(way) for way in ways]
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in tasks:
                task.cancel()
        finally:
            requests.close()

    def _refusal(self, head: bytes) -> str:
        """Return why a request is turned away; empty where it is not."""
        try:
            headers = parse_headers(io.BytesIO(head.partition(b"\r\n")[2]))
        except HTTPException:
            return "no HTTP request"
        hosts, origins = headers.get_all("Host", []), headers.get_all("Origin", [])
        if len(hosts) != 1 or not names_this_computer(hosts[0], self._host):
            return f"not served under the name {', '.join(hosts)!r}"
        if any(_is_a_pages(origin) and origin not in self._origins for origin in origins):
            return f"a page of {', '.join(origins)} may not look: allow it with --allow-origin"
        return ""


def _is_a_pages(origin: str) -> bool:
    """Tell a web page from an application, such as Foxglove's own, whose origin is no site."""
    return origin == "null" or origin.lower().startswith(("http:", "https:"))


async def _finish(tasks: Collection[asyncio.Task[Any]]) -> None:
    """Give the server's goodbye its time to go through, then cut off who is still in."""
    if tasks:
        _, left = await asyncio.wait(tasks, timeout=GOODBYE_S)
        for task in left:
            task.cancel()
        await asyncio.gather(*left, return_exceptions=True)


async def _pass(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):
        while data := await reader.read(PASSED_BYTES):
            writer.write(data)
            await writer.drain()

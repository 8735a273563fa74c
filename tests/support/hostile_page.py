"""What a web page may try on the sockets of this computer, from another origin than theirs.

ZeroMQ takes whoever does not greet it for a peer of ZMTP 1.0, which has no greeting: an HTTP
request reads as frames, each of a length and a flags byte before its content. Where they end in the
request's head is known to whoever has seen one such head, and then the body holds any message.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Sequence
from urllib.parse import urlsplit

MORE = 1
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

"""A client's socket, as STREAM.md recommends it, and waiting for it in a thread or an event loop.

What a client does is written once, as generators that yield what they wait for (`Waiting`). `wait`
runs one in a thread, `tactomo_client.aio` runs the same one in an event loop; nothing else here or
in the modules that use it ever waits.
"""

from __future__ import annotations

import contextlib
import ipaddress
import time
import weakref
from collections.abc import Generator, Iterable, Iterator
from typing import Any, Final, TypeVar
from urllib.parse import urlsplit

import zmq

from tactomo_client.errors import ControlError, KeysError, MessageError
from tactomo_client.keys import Handshakes, Keys, secure
from tactomo_client.messages import MAX_MESSAGE_BYTES, Message, decode_message

KNOCK_PERIOD_S: Final = 1.0  #: how often a client that was not let in tries again

T = TypeVar("T")
Owner = zmq.Socket[Any]
Waiting = Generator[tuple[Owner, int], bool, T]
"""Yields a socket and for how many milliseconds to wait for a message on it; is sent whether one is
there."""


def wait(steps: Waiting[T]) -> T:
    """Run a generator to its end, blocking this thread while it waits, and return its value."""
    try:
        socket, wait_ms = next(steps)
        while True:
            socket, wait_ms = steps.send(bool(socket.poll(wait_ms)))
    except StopIteration as done:
        result: T = done.value
        return result
    finally:
        steps.close()


def whole_ms(seconds: float) -> int:
    """Return a time in ZeroMQ's whole milliseconds; up, or the last one is spent spinning."""
    return int(max(0.0, seconds) * 1000) + 1


class Connection:
    """One socket connected to one address, watched for whether the server lets this client in.

    Close it, or let it go out of use.
    """

    def __init__(self, owner: Owner, address: str, keys: Keys | None) -> None:
        self.owner = owner  # what to wait for
        self.address = address
        # what to send and receive by, without waiting
        self.socket: zmq.Socket[bytes] = zmq.Socket.shadow(owner.underlying)
        self._keys = keys
        self._knock_at_s = 0.0
        self.handshakes = Handshakes(owner)  # what became of them when `refusal` last looked
        self._closed = weakref.finalize(self, _close, self.handshakes, owner)
        try:
            secure(self.socket, address, keys)
            self.socket.setsockopt(zmq.LINGER, 0)
            self.socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        except BaseException:
            self.close()
            raise

    def connect(self) -> None:
        """Connect, when all options are set.

        Raises:
            ControlError: the address is none.
        """
        try:
            self.socket.connect(self.address)
        except (zmq.ZMQError, UnicodeError) as error:
            self.close()
            reason = error.strerror if isinstance(error, zmq.ZMQError) else "it is no text"
            raise ControlError(
                f"cannot connect to {self.address!r}: {reason}",
                "an address looks like tcp://127.0.0.1:5560 (the stream), tcp://127.0.0.1:5561 "
                "(the control socket) or ipc:///run/tactomo/stream",
                "bad_address",
            ) from error

    @property
    def is_open(self) -> bool:
        """Whether it was not closed."""
        return self._closed.alive

    def close(self) -> None:
        """Close it; closing twice is fine."""
        self._closed()

    def send(self, message: bytes) -> bool:
        """Send a message, if that can be done now: not while the server lets nobody in."""
        try:
            self.socket.send(message, zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True

    def receive(self) -> bytes | None:
        """Return the message that waits; None if there is none after all."""
        try:
            return self.socket.recv(zmq.NOBLOCK)
        except zmq.Again:
            return None

    def heard(self, wait_s: float) -> Iterator[Message]:
        """Yield the messages that have come, after a wait for the first, but malformed ones.

        Raises:
            KeysError: the server does not let this client in.
        """
        wait_ms = round(wait_s * 1e3)
        while self.socket.poll(wait_ms):
            wait_ms = 0
            try:
                message = decode_message(self.socket.recv())
            except MessageError:
                continue
            yield message
        if refusal := self.refusal():
            raise refusal

    def refusal(self) -> KeysError | None:
        """Return why the server lets nobody in by these keys; None as long as it may do so.

        None, too, of a connection that somebody has closed meanwhile.
        """
        return self.handshakes.refusal(self.address, self._keys) if self.is_open else None

    def retry_refused_connection(self) -> KeysError | None:
        """Return why the server does not let us in, if so, and try again from time to time.

        ZeroMQ itself never tries again where a key was refused.
        """
        refusal = self.refusal()
        if refusal and time.monotonic() >= self._knock_at_s:
            self._knock_at_s = time.monotonic() + KNOCK_PERIOD_S
            with contextlib.suppress(zmq.ZMQError):  # the connection may be gone altogether
                self.socket.disconnect(self.address)
            self.socket.connect(self.address)
        return refusal


def _close(handshakes: Handshakes, owner: Owner) -> None:
    handshakes.close()
    owner.close()


def connect_subscriber(
    owner: Owner,
    address: str,
    topics: Iterable[bytes],
    *,
    latest_only: bool = False,
    keys: Keys | None = None,
) -> Connection:
    """Connect a new SUB socket for these topics, or close it and raise ControlError."""
    connection = Connection(owner, address, keys)
    # A computer that lost power never closes its connections; heartbeats notice.
    connection.socket.setsockopt(zmq.HEARTBEAT_IVL, 1000)
    connection.socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, 3000)
    if latest_only:
        connection.socket.setsockopt(zmq.CONFLATE, 1)
    for prefix in topics:
        connection.socket.setsockopt(zmq.SUBSCRIBE, prefix)
    connection.connect()
    return connection


def is_loopback(host: str) -> bool:
    """Return whether only this computer can reach what listens on `host`."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def names_this_computer(host_header: str, served_host: str) -> bool:
    """Return whether a request was for an IP address, `localhost` or the name that is served."""
    try:
        name = urlsplit(f"//{host_header}").hostname or ""
    except ValueError:
        return False
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(name)
        return True
    return name in ("localhost", served_host.lower())

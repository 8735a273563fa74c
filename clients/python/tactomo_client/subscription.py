"""Subscribing to a sensor: iterate for every frame, or ask for the latest one."""

from __future__ import annotations

import contextlib
import math
import time
import weakref
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Literal, Self

import zmq

from tactomo_client.control import bad_address
from tactomo_client.errors import ControlError, KeysError, MessageError, StreamTimeout
from tactomo_client.frame import Frame, frame_from_message
from tactomo_client.keys import Handshakes, Keys, as_keys, secure
from tactomo_client.messages import (
    DEFAULT_STREAM,
    MAX_MESSAGE_BYTES,
    decode_message,
    topic,
)

KNOCK_PERIOD_S: Final = 1.0
"""How often a client that was not let in tries again."""


def subscribe(
    sensor: str,
    *,
    address: str = DEFAULT_STREAM,
    kind: Literal["map", "contacts"] = "map",
    latest_only: bool = False,
    stale_after_s: float = 0.5,
    timeout_s: float | None = None,
    keys: Keys | str | Path | None = None,
) -> Subscription:
    """Subscribe to one sensor's frames.

    Returns at once, whether or not a daemon is there: frames come when it is, and again after it
    was restarted.

    Args:
        sensor: the sensor's name in the daemon's configuration, such as ``left_forearm``.
        address: the daemon's stream.
        kind: ``map`` for images and contacts; ``contacts`` for contacts alone, some 100 bytes a
            frame instead of 30 kB.
        latest_only: keep only the newest frame while the caller is busy. A control loop wants it;
            a logger wants every frame.
        stale_after_s: the age in seconds from which `Frame.is_stale` is true.
        timeout_s: how long the iteration waits for a frame before it raises StreamTimeout; None
            waits for ever (Ctrl-C interrupts it).
        keys: keys, or the folder that holds them, for a daemon beyond this computer.

    Raises:
        MessageError: `sensor` cannot be a sensor's name.
        ControlError: `address` is not an address.
        KeysError: the keys cannot be used.

    """
    return Subscription(sensor, address, kind, latest_only, stale_after_s, timeout_s, as_keys(keys))


class Subscription(Iterator[Frame]):
    """An open subscription. Close it, use it in a `with` block, or let it go out of use.

    Belongs to the thread that uses it, as ZeroMQ's sockets do.

    Attributes:
        missed: how many frames were published but never seen here, by gaps in `sequence`.
        malformed: how many messages were skipped because they broke the rules of STREAM.md.

    """

    def __init__(
        self,
        sensor: str,
        address: str,
        kind: Literal["map", "contacts"],
        latest_only: bool,
        stale_after_s: float,
        timeout_s: float | None,
        keys: Keys | None,
    ) -> None:
        if kind not in ("map", "contacts"):
            raise MessageError(f"cannot subscribe to {kind!r}", "use kind='map' or 'contacts'")
        self.sensor = sensor
        self.address = address
        self.kind = kind
        self.stale_after_s = stale_after_s
        self.timeout_s = timeout_s
        self.missed = 0
        self.malformed = 0
        self._newest: Frame | None = None
        self._keys = keys
        self._knock_at_s = 0.0
        prefix = topic(sensor, kind)
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.SUB)
        self._handshakes = Handshakes(self._socket)
        self._closed = weakref.finalize(self, _close, self._handshakes, self._socket)
        try:
            connect_subscriber(self._socket, address, [prefix], latest_only=latest_only, keys=keys)
        except ControlError:
            self._closed()
            raise

    def __next__(self) -> Frame:
        """Wait for the next frame.

        Raises:
            StreamTimeout: it does not come in time.
            KeysError: the server does not let this client in. The next call knocks once more.

        """
        deadline_s = math.inf if self.timeout_s is None else time.monotonic() + self.timeout_s
        while self._closed.alive:
            wait_s = min(KNOCK_PERIOD_S, max(0.0, deadline_s - time.monotonic()))
            # zmq waits in whole milliseconds: round up, or the last one is spent spinning.
            if self._socket.poll(int(wait_s * 1000) + 1):
                if frame := self._receive():
                    return frame
            elif refusal := self._knock_again():
                raise refusal
            elif time.monotonic() >= deadline_s:
                raise self._timeout()
        raise StopIteration

    def latest(self) -> Frame | None:
        """Return the newest frame there is, without waiting; None before the first one.

        The same frame comes again when no newer one has arrived: look at `Frame.is_stale`.
        """
        while self._closed.alive and self._socket.poll(0):
            self._receive()
        if self._closed.alive and self.is_stale:
            self._knock_again()
        return self._newest

    @property
    def is_stale(self) -> bool:
        """Whether the newest frame received so far is too old, or there was none yet."""
        return self._newest is None or self._newest.is_stale

    def close(self) -> None:
        """Close the subscription; an iteration over it ends. Closing twice is fine."""
        self._closed()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _receive(self) -> Frame | None:
        """Return the frame in the message that waits; None if it was malformed."""
        data = self._socket.recv()
        received_ns = time.monotonic_ns()
        try:
            frame = frame_from_message(decode_message(data), received_ns, self.stale_after_s)
        except MessageError:
            self.malformed += 1
            return None
        if self._newest is not None and self._newest.session == frame.session:
            self.missed += max(0, frame.sequence - self._newest.sequence - 1)
        self._newest = frame
        return frame

    def _knock_again(self) -> KeysError | None:
        """Return why the server does not let us in, if so, and try again from time to time.

        ZeroMQ itself never tries again where a key was refused.
        """
        refusal = self._handshakes.refusal(self.address, self._keys)
        if refusal and time.monotonic() >= self._knock_at_s:
            self._knock_at_s = time.monotonic() + KNOCK_PERIOD_S
            reconnect(self._socket, self.address)
        return refusal

    def _timeout(self) -> StreamTimeout:
        last = "none came before" if self._newest is None else "the stream has stopped"
        return StreamTimeout(
            f"no {self.kind} of sensor {self.sensor!r} at {self.address} "
            f"for {self.timeout_s:g} s ({last})",
            "run `tactomo status` to see whether the daemon runs, under which sensor name, and "
            "what its ports say",
        )


def reconnect(socket: zmq.Socket[Any], address: str) -> None:
    """Drop a connection and make it anew; what is subscribed to stays so."""
    with contextlib.suppress(zmq.ZMQError):  # it may be gone altogether
        socket.disconnect(address)
    socket.connect(address)


def connect_subscriber(
    socket: zmq.Socket[Any],
    address: str,
    topics: Iterable[bytes],
    *,
    latest_only: bool = False,
    keys: Keys | None = None,
) -> None:
    """Set up a SUB socket (a plain or an asyncio one) as STREAM.md recommends, and connect it.

    Raises:
        ControlError: `address` is not an address; the socket is closed then.

    """
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
    # A computer that lost power never closes its connections; heartbeats notice.
    socket.setsockopt(zmq.HEARTBEAT_IVL, 1000)
    socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, 3000)
    secure(socket, address, keys)
    if latest_only:
        socket.setsockopt(zmq.CONFLATE, 1)
    for prefix in topics:
        socket.setsockopt(zmq.SUBSCRIBE, prefix)
    try:
        socket.connect(address)
    except zmq.ZMQError as error:
        socket.close()
        raise bad_address(address, error) from error


def _close(handshakes: Handshakes, socket: zmq.Socket[bytes]) -> None:
    handshakes.close()
    socket.close()

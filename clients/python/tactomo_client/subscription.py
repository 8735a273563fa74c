"""Subscribing to a sensor: iterate for every frame, or ask for the latest one."""

from __future__ import annotations

import time
import weakref
from collections.abc import Iterable, Iterator
from types import TracebackType
from typing import Any, Literal, Self

import zmq

from tactomo_client.control import bad_address
from tactomo_client.errors import MessageError, StreamTimeout
from tactomo_client.frame import Frame, frame_from_message
from tactomo_client.messages import (
    DEFAULT_STREAM,
    MAX_MESSAGE_BYTES,
    decode_message,
    topic,
)


def subscribe(
    sensor: str,
    *,
    address: str = DEFAULT_STREAM,
    kind: Literal["map", "contacts"] = "map",
    latest_only: bool = False,
    stale_after_s: float = 0.5,
    timeout_s: float | None = None,
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

    Raises:
        MessageError: `sensor` cannot be a sensor's name.
        ControlError: `address` is not an address.

    """
    return Subscription(sensor, address, kind, latest_only, stale_after_s, timeout_s)


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
        prefix = topic(sensor, kind)
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.SUB)
        connect_subscriber(self._socket, address, [prefix], latest_only=latest_only)
        self._closed = weakref.finalize(self, self._socket.close)

    def __next__(self) -> Frame:
        """Wait for the next frame; raise StreamTimeout when it does not come in time."""
        deadline = None if self.timeout_s is None else time.monotonic() + self.timeout_s
        while self._closed.alive:
            wait_s = None if deadline is None else max(0.0, deadline - time.monotonic())
            # zmq waits in whole milliseconds: round up, or the last one is spent spinning.
            if not self._socket.poll(None if wait_s is None else int(wait_s * 1000) + 1):
                raise self._timeout()
            if frame := self._receive():
                return frame
        raise StopIteration

    def latest(self) -> Frame | None:
        """Return the newest frame there is, without waiting; None before the first one.

        The same frame comes again when no newer one has arrived: look at `Frame.is_stale`.
        """
        while self._closed.alive and self._socket.poll(0):
            self._receive()
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

    def _timeout(self) -> StreamTimeout:
        last = "none came before" if self._newest is None else "the stream has stopped"
        return StreamTimeout(
            f"no {self.kind} of sensor {self.sensor!r} at {self.address} "
            f"for {self.timeout_s:g} s ({last})",
            "run `tactomo status` to see whether the daemon runs, under which sensor name, and "
            "what its ports say",
        )


def connect_subscriber(
    socket: zmq.Socket[Any], address: str, topics: Iterable[bytes], *, latest_only: bool = False
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
    if latest_only:
        socket.setsockopt(zmq.CONFLATE, 1)
    for prefix in topics:
        socket.setsockopt(zmq.SUBSCRIBE, prefix)
    try:
        socket.connect(address)
    except zmq.ZMQError as error:
        socket.close()
        raise bad_address(address, error) from error

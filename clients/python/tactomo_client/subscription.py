"""Subscribing to a sensor: iterate for every frame, or ask for the latest one."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Generic, Literal, Self, TypedDict, TypeVar, Unpack, cast, overload

import zmq

from tactomo_client.connection import (
    KNOCK_PERIOD_S,
    Owner,
    Waiting,
    connect_subscriber,
    wait,
    whole_ms,
)
from tactomo_client.errors import MessageError, StreamTimeout, checked_seconds
from tactomo_client.keys import Keys, as_keys
from tactomo_client.messages import (
    CONTACTS,
    DEFAULT_STREAM,
    EVENT,
    MAP,
    STATUS,
    Message,
    decode_message,
    frame_from_message,
    topic,
)
from tactomo_client.schema import FRAME_STALE_AFTER_S, STALE_AFTER_S, Event, Frame, Status

Kind = Literal["map", "contacts", "status", "event"]
Item = Frame | Status | Event


class Options(TypedDict, total=False):
    """What any subscription may be given; `subscribe` says what each is for."""

    address: str
    latest_only: bool
    stale_after_s: float | None
    timeout_s: float | None
    keys: Keys | str | Path | None


_STALE_AFTER_S: Final[Mapping[str, float]] = {
    MAP: FRAME_STALE_AFTER_S,
    CONTACTS: FRAME_STALE_AFTER_S,
    STATUS: STALE_AFTER_S,
    EVENT: math.inf,
}

T_co = TypeVar("T_co", bound=Frame | Status | Event, covariant=True)


class Reception(Generic[T_co]):
    """One sensor's messages of some kinds, as they come over one connection.

    Attributes:
        sensor: the sensor's name.
        address: of the stream.
        kinds: what is received.
        timeout_s: how long the iteration waits before it raises StreamTimeout; None: for ever.
        missed: how many messages were published but never seen here, by gaps in `sequence`.
        malformed: how many messages were skipped because they broke the rules of STREAM.md.
    """

    def __init__(
        self,
        sensor: str,
        kind: Kind | tuple[Kind, ...],
        *,
        address: str = DEFAULT_STREAM,
        latest_only: bool = False,
        stale_after_s: float | None = None,
        timeout_s: float | None = None,
        keys: Keys | str | Path | None = None,
    ) -> None:
        self.sensor = sensor
        self.address = address
        self.kinds = _checked(kind, latest_only)
        self.timeout_s = None if timeout_s is None else checked_seconds("timeout_s", timeout_s)
        self.missed = 0
        self.malformed = 0
        self._stale_after_s = (
            None if stale_after_s is None else checked_seconds("stale_after_s", stale_after_s)
        )
        self._newest: T_co | None = None
        self._last: dict[str, tuple[str, int]] = {}  # of each kind, session and sequence
        topics = [topic(sensor, each) for each in self.kinds]
        found = as_keys(keys)
        self._connection = connect_subscriber(
            self._open(), address, topics, latest_only=latest_only, keys=found
        )

    def _open(self) -> Owner:
        raise NotImplementedError

    @property
    def is_stale(self) -> bool:
        """Whether the newest frame received so far is too old, or there was none yet."""
        return self._newest is None or self._newest.is_stale

    def close(self) -> None:
        """Close the subscription; iterations over it end. Closing twice is fine."""
        self._connection.close()

    def _arrival(self, timeout_s: float | None) -> Waiting[T_co | None]:
        """Wait for the next item; the outcome is None after `timeout_s`, or when this is closed.

        Raises:
            KeysError: the server does not let this client in. The next call knocks once more.
        """
        connection = self._connection
        deadline_s = math.inf if timeout_s is None else time.monotonic() + timeout_s
        while connection.is_open:
            wait_s = min(KNOCK_PERIOD_S, deadline_s - time.monotonic())
            is_there = yield connection.owner, whole_ms(wait_s)
            if not connection.is_open:
                break
            if is_there:
                if (item := self._receive()) is not None:
                    return item
            elif refusal := connection.retry_refused_connection():
                raise refusal
            if time.monotonic() >= deadline_s:
                break
        return None

    def _latest(self) -> T_co | None:
        """Take in all that has come, and return the newest item there ever was."""
        connection = self._connection
        if not connection.is_open:
            return self._newest
        while connection.socket.poll(0):
            self._receive()
        if self.is_stale:
            connection.retry_refused_connection()
        return self._newest

    def _end(self) -> StreamTimeout | None:
        """Return the error for an item that has not come in time; None if this was closed."""
        if not self._connection.is_open:
            return None
        last = "none came before" if self._newest is None else "the stream has stopped"
        return StreamTimeout(
            f"no {' or '.join(self.kinds)} of sensor {self.sensor!r} at {self.address} "
            f"for {self.timeout_s:g} s ({last})",
            "run `tactomo status` to see whether the daemon runs, under which sensor name, and "
            "what its ports say",
        )

    def _receive(self) -> T_co | None:
        """Return the item in the message that waits; None if there is none, or a malformed one."""
        data = self._connection.receive()
        if data is None:
            return None
        received_ns = time.monotonic_ns()
        try:
            message = decode_message(data)
            item = self._read(message, received_ns)
        except MessageError:
            self.malformed += 1
            return None
        self._count(message.kind, item)
        self._newest = cast(T_co, item)
        return self._newest

    def _read(self, message: Message, received_ns: int) -> Item:
        own = self._stale_after_s
        stale_after_s = _STALE_AFTER_S[message.kind] if own is None else own
        if message.kind in (MAP, CONTACTS):
            return frame_from_message(message, received_ns, stale_after_s)
        kind = Status if message.kind == STATUS else Event
        return kind.from_fields(message.fields, received_ns, stale_after_s)

    def _count(self, kind: str, item: Item) -> None:
        session, sequence = self._last.get(kind, ("", 0))
        if session == item.session:
            self.missed += max(0, item.sequence - sequence - 1)
        self._last[kind] = item.session, item.sequence


def _checked(kind: Kind | tuple[Kind, ...], latest_only: bool) -> tuple[Kind, ...]:
    kinds = kind if isinstance(kind, tuple) else (kind,)
    if not kinds or not all(each in list(_STALE_AFTER_S) for each in kinds):
        raise MessageError(
            f"cannot subscribe to {kind!r}",
            "use kind='map', 'contacts', 'status' or 'event', or a tuple of some of them",
        )
    if latest_only and len(kinds) > 1:
        raise MessageError(
            "latest_only keeps the newest message of one kind",
            "subscribe to each kind by itself, or without latest_only",
        )
    return kinds


@overload
def subscribe(
    sensor: str, *, kind: Literal["map", "contacts"] = "map", **options: Unpack[Options]
) -> Subscription[Frame]: ...
@overload
def subscribe(
    sensor: str, *, kind: Literal["status"], **options: Unpack[Options]
) -> Subscription[Status]: ...
@overload
def subscribe(
    sensor: str, *, kind: Literal["event"], **options: Unpack[Options]
) -> Subscription[Event]: ...
@overload
def subscribe(
    sensor: str, *, kind: tuple[Kind, ...], **options: Unpack[Options]
) -> Subscription[Item]: ...


def subscribe(
    sensor: str, *, kind: Kind | tuple[Kind, ...] = "map", **options: Unpack[Options]
) -> Subscription[Any]:
    """Subscribe to one sensor's frames, or to what its daemon says of itself.

    Returns at once, whether or not a daemon is there: frames come when it is, and again after it
    was restarted.

    Args:
        sensor: the sensor's name in the daemon's configuration, such as ``left_forearm``.
        kind: ``map`` for images and contacts; ``contacts`` for contacts alone, some 100 bytes a
            frame instead of 30 kB; ``status`` for how the daemon is, every second; ``event`` for
            what happens; or a tuple of some of these, which come as they were published.
        address: the daemon's stream.
        latest_only: keep only the newest frame while the caller is busy. A control loop wants it;
            a logger wants every frame.
        stale_after_s: the age in seconds from which `Frame.is_stale` is true; None for 0.5 s, and
            3 s of a status.
        timeout_s: how long the iteration waits for a frame before it raises StreamTimeout; None
            waits for ever (Ctrl-C interrupts it).
        keys: keys, or the folder that holds them, for a daemon beyond this computer.

    Raises:
        MessageError: `sensor` cannot be a sensor's name, or `kind` a kind.
        ControlError: `address` is not an address.
        KeysError: the keys cannot be used.
        TypeError, ValueError: `stale_after_s` or `timeout_s` is no number, or is negative.

    Example::

        for frame in subscribe("left_forearm"):
            for contact in frame.contacts:
                print(contact.id, contact.x_mm, contact.y_mm, contact.pressure_kpa)
    """
    return Subscription(sensor, kind, **options)


class Subscription(Reception[T_co], Iterator[T_co]):
    """An open subscription. Close it, use it in a `with` block, or let it go out of use.

    Belongs to the thread that uses it, as ZeroMQ's sockets do. `subscribe` makes one.
    """

    def _open(self) -> Owner:
        return zmq.Context.instance().socket(zmq.SUB)

    def __next__(self) -> T_co:
        """Wait for the next frame.

        Raises:
            StreamTimeout: it does not come within `timeout_s`.
            KeysError: the server does not let this client in. The next call knocks once more.
        """
        item = wait(self._arrival(self.timeout_s))
        if item is not None:
            return item
        raise self._end() or StopIteration

    def wait(self, timeout_s: float) -> T_co | None:
        """Wait for the next frame, but no longer than `timeout_s`; None if it has not come then.

        0 or less, what is left of a time that is over, takes a frame that has come.

        Raises:
            KeysError: the server does not let this client in. The next call knocks once more.

        Example::

            frame = skin.wait(0.02)  # 50 times a second, or as soon as there is a frame
        """
        return wait(self._arrival(checked_seconds("timeout_s", timeout_s, past=True)))

    def latest(self) -> T_co | None:
        """Return the newest frame there is, without waiting; None before the first one.

        The same frame comes again when no newer one has arrived: look at `Frame.is_stale`.
        """
        return self._latest()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

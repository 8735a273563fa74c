"""Subscribing to a sensor: iterate for every frame, or ask for the latest one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, Self, Unpack, overload

import zmq

from tactomo_client.arguments import checked_seconds
from tactomo_client.connection import Owner, wait
from tactomo_client.reception import Item, Kind, Options, Reception, T_co
from tactomo_client.schema import Event, Frame, Status


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

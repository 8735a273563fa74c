"""The client for asyncio: the same subscriptions and commands, awaited.

::

    import asyncio

    from tactomo_client.aio import subscribe

    async def main():
        async with subscribe("left_forearm", kind="contacts") as skin:
            async for frame in skin:
                print(frame.contacts)

    asyncio.run(main())

Many subscriptions may run in one event loop. A task that waits may be cancelled at any time: no
frame is lost by it, and what is open stays open until it is closed or goes out of use.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self, TypeVar, Unpack, cast, overload

import zmq
import zmq.asyncio

from tactomo_client.connection import Owner, Waiting
from tactomo_client.control import TIMEOUT_S, ControlLine
from tactomo_client.errors import checked_seconds
from tactomo_client.keys import Keys
from tactomo_client.messages import DEFAULT_CONTROL
from tactomo_client.schema import Event, Frame, Status
from tactomo_client.subscription import Item, Kind, Options, Reception, T_co

__all__ = ["Control", "Subscription", "request", "subscribe"]

T = TypeVar("T")


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
    """Subscribe to one sensor's frames, as `tactomo_client.subscribe` does, within an event loop.

    Arguments and errors are the same.

    Example::

        async with subscribe("left_forearm") as skin:
            async for frame in skin:
                ...
    """
    return Subscription(sensor, kind, **options)


class Subscription(Reception[T_co], AsyncIterator[T_co]):
    """An open subscription of an event loop. Close it, or use it in an `async with` block.

    Belongs to the event loop in which it is first awaited. `subscribe` makes one.
    """

    def _open(self) -> Owner:
        return _open(zmq.SUB)

    async def __anext__(self) -> T_co:
        """Wait for the next frame, in an `async for` or with `anext`.

        Raises:
            StreamTimeout: it does not come within `timeout_s`.
            KeysError: the server does not let this client in. The next call knocks once more.
        """
        item = await _wait(self._arrival(self.timeout_s))
        if item is not None:
            return item
        raise self._end() or StopAsyncIteration

    async def wait(self, timeout_s: float) -> T_co | None:
        """Wait for the next frame, but no longer than `timeout_s`; None if it has not come then.

        0 or less, what is left of a time that is over, takes a frame that has come.

        Raises:
            KeysError: the server does not let this client in. The next call knocks once more.
        """
        return await _wait(self._arrival(checked_seconds("timeout_s", timeout_s, past=True)))

    async def latest(self) -> T_co | None:
        """Return the newest frame there is, without waiting for one; None before the first one.

        The same frame comes again when no newer one has arrived: look at `Frame.is_stale`. Other
        tasks have their turn meanwhile.
        """
        await asyncio.sleep(0)
        return self._latest()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()


async def request(
    command: str,
    address: str = DEFAULT_CONTROL,
    timeout_s: float = TIMEOUT_S,
    *,
    keys: Keys | str | Path | None = None,
    **arguments: Any,
) -> dict[str, Any]:
    """Send one command and return its result as it came, as `tactomo_client.request` does."""
    async with Control(address, keys=keys) as control:
        return await control.request(command, timeout_s, **arguments)


class Control(ControlLine):
    """A control socket, the daemon's or the twin's: `tactomo_client.Control` for asyncio.

    Several tasks may use it at once; their commands are carried out in the order of the calls.
    Arguments are those of `tactomo_client.Control`.
    """

    @cached_property
    def _turn(self) -> asyncio.Lock:
        return asyncio.Lock()

    async def request(
        self, command: str, timeout_s: float | None = None, /, **arguments: Any
    ) -> dict[str, Any]:
        """Send any command and return its result as it came; errors are those of `request`."""
        async with self._turn:
            return await _wait(self._exchange(command, arguments, timeout_s))

    def _open(self) -> Owner:
        return _open(zmq.REQ)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()


async def _wait(steps: Waiting[T]) -> T:
    """Run a generator to its end, letting other tasks run while it waits, and return its value."""
    try:
        socket, wait_ms = next(steps)
        while True:
            socket, wait_ms = steps.send(await _is_readable(socket, wait_ms))
    except StopIteration as done:
        result: T = done.value
        return result
    finally:
        steps.close()


async def _is_readable(socket: Owner, wait_ms: int) -> bool:
    try:
        return bool(await cast(zmq.asyncio.Socket, socket).poll(wait_ms))
    except asyncio.CancelledError:
        task = asyncio.current_task()
        if socket.closed and task is not None and not task.cancelling():
            return False  # it was closed under us; nobody cancelled this task
        raise


def _open(kind: int) -> Owner:
    # Of the plain context, so that the socket's monitor is a plain socket, too.
    return zmq.asyncio.Socket(zmq.Context.instance(), kind)

"""Commands to a running daemon (or twin): one request, one reply, a clear error otherwise."""

from __future__ import annotations

from typing import Any

import zmq

from tactomo_client.errors import ControlError
from tactomo_client.messages import (
    DEFAULT_CONTROL,
    MAX_MESSAGE_BYTES,
    decode_reply,
    encode_request,
)


def request(
    command: str, address: str = DEFAULT_CONTROL, timeout_s: float = 2.0, **arguments: Any
) -> dict[str, Any]:
    """Send one command and return its result.

    Args:
        command: one of the control commands of STREAM.md, for example ``tare``.
        address: the control socket of the daemon, or of the twin.
        timeout_s: how long to wait for the reply, seconds.
        **arguments: the command's arguments, for example ``tier="quiet"``.

    Raises:
        ControlError: the command was refused, or nothing answered (`name` is then ``no_answer``).
        MessageError: what answered does not speak this protocol.

    """
    message = encode_request(command, arguments)
    # A socket per command: after an unanswered request a REQ socket cannot send another.
    socket: zmq.Socket[bytes]
    with zmq.Context.instance().socket(zmq.REQ) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        try:
            socket.connect(address)
        except zmq.ZMQError as error:
            raise bad_address(address, error) from error
        socket.send(message)
        if not socket.poll(round(timeout_s * 1000)):
            raise no_answer(address, timeout_s)
        return decode_reply(socket.recv())


def no_answer(address: str, timeout_s: float) -> ControlError:
    """Return the error for a request that nothing answered."""
    return ControlError(
        f"nothing answered at {address} within {timeout_s:g} s",
        "start the daemon with `tactomo daemon`, or give the address of the one that runs",
        name="no_answer",
    )


def bad_address(address: str, error: zmq.ZMQError) -> ControlError:
    """Return the error for an address that ZeroMQ cannot connect to."""
    return ControlError(
        f"cannot connect to {address!r}: {error.strerror}",
        "an address looks like tcp://127.0.0.1:5561 or ipc:///run/tactomo/control",
        name="bad_address",
    )

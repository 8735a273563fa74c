"""Commands to a running daemon (or twin): one request, one reply, a clear error otherwise."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Final

import zmq

from tactomo_client.errors import ControlError
from tactomo_client.keys import Handshakes, Keys, as_keys, secure
from tactomo_client.messages import (
    DEFAULT_CONTROL,
    MAX_MESSAGE_BYTES,
    decode_reply,
    encode_request,
)

LOOK_S: Final = 0.1


def request(
    command: str,
    address: str = DEFAULT_CONTROL,
    timeout_s: float = 2.0,
    *,
    keys: Keys | str | Path | None = None,
    **arguments: Any,
) -> dict[str, Any]:
    """Send one command and return its result.

    Args:
        command: one of the control commands of STREAM.md, for example ``tare``.
        address: the control socket of the daemon, or of the twin.
        timeout_s: how long to wait for the reply, seconds.
        keys: keys, or the folder that holds them, for a daemon beyond this computer.
        **arguments: the command's arguments, for example ``tier="quiet"``.

    Raises:
        ControlError: the command was refused, or nothing answered (`name` is then ``no_answer``).
        KeysError: the keys cannot be used, or the server does not let them in.
        MessageError: what answered does not speak this protocol.

    """
    message = encode_request(command, arguments)
    used = as_keys(keys)
    # A socket per command: after an unanswered request a REQ socket cannot send another.
    socket: zmq.Socket[bytes]
    with zmq.Context.instance().socket(zmq.REQ) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        secure(socket, address, used)
        handshakes = Handshakes(socket)
        try:
            socket.connect(address)
            socket.send(message)
            deadline_s = time.monotonic() + timeout_s
            while not socket.poll(_wait_ms(deadline_s)):
                if refusal := handshakes.refusal(address, used):
                    raise refusal
                if time.monotonic() >= deadline_s:
                    raise no_answer(address, timeout_s)
            return decode_reply(socket.recv())
        except zmq.ZMQError as error:
            raise bad_address(address, error) from error
        finally:
            handshakes.close()


def _wait_ms(deadline_s: float) -> int:
    """Return how long to wait before a look at why there is no answer; rounded up."""
    return int(min(LOOK_S, max(0.0, deadline_s - time.monotonic())) * 1000) + 1


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

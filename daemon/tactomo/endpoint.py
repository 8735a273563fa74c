"""Binding the daemon's sockets, with an error that says what to do when that cannot be done."""

from __future__ import annotations

import socket as posix_socket
from pathlib import Path

import zmq

from tactomo.errors import AddressError


def bind(socket: zmq.Socket[bytes], endpoint: str, purpose: str) -> str:
    """Bind `socket` and return its address, with the port that was chosen where any would do.

    The socket is closed when that fails.

    Raises:
        AddressError: the address is in use or cannot be had.

    """
    try:
        if endpoint.startswith("ipc://") and _is_served(Path(endpoint.removeprefix("ipc://"))):
            raise zmq.ZMQError(zmq.EADDRINUSE)
        socket.bind(endpoint)
    except zmq.ZMQError as error:
        socket.close()
        if error.errno == zmq.EADDRINUSE:
            raise AddressError(
                f"{endpoint} ({purpose}) is in use",
                f"stop the daemon that runs already, or give another address with --{purpose}",
                "address_in_use",
            ) from error
        raise AddressError(
            f"cannot bind {endpoint} ({purpose}): {error.strerror}",
            f"give another address with --{purpose}",
        ) from error
    return str(socket.getsockopt_string(zmq.LAST_ENDPOINT))


def _is_served(path: Path) -> bool:
    """Whether somebody listens there; ZeroMQ itself would take the path away from them."""
    with posix_socket.socket(posix_socket.AF_UNIX, posix_socket.SOCK_STREAM) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            return False
        return True

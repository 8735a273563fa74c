"""Binding our sockets: only where it is safe, with an error that says what to do otherwise.

Without keys an address must be one that no other computer can reach. An ``ipc://`` file may be
connected to by its owner and group alone; it goes when its program ends, and what a killed one left
is replaced. With keys (`tactomo.stream.access_control`) every ``tcp://`` address is encrypted and
lets in the allowed clients only.
"""

from __future__ import annotations

import os
import resource
import socket as posix_socket
import stat
import time
from contextlib import suppress
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

import zmq
from tactomo_client.connection import is_loopback

from tactomo.errors import AddressError

IPC: Final = "ipc://"
HANDSHAKE_MS: Final = 3000  # who has not finished the handshake by then is cut off
REBIND_S: Final = 2.0
MAX_OPEN: Final = 8192  # files and connections of a process; the systemd units say the same
ADDRESS_STEP: Final = 20
"""From one skin's default TCP ports to the next one's."""


def allow_connections() -> None:
    """Let this process have as many connections at once as the system allows, up to MAX_OPEN.

    Who connects and says nothing takes a descriptor for HANDSHAKE_MS, and ports and recordings need
    some, too.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MAX_OPEN if hard == resource.RLIM_INFINITY else min(hard, MAX_OPEN)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def check_endpoint(endpoint: str) -> str:
    """Return an endpoint that may be bound to: ``ipc://PATH`` or ``tcp://HOST:PORT``.

    Port 0 means any free one. Raises ValueError for anything else, saying what may be used.
    """
    path = endpoint.removeprefix(IPC)
    if path != endpoint and path[:1] not in ("", "@") and "\0" not in path:
        return endpoint
    try:
        parts = urlsplit(endpoint)
        is_tcp = parts.scheme == "tcp" and parts.hostname and parts.port is not None
    except ValueError:  # a port that is no number or is out of range
        is_tcp = False
    if not is_tcp or parts.path:
        raise ValueError("use tcp://127.0.0.1:PORT, with port 0 for any free one, or ipc://PATH")
    return endpoint


def is_local(endpoint: str) -> bool:
    """Whether an endpoint can be reached from its own computer alone."""
    return endpoint.startswith(IPC) or is_loopback(urlsplit(endpoint).hostname or "")


def next_address(address: str, steps: int = 1) -> str:
    """Return the address of a skin so many skins after the one at ``tcp://HOST:PORT``."""
    host, _, port = address.rpartition(":")
    return f"{host}:{int(port) + steps * ADDRESS_STEP}"


def free_addresses(*addresses: str) -> list[str]:
    """Return ``tcp://HOST:PORT`` addresses, moved on together to where nothing listens yet."""
    steps = 0
    while any(_is_taken(next_address(address, steps)) for address in addresses):
        steps += 1
    return [next_address(address, steps) for address in addresses]


def _is_taken(address: str) -> bool:
    parts = urlsplit(address)
    with posix_socket.socket() as probe:
        return probe.connect_ex((parts.hostname, parts.port)) == 0


def check_metrics_address(address: str) -> str:
    """Return ``HOST:PORT`` of this computer; raise ValueError, saying what to use, otherwise."""
    endpoint = f"tcp://{address}"
    try:
        check_endpoint(endpoint)
    except ValueError:
        raise ValueError("use 127.0.0.1:PORT, with port 0 for any free one") from None
    if not is_local(endpoint):
        raise ValueError(
            f"{urlsplit(endpoint).hostname} can be reached from other computers, and nothing "
            "guards the metrics; use 127.0.0.1:PORT and have an agent there pass them on"
        )
    return address


def bind(
    socket: zmq.Socket[bytes],  # a socket that has not been bound
    endpoint: str,  # where to
    purpose: str,  # what it is for, also the domain under which a `AccessControl` knows it
    *,
    secret: bytes | None = None,  # the server's secret CURVE key; None where the address needs none
    # the command line's option for another address; by default named as the purpose
    option: str = "",
) -> str:
    """Bind `socket` and return its address, with the port that was chosen where any would do.

    The socket is closed when that fails.

    Raises AddressError where the address is in use, cannot be had, or can be reached from other
    computers and there are no keys.
    """
    option = option or f"--{purpose}"
    try:
        if secret is None and not is_local(endpoint):
            raise needs_keys(endpoint)
        _secure(socket, endpoint, purpose, secret)
        _bind(socket, endpoint)
    except AddressError:
        socket.close()
        raise
    except (zmq.ZMQError, OSError) as error:  # OSError: an ipc:// path that cannot be looked at
        socket.close()
        if error.errno == zmq.EADDRINUSE:
            raise AddressError(
                f"{endpoint} ({purpose}) is in use",
                f"stop the program that runs already, or give another address: {option} "
                + (next_address(endpoint) if endpoint.startswith("tcp:") else "ipc://PATH"),
                "address_in_use",
            ) from error
        raise AddressError(
            f"cannot bind {endpoint} ({purpose}): {error.strerror}",
            f"give another address with {option}",
        ) from error
    return str(socket.getsockopt_string(zmq.LAST_ENDPOINT)).rstrip("\0")


def rebind(socket: zmq.Socket[bytes], address: str) -> None:
    """Cut every connection to a bound socket; who is still allowed in connects again by itself.

    Raises AddressError where another program has taken the address meanwhile.
    """
    socket.unbind(address)
    deadline_s = time.monotonic() + REBIND_S
    while True:
        try:
            _bind(socket, address)
        except zmq.ZMQError as error:  # the old listener closes in the background
            if time.monotonic() > deadline_s:
                raise AddressError(
                    f"cannot bind {address} again: {error.strerror}", "start the daemon again"
                ) from error
            time.sleep(0.001)
        else:
            return


def remove_file(endpoint: str) -> None:
    """Remove the file of a bound ``ipc://`` endpoint, which ZeroMQ leaves behind.

    To be called before the socket closes: afterwards the path may be another's.
    """
    path = Path(endpoint.removeprefix(IPC))
    with suppress(OSError):
        if endpoint.startswith(IPC) and path.is_socket():
            path.unlink()


def needs_keys(endpoint: str) -> AddressError:
    """Return the error for an address beyond this computer without keys."""
    return AddressError(
        f"{endpoint} can be reached from other computers, and anybody there could read the stream "
        "or command the daemon",
        "use tcp://127.0.0.1:PORT or ipc://PATH, or give it keys: `tactomo keys make NAME "
        "--server` makes them and tells what to do with them",
        "keys_needed",
    )


def _secure(socket: zmq.Socket[bytes], endpoint: str, purpose: str, secret: bytes | None) -> None:
    socket.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
    # A computer that lost power never closes its connections; the kernel's probes notice.
    socket.setsockopt(zmq.TCP_KEEPALIVE, 1)
    socket.setsockopt(zmq.TCP_KEEPALIVE_IDLE, 30)
    socket.setsockopt(zmq.TCP_KEEPALIVE_INTVL, 10)
    socket.setsockopt(zmq.TCP_KEEPALIVE_CNT, 3)
    # A socket with a domain refuses ZMTP 1.0, which has no greeting: a page's POST passes for it.
    socket.setsockopt_string(zmq.ZAP_DOMAIN, purpose)
    if secret is not None and not endpoint.startswith(IPC):
        socket.setsockopt(zmq.CURVE_SERVER, 1)
        socket.setsockopt(zmq.CURVE_SECRETKEY, secret)
        # Without this ZeroMQ lets everybody in when nobody is there to ask.
        socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)


def _bind(socket: zmq.Socket[bytes], endpoint: str) -> None:
    if not endpoint.startswith(IPC):
        socket.bind(endpoint)
        return
    _check_file(endpoint, Path(endpoint.removeprefix(IPC)))
    before = os.umask(0o117)  # of the file; the process's, for the moment of one system call
    try:
        socket.bind(endpoint)
    finally:
        os.umask(before)


def _check_file(endpoint: str, path: Path) -> None:
    """Refuse what ZeroMQ would do: take the path away from whoever serves it, or delete a file."""
    if path.exists() and not stat.S_ISSOCK(path.stat().st_mode):
        raise AddressError(
            f"{path} is there and is no socket", f"remove it, or give another path than {endpoint}"
        )
    if _is_served(path):
        raise zmq.ZMQError(zmq.EADDRINUSE)


def _is_served(path: Path) -> bool:
    with posix_socket.socket(posix_socket.AF_UNIX, posix_socket.SOCK_STREAM) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            return False
        return True

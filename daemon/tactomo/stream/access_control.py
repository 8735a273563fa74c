"""Who may come in by a ``tcp://`` address that has keys: the list of clients, and its thread.

The list is a folder of public keys, which `tactomo keys allow` and `revoke` change::

    left_forearm.clients/ros.key                 ros may read the stream
    left_forearm.clients/may_command/desk.key    desk may read the stream and use the control socket

It is read again when it changes. A client that was taken off it is cut off within a second or two.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import zmq
from tactomo_client.errors import KeysError
from tactomo_client.keys import PUBLIC_SUFFIX, read_public, read_secret
from zmq.auth.thread import ThreadAuthenticator

from tactomo.events import OnEvent
from tactomo.stream.keys import MAY_COMMAND, how_to_allow

STREAM: Final = "stream"
CONTROL: Final = "control"
MAX_CLIENTS: Final = 1000
CHECK_S: Final = 1.0

Context = zmq.Context[zmq.Socket[bytes]]
Signature = tuple[tuple[str, int, int], ...]


@dataclass(frozen=True)
class ServerKeys:
    """A server's secret key (Z85), and the folder that says who may come in."""

    secret: bytes = field(repr=False)
    clients: Path


def load_server_keys(secret: Path, clients: Path) -> ServerKeys:
    """Read a server's secret key.

    Raises KeysError where it cannot be used, see `read_secret`, or there is no such folder of
    clients, or others than its owner may write to that.
    """
    if not clients.is_dir():
        raise KeysError(
            f"the folder {clients} of allowed clients does not exist",
            f"make it: `mkdir -p {shlex.quote(str(clients))}`; then {how_to_allow(clients)}",
        )
    check_closed(clients)
    return ServerKeys(read_secret(secret)[1], clients)


def check_closed(clients: Path) -> None:
    """Raise KeysError where others than root and this process's user may add keys to a list."""
    folders = [clients, clients / MAY_COMMAND, *clients.glob(f"**/*{PUBLIC_SUFFIX}")]
    for path in folders:
        try:
            info = path.stat()
        except OSError:  # none may command, or removed in this very moment
            continue
        if info.st_mode & 0o022 or info.st_uid not in (0, os.geteuid()):
            quoted = shlex.quote(str(path))
            raise KeysError(
                f"{path} belongs to user {info.st_uid} and has the mode {info.st_mode & 0o777:o}: "
                "others could let themselves in",
                f"take out what is not yours, then `chown {os.geteuid()} {quoted}` and "
                f"`chmod go-w {quoted}`",
                "clients_not_closed",
            )


class AccessControl:
    """Answers ZeroMQ's question (ZAP) whether a client may come in, in a thread of its own.

    `start` it before the sockets of its context are bound, and `stop` it after they are closed.
    A socket's purpose in `tactomo.endpoint.bind` is its domain here.
    """

    def __init__(
        self,
        context: Context,  # the sockets' context; there is one access control in it
        keys: ServerKeys,  # who may come in
        on_event: OnEvent,  # told of those who were refused
        # called by whoever calls `check` when somebody was taken off the list
        on_revoked: Callable[[], None],
    ) -> None:
        self._clients = keys.clients
        self._on_event = on_event
        self._on_revoked = on_revoked
        self._checked_s = 0.0  # of the one thread that calls `check`
        self._refused = 0  # the thread's own
        self._lock = threading.Lock()  # held for the reading of some small files; of what follows
        self._signature: Signature | None = None
        self._allowed: dict[str, frozenset[bytes]] = {STREAM: frozenset(), CONTROL: frozenset()}
        self._is_revoked = False  # whether a key was taken away from either socket, and not told
        self._authenticator = _Authenticator(context)
        for domain in (STREAM, CONTROL):
            self._authenticator.configure_curve_callback(domain, self)

    def start(self) -> None:
        """Start the thread."""
        self._authenticator.start()

    def stop(self) -> None:
        """End the thread."""
        if not self.is_alive:  # it would be waited for
            self._authenticator.forget_thread()
        self._authenticator.stop()

    @property
    def is_alive(self) -> bool:
        """Whether the thread runs."""
        return self._authenticator.is_alive()

    def check(self) -> None:
        """Look for changes of the list, at most once a second; to be called by one thread."""
        if time.monotonic() - self._checked_s < CHECK_S:
            return
        self._checked_s = time.monotonic()
        self._reload()
        if self._is_revoked:
            self._is_revoked = False
            self._on_revoked()

    def callback(self, domain: str, key: bytes) -> bool:
        """Return whether a client may come in; called by the thread, with the key in Z85."""
        self._reload()
        permitted = key in self._allowed.get(domain, ())
        if not permitted:
            self._tell_refused(domain, key.decode("ascii"))
        return permitted

    def _tell_refused(self, domain: str, key: str) -> None:
        self._refused += 1
        self._on_event(
            "client_refused",
            f"{self._authenticator.address} may not use the {domain}: its public key {key} is "
            f"not allowed ({self._refused} refused so far)",
            "if it is yours, copy its public key (CLIENT.key) to this computer, and "
            + how_to_allow(self._clients, may_command=domain == CONTROL),
        )

    def _reload(self) -> None:
        """Read the folder again if it has changed; one that cannot be looked at stays as it was."""
        with self._lock, contextlib.suppress(OSError):  # such as too many open files
            files = _files(self._clients)
            signature = _signature([*files[STREAM], *files[CONTROL]])
            if signature != self._signature:
                self._signature = signature
                before = self._allowed
                keys = {domain: self._keys(paths) for domain, paths in files.items()}
                if not self._is_closed():  # nobody new comes in
                    keys = {domain: found & before[domain] for domain, found in keys.items()}
                self._allowed = {STREAM: keys[STREAM] | keys[CONTROL], CONTROL: keys[CONTROL]}
                self._is_revoked |= any(before[domain] - self._allowed[domain] for domain in before)

    def _is_closed(self) -> bool:
        try:
            check_closed(self._clients)
        except KeysError as error:
            self._on_event("client_key_unusable", error.cause, error.next_step)
            return False
        return True

    def _keys(self, paths: list[Path]) -> frozenset[bytes]:
        keys = set()
        for path in paths:
            try:
                keys.add(read_public(path))
            except KeysError as error:  # one bad file locks nobody else out
                self._on_event("client_key_unusable", error.cause, error.next_step)
        return frozenset(keys)


def _files(folder: Path) -> dict[str, list[Path]]:
    pattern = f"*{PUBLIC_SUFFIX}"
    folders = {STREAM: folder, CONTROL: folder / MAY_COMMAND}
    return {domain: sorted(where.glob(pattern))[:MAX_CLIENTS] for domain, where in folders.items()}


def _signature(paths: list[Path]) -> Signature:
    found = []
    for path in paths:
        try:
            info = path.stat()
        except OSError:  # removed in this very moment
            continue
        found.append((str(path), info.st_mtime_ns, info.st_size))
    return tuple(found)


class _Authenticator(ThreadAuthenticator):
    """Remembers whom it is asked about; everything is asked and answered one by one."""

    address = ""

    async def handle_zap_message(self, msg: list[bytes]) -> None:
        self.address = msg[3].decode("ascii", "replace") if len(msg) > 3 else ""
        await super().handle_zap_message(msg)

    def forget_thread(self) -> None:
        """Let `stop` close everything without a word to a thread that has died."""
        if self.pipe:
            self.pipe.close(0)
            self.pipe = None  # type: ignore[assignment]

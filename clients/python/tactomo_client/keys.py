"""Keys for a daemon beyond this computer: who this client is, and which server it expects.

CURVE, as ZeroMQ has it: both sides hold a pair of keys, the client knows the server's public key
and the server has a list of the clients'. STREAM.md, "Beyond the machine", has all of it; `tactomo
keys` makes the files. An ``ipc://`` address needs no keys, the file's mode guards it.
"""

from __future__ import annotations

import contextlib
import os
import re
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Self

import zmq

from tactomo_client.errors import KeysError, open_regular

PUBLIC_SUFFIX: Final = ".key"
SECRET_SUFFIX: Final = ".key_secret"

_KEY = re.compile(rb"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")
_MAX_FILE_BYTES: Final = 16 * 1024
_WATCHED: Final = (
    zmq.Event.CONNECTED
    | zmq.Event.DISCONNECTED
    | zmq.Event.HANDSHAKE_SUCCEEDED
    | zmq.Event.HANDSHAKE_FAILED_AUTH
    | zmq.Event.HANDSHAKE_FAILED_PROTOCOL
    | zmq.Event.HANDSHAKE_FAILED_NO_DETAIL
)


@dataclass(frozen=True)
class Keys:
    """A client's pair of keys and its server's public key, each 40 characters of Z85.

    The names are those of their files, for messages.
    """

    public: bytes
    secret: bytes = field(repr=False)
    server: bytes
    name: str = "CLIENT"
    server_name: str = "SERVER"

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """Read the keys in a folder: one ``NAME.key_secret`` of your own and the server's ``.key``.

        Your own ``NAME.key`` may lie there, too.

        Raises:
            KeysError: one of them is missing, there are several, a file holds no key, or others
                may read the secret one.
        """
        where = Path(folder).expanduser()
        mine = _only(where, sorted(where.glob(f"*{SECRET_SUFFIX}")), "secret key of your own")
        public, secret = read_secret(mine)
        theirs = [p for p in sorted(where.glob(f"*{PUBLIC_SUFFIX}")) if p.stem != mine.stem]
        server = _only(where, theirs, "server's public key")
        return cls(public, secret, read_public(server), mine.stem, server.stem)


def as_keys(keys: Keys | str | Path | None) -> Keys | None:
    """Return keys that may be given as such, or as the folder that holds them."""
    return Keys.load(keys) if isinstance(keys, str | Path) else keys


def read_public(path: Path) -> bytes:
    """Return the public key in a file; raise KeysError where there is none."""
    return _read(path)[0]


def read_secret(path: Path) -> tuple[bytes, bytes]:
    """Return the public and the secret key in a file that nobody but its owner may read.

    Raises:
        KeysError: it cannot be read, holds no secret key, or others may read it.
    """
    public, secret = _read(path)
    if secret is None:
        raise KeysError(
            f"{path} holds no secret key",
            f"give the file that ends in {SECRET_SUFFIX}, or make keys with `tactomo keys make`",
        )
    mode = path.stat().st_mode & 0o777
    if mode & 0o077 and not _is_credential(path):
        raise KeysError(
            f"users other than the owner may read {path} (mode {mode:04o})",
            f"if nobody has copied the key: chmod 600 {path}; otherwise make new keys",
        )
    return public, secret


def _is_credential(path: Path) -> bool:
    """Whether systemd holds the file for this service (LoadCredential=), guarded by its means."""
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    return folder is not None and path.resolve().is_relative_to(Path(folder).resolve())


def _only(folder: Path, paths: list[Path], what: str) -> Path:
    if len(paths) == 1:
        return paths[0]
    found = f"{len(paths)}: {', '.join(path.name for path in paths)}" if paths else "none"
    raise KeysError(
        f"{folder} should hold one {what}, and holds {found}",
        f"keep a folder for each server, with your own NAME{SECRET_SUFFIX} and the server's "
        f"NAME{PUBLIC_SUFFIX}",
    )


def _read(path: Path) -> tuple[bytes, bytes | None]:
    from zmq.auth import load_certificate

    try:
        with open_regular(path) as file:
            if len(file.read(_MAX_FILE_BYTES + 1)) > _MAX_FILE_BYTES:
                raise ValueError("it is too large")
        public, secret = load_certificate(path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise KeysError(
            f"cannot read a key from {path}: {reason}", "make keys with `tactomo keys make NAME`"
        ) from error
    if not all(_KEY.fullmatch(key) for key in (public, secret) if key is not None):
        raise KeysError(
            f"{path} holds something that is no key", "a key has 40 characters; copy it once more"
        )
    return public, secret


def secure(socket: zmq.Socket[Any], address: str, keys: Keys | None) -> None:
    """Have a client's socket use these keys, unless the address is one of this computer's files."""
    if keys is not None and not address.startswith("ipc://"):
        socket.setsockopt(zmq.CURVE_PUBLICKEY, keys.public)
        socket.setsockopt(zmq.CURVE_SECRETKEY, keys.secret)
        socket.setsockopt(zmq.CURVE_SERVERKEY, keys.server)


class Handshakes:
    """Watches what becomes of a socket's handshakes, to tell a closed door from nobody at home.

    Belongs to the socket's thread, and is to be closed before the socket. The attributes are as of
    the last call of `refusal`.
    """

    def __init__(self, socket: zmq.Socket[bytes]) -> None:
        self._socket = socket
        self._monitor = socket.get_monitor_socket(_WATCHED)
        self._failures: list[int] = []  # since the last success
        self.have_succeeded = False  # whether a server has ever taken this client in
        self.is_connected = False  # whether something listens at the other end, busy or not

    def refusal(self, address: str, keys: Keys | None) -> KeysError | None:
        """Return why the server lets nobody in by these keys; None as long as it may do so."""
        while self._monitor.poll(0):
            # As `zmq.utils.monitor` reads it, which imports asyncio.
            (event,) = struct.unpack_from("=H", self._monitor.recv_multipart()[0])
            if event in (zmq.Event.CONNECTED, zmq.Event.DISCONNECTED):
                self.is_connected = event == zmq.Event.CONNECTED
                continue
            self.have_succeeded |= event == zmq.Event.HANDSHAKE_SUCCEEDED
            self._failures = (
                [] if event == zmq.Event.HANDSHAKE_SUCCEEDED else [*self._failures[-1:], event]
            )
        # One connection may have been cut in the middle of a handshake: the server was stopped.
        if not self._failures or self._failures == [zmq.Event.HANDSHAKE_FAILED_NO_DETAIL]:
            return None
        return _refusal(self._failures[-1], address, keys)

    def close(self) -> None:
        """Stop watching."""
        # In this order: without a listener ZeroMQ's own thread would wait to be heard, for ever.
        with contextlib.suppress(zmq.ZMQError):  # the socket is closed already
            self._socket.disable_monitor()
        self._monitor.close(0)


def _refusal(event: int, address: str, keys: Keys | None) -> KeysError:
    if event == zmq.Event.HANDSHAKE_FAILED_AUTH and keys is not None:
        return KeysError(
            f"{address} does not let this client in: its key {keys.public.decode()} is not allowed",
            f"copy {keys.name}{PUBLIC_SUFFIX} to the server's computer, and run there `tactomo "
            f"keys allow {keys.name}{PUBLIC_SUFFIX} --for {keys.server_name}`; commands need "
            "`--may-command`, keys in another folder `--keys FOLDER`",
            "key_refused",
        )
    if keys is None:
        return KeysError(
            f"{address} hangs up on a client without keys",
            "give the folder that holds them: --keys, TACTOMO_KEYS, or keys= in Python",
            "keys_needed",
        )
    return KeysError(
        f"{address} is not the server whose public key is {keys.server.decode()}, or uses no keys",
        "copy the server's public key (NAME.key) anew, or connect without keys",
        "wrong_server",
    )

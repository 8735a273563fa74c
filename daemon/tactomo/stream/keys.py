"""The files behind `tactomo keys`: pairs of keys, and the folders of clients that may come in.

In a folder of keys lie ``NAME.key_secret`` and ``NAME.key`` of each pair made there, and for a
server ``NAME.clients`` with the public keys that `tactomo.stream.access_control` reads. The files
are CURVE certificates as pyzmq and czmq write them. A file is there whole or not at all, and
nothing but `make_pair` ever sees a secret key.
"""

from __future__ import annotations

import os
import shlex
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import zmq
from platformdirs import user_config_path
from tactomo_client.errors import KeysError
from tactomo_client.keys import PUBLIC_SUFFIX, SECRET_SUFFIX, read_public
from tactomo_client.messages import check_sensor_name

from tactomo.errors import os_errors_as

CLIENTS_SUFFIX: Final = ".clients"
MAY_COMMAND: Final = "may_command"
SYSTEM_FOLDER: Final = Path("/etc/tactomo/keys")
OWN_FOLDER: Final = "name a folder of yours with --keys, or run this with sudo"


@dataclass(frozen=True)
class Client:
    """One entry of a server's list."""

    name: str
    public: str
    may_command: bool


def default_folder() -> Path:
    """Where keys are kept unless told otherwise: the system's folder for root, else the user's."""
    return SYSTEM_FOLDER if os.geteuid() == 0 else user_config_path("tactomo") / "keys"


def secret_path(folder: Path, name: str) -> Path:
    """Return where the secret key of this name lies."""
    return folder / f"{check_sensor_name(name, 'key')}{SECRET_SUFFIX}"


def public_path(folder: Path, name: str) -> Path:
    """Return where the public key of this name lies."""
    return folder / f"{check_sensor_name(name, 'key')}{PUBLIC_SUFFIX}"


def clients_folder(folder: Path, server: str) -> Path:
    """Return where the clients of this server are listed."""
    return folder / f"{check_sensor_name(server, 'key')}{CLIENTS_SUFFIX}"


def how_to_allow(clients: Path, *, may_command: bool = False) -> str:
    """Return the command that lets CLIENT.key in by this list, to be copied as it is."""
    folder = clients.absolute().parent
    if clients.suffix != CLIENTS_SUFFIX:  # not a list that `allow` would find
        place = clients.absolute() / MAY_COMMAND if may_command else clients.absolute()
        return f"`install -D -m 644 -t {shlex.quote(str(place))} CLIENT.key`"
    words = ["tactomo", "keys", "allow", "CLIENT.key", "--for", clients.stem]
    words += ["--may-command"] if may_command else []
    words += ["--keys", str(folder)] if folder != default_folder() else []
    return f"`{shlex.join(words)}`"


def make_pair(folder: Path, name: str, *, is_server: bool = False, force: bool = False) -> None:
    """Make a pair of keys; for a server the folder of its clients, too, empty.

    Raises KeysError where there are keys of this name and `force` is not given, or the folder
    cannot be written to.
    """
    secret_file, public_file = secret_path(folder, name), public_path(folder, name)
    if not force and (secret_file.exists() or public_file.exists()):
        raise KeysError(
            f"there are keys of the name {name!r} in {folder}",
            "choose another name, or --force to replace the keys: clients that know the old keys "
            "can then not connect",
            "keys_exist",
        )
    public, secret = (key.decode("ascii") for key in zmq.curve_keypair())
    with os_errors_as(KeysError, f"cannot write to {folder}", OWN_FOLDER):
        folder.mkdir(mode=0o755, parents=True, exist_ok=True)
        _write(secret_file, _text(public, secret), 0o600)
        _write(public_file, _text(public), 0o644)
        if is_server:
            (clients_folder(folder, name) / MAY_COMMAND).mkdir(parents=True, exist_ok=True)


def allow(
    folder: Path,  # the server's folder of keys
    public: Path,  # the client's ``NAME.key``; NAME is its name on the list
    server: str,  # the server's name
    *,
    may_command: bool = False,  # the client may use the control socket, too
    force: bool = False,  # replace another key of the same name
) -> Client:
    """Put a client's public key on a server's list, or change what it may do.

    Raises KeysError where the file holds no public key, or a secret one; there is no such server;
    another key has this name; or the list cannot be written.
    """
    if public.suffix == SECRET_SUFFIX:
        raise KeysError(
            f"{public} is a secret key, which must not leave its computer",
            f"give {public.with_suffix(PUBLIC_SUFFIX).name}, and make new keys if this one has "
            "travelled",
        )
    key = read_public(public).decode("ascii")
    client = Client(check_sensor_name(public.stem, "key"), key, may_command)
    _check_server(folder, server)
    known = {other.name: other for other in list_clients(folder, server)}.get(client.name)
    if known is not None and known.public != key and not force:
        raise KeysError(
            f"{client.name!r} is on the list with another key",
            "--force replaces it, or give the file another name",
            "keys_exist",
        )
    readers, commanders = _places(folder, server, client.name)
    keep, drop = (commanders, readers) if may_command else (readers, commanders)
    with os_errors_as(KeysError, f"cannot write to {keep.parent}", OWN_FOLDER):
        keep.parent.mkdir(parents=True, exist_ok=True)
        _write(keep, _text(key), 0o644)
        drop.unlink(missing_ok=True)
    return client


def revoke(folder: Path, name: str, server: str) -> None:
    """Take a client off a server's list.

    Raises KeysError where it is not on it, there is no such server, or the list cannot be written.
    """
    _check_server(folder, server)
    places = [path for path in _places(folder, server, name) if path.exists()]
    if not places:
        known = ", ".join(client.name for client in list_clients(folder, server)) or "nobody"
        raise KeysError(f"{name!r} is not on the list of {server!r}", f"on it: {known}")
    with os_errors_as(KeysError, f"cannot write to {places[0].parent}", OWN_FOLDER):
        for path in places:
            path.unlink()


def list_clients(folder: Path, server: str) -> list[Client]:
    """Return a server's list, by name; a file without a key is left out."""
    listed = clients_folder(folder, server)
    return [*_clients(listed, may_command=False), *_clients(listed / MAY_COMMAND, may_command=True)]


def list_pairs(folder: Path) -> list[str]:
    """Return the names of the pairs made in a folder."""
    return sorted(path.stem for path in folder.glob(f"*{SECRET_SUFFIX}"))


def list_servers(folder: Path) -> list[str]:
    """Return the names of the servers that have a list of clients in a folder."""
    return sorted(path.stem for path in folder.glob(f"*{CLIENTS_SUFFIX}") if path.is_dir())


def _check_server(folder: Path, server: str) -> None:
    """Refuse to begin a list that no daemon reads."""
    if not clients_folder(folder, server).is_dir():
        known = ", ".join(list_servers(folder)) or "none"
        raise KeysError(
            f"no server key {server!r} in {folder}; there are: {known}",
            "run this on the server's computer, with its folder of keys (--keys) and the name that "
            "was given to `tactomo keys make NAME --server`",
            "no_such_server",
        )


def _clients(folder: Path, may_command: bool) -> list[Client]:
    found = []
    for path in sorted(folder.glob(f"*{PUBLIC_SUFFIX}")):
        try:
            found.append(Client(path.stem, read_public(path).decode("ascii"), may_command))
        except KeysError:  # the daemon warns of it
            continue
    return found


def _places(folder: Path, server: str, name: str) -> tuple[Path, Path]:
    listed = clients_folder(folder, server)
    return public_path(listed, name), public_path(listed / MAY_COMMAND, name)


def _text(public: str, secret: str | None = None) -> str:
    lines = ["metadata", "curve", f'    public-key = "{public}"']
    if secret is not None:
        lines = ["# Secret: for its owner's eyes only.", *lines, f'    secret-key = "{secret}"']
    return "\n".join(lines) + "\n"


def _write(path: Path, text: str, mode: int) -> None:
    """Write a file whole; it has its mode from the first moment on."""
    descriptor, part = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-")  # mode 0600
    try:
        with os.fdopen(descriptor, "w", encoding="ascii") as file:
            os.fchmod(file.fileno(), mode)
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        Path(part).replace(path)
    except BaseException:
        Path(part).unlink(missing_ok=True)
        raise

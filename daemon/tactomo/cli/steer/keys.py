"""`tactomo keys`: who may connect from other computers."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Annotated, TypeAlias

import typer
from tactomo_client.keys import read_public

from tactomo.cli.options import KEYS_VARIABLE, examples, typer_app
from tactomo.cli.output import say
from tactomo.stream.keys import (
    Client,
    clients_folder,
    default_folder,
    how_to_allow,
    list_clients,
    list_pairs,
    list_servers,
    make_pair,
    public_path,
    secret_path,
)
from tactomo.stream.keys import allow as put_on_list
from tactomo.stream.keys import revoke as take_off_list

app = typer_app(
    help=(
        "Make and manage the keys that let clients on other computers connect (CURVE).\n\n"
        "Each side makes a pair with `make`. The server's *public* key is copied to its clients, "
        "and each client's *public* key is put on the server's list with `allow`. Secret keys "
        "never leave their computer.\n\n"
        "A client's folder of keys holds one server's public key: keep a folder for each server."
    ),
    name="keys",
    no_args_is_help=True,
    epilog=examples(
        "tactomo keys make left_forearm --server     (on the robot)",
        "tactomo keys make desk                      (on your desk)",
        "tactomo keys allow desk.key --for left_forearm --may-command   (on the robot)",
    ),
)
Folder: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--keys",
        envvar=KEYS_VARIABLE,
        help="The folder of keys. [/etc/tactomo/keys for root, else ~/.config/tactomo/keys]",
        show_default=False,
    ),
]
ForServer: TypeAlias = Annotated[
    str, typer.Option("--for", help="The server: the name given to `make --server`.")
]
Force: TypeAlias = Annotated[bool, typer.Option("--force", help="Replace existing files.")]


@app.command(epilog=examples("tactomo keys make left_forearm --server", "tactomo keys make desk"))
def make(
    name: Annotated[
        str, typer.Argument(help="Name of the key pair, such as the sensor or the user.")
    ],
    server: Annotated[
        bool, typer.Option("--server", help="For a daemon: with a list of clients.")
    ] = False,
    folder: Folder = None,
    force: Force = False,
) -> None:
    """Make a pair of keys, and print the next steps."""
    where = (folder or default_folder()).absolute()
    make_pair(where, name, is_server=server, force=force)
    secret, public = secret_path(where, name), public_path(where, name)
    say(f"{secret}   stays on this computer, mode 0600")
    say(f"{public}   is public: copy it\n")
    if not server:
        say(f"1. Copy {public.name} to the server's computer, and there run:")
        say(f"     tactomo keys allow {public.name} --for SERVER      (to read its stream)")
        say("   with --may-command where it may tare and record, too. SERVER is the name given")
        say("   to `tactomo keys make SERVER --server` there.")
        say(f"2. Copy the server's SERVER.key into {where}, which is for")
        say("   this one server: keep a folder for each. Then here, for example:")
        say(f"     tactomo watch --address tcp://ROBOT:5560 --keys {shlex.quote(str(where))}")
        return
    say("1. Put into the daemon's configuration, and start it again:")
    say(f'     [curve]\n     secret = "{secret}"')
    say(f'     clients = "{clients_folder(where, name)}"')
    if os.geteuid() == 0:
        say(f"   The daemon's user must own the secret key: chown USER {secret}")
    say(f"2. Copy {public.name} into each client's folder of keys, a folder for each server.")
    say(f"3. Let each client in: {how_to_allow(clients_folder(where, name))}")


@app.command(
    epilog=examples(
        "tactomo keys allow ros.key --for left_forearm",
        "tactomo keys allow desk.key --for left_forearm --may-command",
    )
)
def allow(
    public: Annotated[Path, typer.Argument(help="The client's public key, NAME.key.")],
    server: ForServer,
    may_command: Annotated[
        bool, typer.Option("--may-command", help="The client may use the control socket, too.")
    ] = False,
    folder: Folder = None,
    force: Force = False,
) -> None:
    """Allow a client to read the stream, or also to send commands.

    A running daemon applies the change at once.
    """
    where = folder or default_folder()
    client = put_on_list(where, public, server, may_command=may_command, force=force)
    say(f"{client.name} ({client.public}) {_rights(client)} of {server}, in {where}")


@app.command(epilog=examples("tactomo keys revoke desk --for left_forearm"))
def revoke(
    name: Annotated[str, typer.Argument(help="The client's name on the list.")],
    server: ForServer,
    folder: Folder = None,
) -> None:
    """Remove a client from the list; a running daemon disconnects the client within two seconds.

    All other clients of the daemon reconnect by themselves at that moment.
    """
    where = folder or default_folder()
    take_off_list(where, name, server)
    say(f"{name} is off the list of {server}, in {where}")


@app.command("list", epilog=examples("tactomo keys list"))
def list_(folder: Folder = None) -> None:
    """List the keys made here, and for each server the allowed clients."""
    where = folder or default_folder()
    pairs, servers = list_pairs(where), list_servers(where)
    if not pairs and not servers:
        say(f"there are no keys in {where}; make some with `tactomo keys make NAME`")
    for name in pairs:
        path = public_path(where, name)
        public = read_public(path).decode("ascii") if path.exists() else "public key is missing"
        say(f"{name}   {public}")
    for name in servers:
        say(f"\nclients of {name}:")
        for client in list_clients(where, name):
            say(f"  {client.name}   {client.public}   {_rights(client)}")


def _rights(client: Client) -> str:
    return "may read the stream and command" if client.may_command else "may read the stream"

"""`tactomo proxy`: the streams of several daemons at one address."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from tactomo.cli.options import DEFAULT_PROXY_STREAM, KeysFolder, examples, typer_app

LogLevel = Literal["debug", "info", "warning", "error"]
LogFormat = Literal["auto", "text", "json", "journal"]

app = typer_app()


@app.command(
    epilog=examples(
        "tactomo proxy --from ipc:///run/tactomo/left.stream --from ipc:///run/tactomo/right.stream",
        "tactomo proxy --from ... --bind tcp://0.0.0.0:5570 --secret robot.key_secret",
    ),
)
def proxy(
    sources: Annotated[
        list[str], typer.Option("--from", help="A daemon's stream; once for each daemon.")
    ],
    bind: Annotated[
        str, typer.Option(help="Where all of them are available.")
    ] = DEFAULT_PROXY_STREAM,
    secret: Annotated[
        Path | None,
        typer.Option(help="Secret key of this server, for an address beyond this computer."),
    ] = None,
    clients: Annotated[
        Path | None,
        typer.Option(help="Folder of those who may connect. [NAME.clients beside the secret key]"),
    ] = None,
    keys: KeysFolder = None,
    log_level: Annotated[LogLevel, typer.Option(help="The least severe that is logged.")] = "info",
    log_format: Annotated[
        LogFormat,
        typer.Option(
            help="text, json, journal; auto: text on a terminal, journal for journald, else json."
        ),
    ] = "auto",
) -> None:
    """Pass on the streams of several daemons at one address, until stopped.

    Each skin has a daemon of its own; this gives them one address, and one door to the outside. The
    daemons' control sockets stay where they are.

    A folder of keys holds one server's public key, and --keys is used for all --from: daemons that
    want keys of this proxy share one server key, or have a proxy each.
    """
    if bind in sources:
        raise typer.BadParameter(
            f"{bind} is a --from, too; give another address of this computer",
            param_hint="'--bind'",
        )
    from tactomo_client.keys import as_keys

    from tactomo.log import configure_logging
    from tactomo.stream.access_control import load_server_keys
    from tactomo.stream.keys import CLIENTS_SUFFIX
    from tactomo.stream.proxy import Proxy, serve

    configure_logging(log_level, log_format)
    served = None
    if secret is not None:
        served = load_server_keys(secret, clients or secret.with_suffix(CLIENTS_SUFFIX))
    serve(Proxy(sources, _endpoint(bind), served, as_keys(keys)))


def _endpoint(text: str) -> str:
    from tactomo.endpoint import check_endpoint

    try:
        return check_endpoint(text)
    except ValueError as error:
        raise typer.BadParameter(f"--bind {text}: {error}") from error

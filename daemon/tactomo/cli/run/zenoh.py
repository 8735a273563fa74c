"""`tactomo zenoh`: daemons' streams into Zenoh, and Zenoh's into one stream."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Annotated, Literal

import typer

from tactomo.cli.options import KeysFolder, examples, typer_app
from tactomo.errors import needs

LogLevel = Literal["debug", "info", "warning", "error"]
LogFormat = Literal["auto", "text", "json", "journal"]

app = typer_app()


@app.command(
    epilog=examples(
        "tactomo zenoh --from ipc:///run/tactomo/left/stream --robot arm",
        "tactomo zenoh --from ... --robot arm --config /etc/tactomo/zenoh.json5",
        "tactomo zenoh --bind tcp://127.0.0.1:5570 --robot arm --config desk.json5",
    )
)
def zenoh(
    sources: Annotated[
        list[str] | None,
        typer.Option("--from", help="A daemon's stream to publish; once for each daemon."),
    ] = None,
    bind: Annotated[
        str | None,
        typer.Option(help="Address for ZeroMQ clients on this computer."),
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option(
            help="Name in tactomo/ROBOT/SENSOR/KIND. [--from: this host's; --bind: any robot's]"
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            help="Zenoh's configuration (JSON5): addresses, TLS, access control. "
            "[tcp/127.0.0.1:7447: --from listens there, --bind connects to it]"
        ),
    ] = None,
    keys: KeysFolder = None,
    log_level: Annotated[
        LogLevel, typer.Option(help="Lowest severity of logged messages.")
    ] = "info",
    log_format: Annotated[
        LogFormat,
        typer.Option(
            help="text, json, journal; auto: text on a terminal, journal for journald, else json."
        ),
    ] = "auto",
) -> None:
    """Carry streams beyond this computer by Eclipse Zenoh, until stopped.

    On a robot, `--from` publishes the streams of the daemons. Elsewhere, `--bind` serves these
    streams to ZeroMQ clients at one address. The daemons' control sockets are not carried. A skin
    on which nothing changes sends only a heartbeat every 0.3 s.

    Needs eclipse-zenoh: `pip install 'tactomo[zenoh]'`.
    """
    if bool(sources) == bool(bind):
        raise typer.BadParameter("give either --from or --bind")
    with needs("Zenoh", "pip install 'tactomo[zenoh]'"):
        from tactomo.stream.zenoh_bridge import ZenohBridge
        from tactomo.stream.zenoh_proxy import ZenohProxy
    from tactomo_client.keys import as_keys

    from tactomo.log import configure_logging
    from tactomo.stream.relay import serve

    configure_logging(log_level, log_format)
    if bind:
        serve(ZenohProxy(_checked(robot) if robot else "*", _endpoint(bind), config))
    else:
        name = _checked(robot or socket.gethostname())
        serve(ZenohBridge(sources or [], name, config, as_keys(keys)))


def _checked(robot: str) -> str:
    from tactomo_client.messages import check_sensor_name

    try:
        return check_sensor_name(robot)
    except ValueError as error:
        raise typer.BadParameter(
            f"{error}: give a name of letters, digits, '_', '.' and '-'", param_hint="'--robot'"
        ) from error


def _endpoint(text: str) -> str:
    from tactomo.endpoint import check_endpoint

    try:
        return check_endpoint(text)
    except ValueError as error:
        raise typer.BadParameter(f"--bind {text}: {error}") from error

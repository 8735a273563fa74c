"""`tactomo viewer`, `foxglove` and `zenoh`: the streams of running daemons for others."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tactomo.cli import options
from tactomo.cli.children import print_ready, stop_asked
from tactomo.cli.output import say
from tactomo.cli.sensors import find_sensor, twin_of
from tactomo.errors import TactomoError, needs, os_errors_as
from tactomo.running import Running

if TYPE_CHECKING:
    from tactomo_foxglove import Bridge

DEFAULT_PORT = 8765

app = options.typer_app()


@app.command(
    epilog=options.examples(
        "tactomo foxglove",
        "tactomo foxglove left_forearm --layout left_forearm.json",
        "ssh -L 8765:127.0.0.1:8765 robot tactomo foxglove",
    )
)
def foxglove(
    sensors: Annotated[
        list[str] | None,
        typer.Argument(metavar="[SENSOR]...", help="Names in the stream. [the only one that runs]"),
    ] = None,
    address: options.Address = None,
    host: Annotated[
        str, typer.Option(help="Address to listen on; beyond loopback, other computers can look.")
    ] = "127.0.0.1",
    foxglove_port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port to listen on; 0 takes a free one.")
    ] = DEFAULT_PORT,
    layout: Annotated[
        Path | None,
        typer.Option(help="Write the layout of the (first) sensor here, to import in Foxglove."),
    ] = None,
    allow_origin: Annotated[
        list[str] | None,
        typer.Option(
            metavar="URL",
            help="Origin of another allowed web page, such as http://localhost:8080; repeat.",
        ),
    ] = None,
    keys: options.KeysFolder = None,
    announce: options.Announce = False,
) -> None:
    """Serve maps, contacts, numbers and events to Foxglove until stopped.

    In Foxglove (the desktop app, or a browser on this computer): *Open connection*, *Foxglove
    WebSocket*, ws://127.0.0.1:8765; then *Import from file* under *Layouts*, with the file of
    `--layout`. Foxglove only shows the sensor and sends no commands. Only Foxglove's own web page
    may connect, and the origins of `--allow-origin`.

    Needs foxglove-sdk: `pip install 'tactomo[foxglove]'`. `tactomo export RECORDING OUT.mcap`
    converts a recording for Foxglove.
    """
    with needs("Foxglove", "pip install 'tactomo[foxglove]'"):
        import foxglove as _  # noqa: F401
    from tactomo_client.keys import as_keys
    from tactomo_foxglove import Bridge

    if address is None or not sensors:
        found = find_sensor(sensors[0] if sensors else None, address, keys)
        sensors, address = sensors or [found.sensor], found.stream
    if layout is not None:
        write_layout(layout, sensors[0])
    stop = stop_asked()
    with Bridge(sensors, address, host, foxglove_port, as_keys(keys), allow_origin or ()) as bridge:
        _print_addresses(bridge, layout, announce)
        bridge.run(stop)


def _print_addresses(bridge: Bridge, layout: Path | None, announce: bool) -> None:
    say(f"foxglove: {bridge.url}")
    say(f"or open   {bridge.app_url}")
    if layout is not None:
        say(f"layout:   {layout} (import it under Layouts)")
    if announce:
        print_ready({"url": bridge.url})


def write_layout(path: Path, sensor: str) -> None:
    """Write the layout that shows a sensor; raise TactomoError where it cannot be written."""
    from tactomo_foxglove import layout_for

    with os_errors_as(TactomoError, f"cannot write {path}", "name a file that you may write"):
        path.write_text(layout_for(sensor), "utf-8")


@app.command(
    epilog=options.examples(
        "tactomo viewer --sensor left_forearm",
        "tactomo viewer --address tcp://robot:5560 --keys ~/keys/robot",
        "ssh -L 8750:127.0.0.1:8750 robot tactomo viewer",
    )
)
def viewer(
    sensor: options.Sensor = None,
    address: options.Address = None,
    twin_control: Annotated[
        str | None,
        typer.Option(help="The twin's control socket, to press the skin by mouse. [found]"),
    ] = None,
    control: Annotated[str | None, typer.Option(hidden=True)] = None,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    viewer_port: options.ViewerPort = None,
    keys: options.KeysFolder = None,
    press_itself: Annotated[bool, typer.Option("--press-itself", hidden=True)] = False,
) -> None:
    """Serve a web page that shows the maps and contacts of a running daemon."""
    from tactomo_client.keys import as_keys
    from tactomo_viewer import Viewer

    from tactomo.ending import that_end

    if control and sensor and address:  # of a daemon that is on its way
        found = Running("daemon", control, sensor, address)
    else:
        found = find_sensor(sensor, address, keys)
        twin_control = twin_control or twin_of(found)
    addresses = found.sensor, found.stream, found.control
    viewer = Viewer(*addresses, twin_control, host, as_keys(keys), press_itself)
    viewer.serve(viewer_port, that_end())


@app.command(
    epilog=options.examples(
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
    keys: options.KeysFolder = None,
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
    from tactomo.stream.zenoh_bridge import serve

    configure_logging()
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

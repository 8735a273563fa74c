"""`tactomo foxglove`: a running sensor in Foxglove's 3D, Plot and Log panels."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tactomo.cli import options
from tactomo.cli.children import print_ready, stop_asked
from tactomo.cli.output import say
from tactomo.cli.sensors import find_sensor
from tactomo.errors import TactomoError, needs, os_errors_as

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
    with Bridge(
        sensors,
        address,
        host,
        foxglove_port,
        as_keys(keys),
        allow_origin or (),
    ) as bridge:
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

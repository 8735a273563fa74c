"""`tactomo viewer`: a web page that shows a running daemon."""

from __future__ import annotations

from typing import Annotated

import typer

from tactomo.cli import options
from tactomo.cli.sensors import find_sensor, twin_of
from tactomo.running import Running

app = options.typer_app()


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

"""`tactomo viewer`: a web page that shows a running daemon."""

from __future__ import annotations

from typing import Annotated

import typer

from tactomo.cli import options

app = options.typer_app()


@app.command(
    epilog=options.examples(
        "tactomo viewer --sensor left_forearm",
        "tactomo viewer --twin-control tcp://127.0.0.1:5562",
        "ssh -L 8750:127.0.0.1:8750 robot tactomo viewer",
    )
)
def viewer(
    sensor: options.SensorName = options.DEFAULT_NAME,
    stream: options.StreamAddress = options.DEFAULT_STREAM,
    control: options.ControlAddress = options.DEFAULT_CONTROL,
    twin_control: Annotated[
        str | None, typer.Option(help="The twin's control socket, to press the skin by mouse.")
    ] = None,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    viewer_port: options.ViewerPort = options.DEFAULT_VIEWER_PORT,
    keys: options.KeysFolder = None,
) -> None:
    """Serve a web page that shows the maps and contacts of a running daemon."""
    from tactomo_client.keys import as_keys
    from tactomo_viewer import Viewer

    Viewer(sensor, stream, control, twin_control, host, as_keys(keys)).serve(viewer_port)

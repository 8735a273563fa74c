"""`tactomo twin`: a simulated skin behind simulated firmware."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tactomo.cli import options
from tactomo.cli.output import say

app = options.typer_app()


@app.command(
    epilog=options.examples(
        "tactomo twin --link /tmp/skin",
        "tactomo twin --ports 1 --scene sliding_finger",
        "tactomo poke press x_mm=10 y_mm=-20",
    )
)
def twin(
    description: options.Description = options.DEFAULT_DESCRIPTION,
    ports: options.TwinPorts = None,
    rate: options.Rate = 20.0,
    protocol: options.Protocol = "tactomo",
    scene: Annotated[
        Path | None,
        typer.Option(help="A scripted scene, shipped or TOML; starts with the first scan."),
    ] = None,
    link: Annotated[
        Path | None,
        typer.Option(help="Folder for links with stable names: magnitude and structure, or skin."),
    ] = None,
    noise_uv: Annotated[
        float | None,
        typer.Option(min=0.0, max=1e9, help="Converter noise, µV rms. [60 dB below the signal]"),
    ] = None,
    unevenness: Annotated[
        float,
        typer.Option(min=0.0, max=0.5, help="Unevenness of the sheet's conductivity; 0.05 is 5 %."),
    ] = 0.03,
    seed: Annotated[int, typer.Option(min=0, help="Equal seeds give equal noise and drift.")] = 0,
    twin_control: Annotated[
        str, typer.Option("--twin-control", help="Address for `tactomo poke`.")
    ] = options.DEFAULT_TWIN_CONTROL,
    announce: options.Announce = False,
) -> None:
    """Simulate a skin behind simulated firmware, on real pseudo-terminals, until stopped.

    The twin speaks the wire protocol of a real device, so a daemon (or your own program) opens the
    twin's ports like /dev/ttyACM0. `tactomo poke` presses and disturbs a running twin: press,
    release, mute a channel, send garbage, unplug and replug.
    """
    from tactomo_models import load_description

    from tactomo.cli.children import interrupt_at_end, print_ready
    from tactomo.running import Running, announced
    from tactomo.twin import Twin, TwinConfig, load_scene

    interrupt_at_end()
    sensor = load_description(description)
    lines = len(sensor.channels) if protocol == "tactomo" else 1
    config = TwinConfig(
        sensor,
        ports=lines if ports is None else ports,
        rate_hz=rate,
        noise_v=None if noise_uv is None else noise_uv * 1e-6,
        unevenness=unevenness,
        seed=seed,
        scene=None if scene is None else load_scene(scene),
        protocol=protocol,
        control=twin_control,
        link_folder=link,
    )
    running = Twin(config)
    running.start()
    paths = tuple(map(str, running.ports))
    try:
        with announced(Running("twin", running.control, ports=paths)):
            for path in paths:
                say(f"port     {path}")
            say(f"control  {running.control}, for `tactomo poke`")
            if announce:
                print_ready({"ports": paths, "control": running.control})
            running.wait()
    except KeyboardInterrupt:
        pass
    finally:
        running.stop()

"""`tactomo demo` and `tactomo twin`: a simulated skin, with daemon and viewer or without."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import sys
import tempfile
import time
import webbrowser
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from tactomo.cli import options
from tactomo.cli.children import ProcessGroup, interrupt_at_end, new_group, print_ready
from tactomo.cli.output import say
from tactomo.endpoint import free_addresses
from tactomo.running import Running, announced, running

TARE_PATIENCE_S = 10.0

app = options.typer_app()


@app.command(
    epilog=options.examples(
        "tactomo demo",
        "tactomo demo --scene two_fingers_merge",
        "tactomo demo --description graded_square",
    )
)
def demo(
    sensor: options.NewName = options.DEFAULT_NAME,
    description: options.Description = options.DEFAULT_DESCRIPTION,
    method: options.GivenMethod = None,
    rate: options.Rate = 20.0,
    scene: Annotated[
        Path | None, typer.Option(help="A scripted scene, shipped or TOML, that presses by itself.")
    ] = None,
    viewer_port: options.ViewerPort = None,
    stream: options.ServeStream = None,
    control: options.ServeControl = None,
    twin_control: Annotated[
        str | None,
        typer.Option(
            "--twin-control",
            help=f"Address for `tactomo poke`. [{options.DEFAULT_TWIN_CONTROL}, or the next free]",
        ),
    ] = None,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Do not open the page, where there is a desktop.")
    ] = False,
    announce: options.Announce = False,
) -> None:
    """Start a skin to press in the browser: simulated sensor, daemon and viewer in one command.

    The first start builds the sensor's models, which takes a few seconds. Ctrl-C stops everything.
    For tcp addresses with port 0, the demo takes free ports and prints them. `tactomo record`
    writes recordings into this folder. The page presses the skin by itself until somebody presses
    it.
    """
    stream, control, twin_control = free_of(
        (stream, options.DEFAULT_STREAM),
        (control, options.DEFAULT_CONTROL),
        (twin_control, options.DEFAULT_TWIN_CONTROL),
    )
    # A page that presses would be in the way of whoever asks for these two.
    presses_itself = scene is None and not announce
    twin_options = [
        *("--description", description, "--rate", str(rate), "--twin-control", twin_control),
        *_optional("--scene", scene),
    ]
    daemon_options = [
        *("--sensor", sensor, "--description", description),
        *("--stream", stream, "--control", control),
        *_optional("--method", method),
        *("--set", f"recording.folder={json.dumps(str(Path.cwd()))}"),
    ]
    with tempfile.TemporaryDirectory(prefix="tactomo-") as folder, new_group() as group:
        # On a first start the daemon's models take as long to build as the twin's: do both at once.
        builder = group.start("models build", "models", "build", "--description", description)
        skin = group.start("twin", "twin", "--link", folder, "--announce", *twin_options)
        asked = {"sensor": sensor, "stream": stream, "control": control, "twin": twin_control}
        page = None
        if not any(address.endswith((":0", ":*")) for address in (stream, control, twin_control)):
            # The page waits for the daemon by itself: it need not wait here.
            page = _open_page(group, asked, viewer_port, not no_browser, presses_itself)
            print(f"starting; the page is {page}", file=sys.stderr)
        simulated = skin.wait_ready()
        builder.wait_done()
        lines = [word for path in simulated["ports"] for word in ("--port", path)]
        daemon = group.start("daemon", "daemon", *daemon_options, *lines)
        addresses = {**_served(daemon.wait_ready()), "twin": simulated["control"]}
        _wait_tared(addresses["control"])
        page = page or _open_page(group, addresses, viewer_port, not no_browser, presses_itself)
        _stay(group, {**addresses, "viewer": page}, announce)


def free_of(*asked: tuple[str | None, str]) -> list[str]:
    """Return addresses that were given, and of the others their defaults or the next free ones."""
    defaults = [default for given, default in asked if given is None]
    free = free_addresses(*defaults)
    if free != defaults:
        say(f"{' and '.join(defaults)} are taken: serving at {' and '.join(free)}", err=True)
    return [free.pop(0) if given is None else given for given, _ in asked]


def _wait_tared(control: str) -> None:
    """Wait until the daemon has its reference: a press before that would become part of it."""
    from tactomo_client import request

    deadline = time.monotonic() + TARE_PATIENCE_S
    while (
        request("status", control, TARE_PATIENCE_S)["state"] != "running"
        and time.monotonic() < deadline
    ):
        time.sleep(0.05)


def show_replay(
    recording: Path,
    speed: str,
    sensor: str,
    stream: str,
    control: str,
    viewer_port: int | None,
    more: list[str],
) -> None:
    """Play a recording through a daemon and show it in the viewer until Ctrl-C."""
    with new_group() as group:
        daemon = group.start(
            *("replay", "replay", str(recording), "--speed", speed, "--sensor", sensor),
            *("--stream", stream, "--control", control, "--stay", *more),
        )
        addresses = _served(daemon.wait_ready())
        page = _open_page(group, addresses, viewer_port, browser=True)
        _stay(group, {**addresses, "viewer": page}, announce=False)


def _served(ready: Mapping[str, Any]) -> dict[str, Any]:
    """Return what matters to others of what a daemon logs when it is ready."""
    return {name: ready[name] for name in ("sensor", "stream", "control", "ports")}


def _open_page(
    group: ProcessGroup,
    addresses: Mapping[str, Any],
    port: int | None,
    browser: bool,
    presses_itself: bool = False,
) -> str:
    """Start the viewer, show its page where there is a desktop, and return the page's URL."""
    viewer = group.start(
        *("viewer", "viewer", "--sensor", addresses["sensor"]),
        *_optional("--viewer-port", port),
        *(["--press-itself"] if presses_itself else []),
        *("--address", addresses["stream"], "--control", addresses["control"]),
        *_optional("--twin-control", addresses.get("twin")),
    )
    page = str(viewer.wait_ready()["url"])
    if browser and _has_desktop():
        webbrowser.open(page)
    return page


def _stay(group: ProcessGroup, addresses: Mapping[str, Any], announce: bool) -> None:
    """Tell the user where everything is, and stay until something ends."""
    if announce:
        print_ready(addresses)
    else:
        _print_addresses(addresses)
    try:
        raise group.wait_for_an_end().failure()
    except KeyboardInterrupt:
        print("stopping", file=sys.stderr)


def _print_addresses(addresses: Mapping[str, Any]) -> None:
    """Say what to do next; lines of commands stand alone, to be copied to a terminal here."""
    name, stream = addresses["sensor"], addresses["stream"]
    folder = _folder_of_programs()
    tactomo = shlex.quote(f"{folder}tactomo")
    at = "" if len(running("daemon")) == 1 else f" --address {stream}"
    at_twin = "" if len(running("twin")) == 1 else f" --address {addresses.get('twin')}"
    is_replay = "twin" not in addresses
    what = "replayed" if is_replay else "running"
    press = "" if is_replay else ", and press the skin there by mouse"
    say(f"{name} is {what}; Ctrl-C stops everything. Open{press}:\n")
    say(f"    {addresses['viewer']}\n\nOr in another terminal:\n")
    if not is_replay:
        say(f"    {tactomo} poke press x_mm=10 y_mm=-20{at_twin}")
    live = () if is_replay else ("tare", "record press.mcap --seconds 10")
    for command in ("watch", "status", *live):
        say(f"    {tactomo} {command}{at}")
    where = "" if stream == options.DEFAULT_STREAM else f', address="{stream}"'
    say(f"\nOr in {f'{folder}python' if folder else 'Python'}:\n")
    say("    from tactomo_client import subscribe\n")
    say(f'    for frame in subscribe("{name}"{where}):\n        print(frame.contacts)\n')


def _folder_of_programs() -> str:
    """Return what a shell in this folder puts before `tactomo`: nothing if it is on the PATH."""
    ours, here = Path(sys.executable).parent, Path.cwd()
    found = shutil.which("tactomo")
    if not (ours / "tactomo").exists() or (found and Path(found).samefile(ours / "tactomo")):
        return ""
    return f"{ours.relative_to(here) if ours.is_relative_to(here) else ours}/"


def _optional(name: str, value: object) -> list[str]:
    return [] if value is None else [name, str(value)]


def _has_desktop() -> bool:
    has_display = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    return sys.stdout.isatty() and (has_display or sys.platform == "darwin")


@app.command(
    epilog=options.examples(
        "tactomo twin --link /tmp/skin",
        "tactomo twin --ports 1 --scene sliding_finger",
        "tactomo poke press x_mm=10 y_mm=-20",
    )
)
def twin(
    description: options.Description = options.DEFAULT_DESCRIPTION,
    ports: Annotated[
        int | None,
        typer.Option(min=1, max=2, help="One line for both channels, or a line for each. [each]"),
    ] = None,
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

    from tactomo.twin import Twin, TwinConfig, load_scene

    interrupt_at_end()
    sensor = load_description(description)
    lines = len(sensor.channels) if protocol == "tactomo" else 1
    config = TwinConfig(
        sensor,
        ports=lines if ports is None else ports,
        rate_hz=rate,
        noise_v=None if noise_uv is None else noise_uv * 1e-6,
        scene=None if scene is None else load_scene(scene),
        protocol=protocol,
        control=twin_control,
        link_folder=link,
    )
    simulated = Twin(config)
    simulated.start()
    paths = tuple(map(str, simulated.ports))
    try:
        with announced(Running("twin", simulated.control, ports=paths)):
            for path in paths:
                say(f"port     {path}")
            say(f"control  {simulated.control}, for `tactomo poke`")
            if announce:
                print_ready({"ports": paths, "control": simulated.control})
            simulated.wait()
    except KeyboardInterrupt:
        pass
    finally:
        simulated.stop()

"""`tactomo daemon`, `proxy`, `twin`, `viewer` and `replay`: the programs that keep running."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tactomo.cli.app import (
    DEFAULT_CONTROL,
    DEFAULT_DESCRIPTION,
    DEFAULT_NAME,
    DEFAULT_PROXY_STREAM,
    DEFAULT_STREAM,
    DEFAULT_TWIN_CONTROL,
    DEFAULT_VIEWER_PORT,
    FILES,
    RUN,
    Announce,
    ControlAddress,
    Description,
    KeysFolder,
    Method,
    Protocol,
    SensorName,
    StreamAddress,
    app,
    examples,
)

if TYPE_CHECKING:
    from tactomo.config import DaemonConfig
    from tactomo.recording import Recording

LogLevel = Literal["debug", "info", "warning", "error"]
LogFormat = Literal["auto", "text", "json", "journal"]


@app.command(
    rich_help_panel=RUN,
    epilog=examples(
        "tactomo daemon --port /dev/ttyACM0",
        "tactomo daemon --sensor left_forearm --port /dev/ttyACM0 --port /dev/ttyACM1",
        "tactomo daemon /etc/tactomo/left_forearm.toml --tier tikhonov",
    ),
)
def daemon(
    config: Annotated[
        Path | None, typer.Argument(help="Configuration (TOML); flags win over it.")
    ] = None,
    sensor: Annotated[
        str | None, typer.Option("--sensor", "-s", help="The sensor's name in the stream. [skin]")
    ] = None,
    description: Annotated[
        str | None,
        typer.Option(
            "--description", "-d", help="A shipped sensor's name or a TOML file. [paper_square]"
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(help="Of pressure, by `tactomo calibrate`. [the sensor's own, if any]"),
    ] = None,
    port: Annotated[
        list[str] | None,
        typer.Option("--port", "-p", help="Serial device or pyserial URL; twice for two boards."),
    ] = None,
    device_id: Annotated[
        list[str] | None,
        typer.Option(help="Accept this device alone, see `tactomo ports --ask`; twice for two."),
    ] = None,
    wait_for_ports: Annotated[
        bool, typer.Option("--wait-for-ports", help="Start even where a port is not there yet.")
    ] = False,
    protocol: Annotated[
        Protocol | None, typer.Option(help="What the device speaks. [tactomo]")
    ] = None,
    baud: Annotated[
        int | None, typer.Option(help="Of a real UART; USB takes any. [the protocol's usual]")
    ] = None,
    stream: Annotated[
        str | None, typer.Option(help=f"Where to publish. [{DEFAULT_STREAM}]")
    ] = None,
    control: Annotated[
        str | None, typer.Option(help=f"Where to take commands. [{DEFAULT_CONTROL}]")
    ] = None,
    tier: Annotated[Method | None, typer.Option(help="How much model a frame gets. [auto]")] = None,
    budget_ms: Annotated[
        float | None, typer.Option(help="Time that one reconstruction may take. [the tier's own]")
    ] = None,
    tare_scans: Annotated[
        int | None, typer.Option(help="Dual scans averaged into the reference. [20]")
    ] = None,
    sync_wait_ms: Annotated[
        float | None, typer.Option(help="How long one channel waits for the other. [30]")
    ] = None,
    lossless: Annotated[
        bool, typer.Option("--lossless", help="Reconstruct every dual scan, however late.")
    ] = False,
    record: Annotated[Path | None, typer.Option(help="Record to this file from the start.")] = None,
    record_maps: Annotated[
        bool, typer.Option("--record-maps", help="Put maps and contacts into recordings, too.")
    ] = False,
    metrics: Annotated[
        str | None,
        typer.Option(help="Address of this computer for Prometheus, such as 127.0.0.1:9460."),
    ] = None,
    exit_at_end: Annotated[
        bool, typer.Option("--exit-at-end", help="Stop when every replayed port has ended.")
    ] = False,
    log_level: Annotated[
        LogLevel | None, typer.Option(help="The least severe that is logged. [info]")
    ] = None,
    log_format: Annotated[
        LogFormat | None,
        typer.Option(help="[auto: text on a terminal, journal for journald, else JSON lines]"),
    ] = None,
) -> None:
    """Read a skin's ports, reconstruct, and publish maps and contacts until stopped.

    At the start the skin must be free for a second: the first scans become the reference that
    changes are measured against. `tactomo tare` takes a new one at any time.
    """
    from tactomo.config import load_config

    settings = load_config(
        config,
        name=sensor,
        description=description,
        calibration=calibration,
        ports=tuple(port) if port else None,
        device_ids=tuple(device_id) if device_id else None,
        wait_for_ports=wait_for_ports or None,
        protocol=protocol,
        baud=baud,
        stream=stream,
        control=control,
        tier=tier,
        budget_ms=budget_ms,
        tare_scans=tare_scans,
        sync_wait_ms=sync_wait_ms,
        lossless=lossless or None,
        record=record,
        record_maps=record_maps or None,
        metrics=metrics,
        exit_at_end=exit_at_end or None,
        log_level=log_level,
        log_format=log_format,
    )
    raise typer.Exit(_run_daemon(settings))


@app.command(
    rich_help_panel=RUN,
    epilog=examples(
        "tactomo twin --link /tmp/skin",
        "tactomo twin --ports 1 --scene deploy/scenes/sliding_finger.toml",
        "tactomo poke press x_mm=10 y_mm=-20",
        "tactomo twin --description tank_disc --play tank.npz",
    ),
)
def twin(
    description: Description = DEFAULT_DESCRIPTION,
    ports: Annotated[
        int | None,
        typer.Option(min=1, max=2, help="One line for both channels, or a line for each. [each]"),
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Dual scans a second. [20, or as in the file that plays]")
    ] = None,
    protocol: Annotated[
        Protocol, typer.Option(help="What it speaks: ours, or as another instrument does.")
    ] = "tactomo",
    play: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.npz", help="Say measured frames, as `tactomo import` reads them, instead."
        ),
    ] = None,
    once: Annotated[
        bool, typer.Option("--once", help="Stop after the last played frame; else again.")
    ] = False,
    scene: Annotated[
        Path | None,
        typer.Option(help="A scripted scene (TOML); starts with the first scan that is received."),
    ] = None,
    link: Annotated[
        Path | None,
        typer.Option(help="Folder for links with stable names: magnitude and structure, or skin."),
    ] = None,
    noise_uv: Annotated[
        float | None,
        typer.Option(min=0.0, help="Converter noise, µV rms. [60 dB below the signal]"),
    ] = None,
    drift: Annotated[
        float, typer.Option(min=0.0, help="Random walk of the gains: relative rms after 1 s.")
    ] = 2e-6,
    creep: Annotated[
        float, typer.Option(help="Relative change of the gains over the first minutes.")
    ] = 2e-5,
    unevenness: Annotated[
        float, typer.Option(min=0.0, max=0.5, help="Of the sheet's conductivity; 0.05 is 5 %.")
    ] = 0.03,
    seed: Annotated[int, typer.Option(min=0, help="Equal seeds give equal noise and drift.")] = 0,
    control: Annotated[
        str, typer.Option("--control", help="Where to take presses and faults.")
    ] = DEFAULT_TWIN_CONTROL,
    announce: Announce = False,
) -> None:
    """Simulate a skin behind simulated firmware, on real pseudo-terminals, until stopped.

    It speaks the same wire protocol as a real device, so a daemon (or your own program) opens its
    ports as it would open /dev/ttyACM0. `tactomo poke` presses and disturbs it while it runs:
    press, release, mute a channel, send garbage, unplug and replug.
    """
    from tactomo_models import load_description

    from tactomo.cli.children import announce as tell
    from tactomo.cli.children import interrupt_on_sigterm
    from tactomo.twin import Drift, Twin, TwinConfig, load_scene

    interrupt_on_sigterm()
    sensor = load_description(description)
    lines = len(sensor.modalities) if protocol == "tactomo" else 1
    config = TwinConfig(
        sensor,
        ports=lines if ports is None else ports,
        rate_hz=rate,
        noise_v=None if noise_uv is None else noise_uv * 1e-6,
        drift=Drift(walk=drift, creep=creep),
        unevenness=unevenness,
        seed=seed,
        scene=None if scene is None else load_scene(scene),
        protocol=protocol,
        play=play,
        play_once=once,
        control=control,
        link_folder=link,
    )
    running = Twin(config)
    running.start()
    try:
        for path in running.ports:
            typer.echo(f"port     {path}")
        typer.echo(f"control  {running.control}")
        if announce:
            tell({"ports": running.ports, "control": running.control})
        running.wait()
    except KeyboardInterrupt:
        pass
    finally:
        running.stop()


@app.command(
    rich_help_panel=RUN,
    epilog=examples(
        "tactomo viewer --sensor left_forearm",
        "tactomo viewer --twin tcp://127.0.0.1:5562",
        "ssh -L 8750:127.0.0.1:8750 robot tactomo viewer",
    ),
)
def viewer(
    sensor: SensorName = DEFAULT_NAME,
    stream: StreamAddress = DEFAULT_STREAM,
    control: ControlAddress = DEFAULT_CONTROL,
    twin: Annotated[
        str | None, typer.Option(help="The twin's control socket, to press the skin by mouse.")
    ] = None,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of the page; 0 takes a free one.")
    ] = DEFAULT_VIEWER_PORT,
    keys: KeysFolder = None,
) -> None:
    """Serve a web page that shows the maps and contacts of a running daemon."""
    from tactomo_client.keys import as_keys
    from tactomo_viewer import serve

    serve(
        sensor, stream=stream, control=control, twin=twin, host=host, port=port, keys=as_keys(keys)
    )


@app.command(
    rich_help_panel=RUN,
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
        str, typer.Option(help="Where all of them are to be had.")
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

    from tactomo.doorkeeper import load_server_keys
    from tactomo.keys import CLIENTS_SUFFIX
    from tactomo.log import configure_logging
    from tactomo.proxy import Proxy, serve

    configure_logging(log_level, log_format)
    served = None
    if secret is not None:
        served = load_server_keys(secret, clients or secret.with_suffix(CLIENTS_SUFFIX))
    serve(Proxy(sources, _endpoint(bind), served, as_keys(keys)))


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        "tactomo replay grasp.mcap --viewer",
        "tactomo replay grasp.mcap --speed 0.25",
        "tactomo replay grasp.mcap --speed max --record frames.mcap",
        "tactomo replay ~/.local/share/tactomo/recordings --speed 10",
    ),
)
def replay(
    recording: Annotated[
        Path, typer.Argument(help="A recording (.mcap), or a folder of those a daemon has cut.")
    ],
    speed: Annotated[
        str, typer.Option(help="Factor of the recorded speed, or max: as fast as reconstructed.")
    ] = "1.0",
    with_viewer: Annotated[
        bool, typer.Option("--viewer", help="Serve the viewer, too, and stay at the end.")
    ] = False,
    sensor: Annotated[
        str | None, typer.Option("--sensor", "-s", help="Name in the stream. [the recorded one]")
    ] = None,
    description: Annotated[
        str | None, typer.Option("--description", "-d", help="[the recorded one]")
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(help="Of pressure, by `tactomo calibrate`. [the recorded one]"),
    ] = None,
    tier: Annotated[Method, typer.Option(help="How much model a frame gets.")] = "auto",
    stream: StreamAddress = DEFAULT_STREAM,
    control: ControlAddress = DEFAULT_CONTROL,
    viewer_port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of the viewer's page.")
    ] = DEFAULT_VIEWER_PORT,
    stay: Annotated[
        bool, typer.Option("--stay", help="Keep running after the recording's end.")
    ] = False,
    record: Annotated[
        Path | None, typer.Option(help="Record the replay to this file, with maps and contacts.")
    ] = None,
) -> None:
    """Play a recording through the daemon, which cannot tell it from a device.

    The bytes come back by a mock serial port and take the same way as live ones: the maps equal
    those of the live run. Without --viewer and --stay it ends with the recording.

    A folder of files that a daemon has cut is played as the one recording that it was, from the
    oldest to the newest; pauses between them are shortened to a second.
    """
    from tactomo.recording_set import RecordingSet, open_replayable

    factor = _speed(speed)
    opened = open_replayable(recording)
    origin = opened.origin
    if with_viewer:
        if record is not None:
            raise typer.BadParameter("--record goes without --viewer")
        from tactomo.cli.demo import show_replay

        show_replay(
            recording, speed, sensor, description, calibration, stream, control, viewer_port
        )
        return
    from tactomo.config import load_config

    settings = load_config(
        name=sensor or origin.sensor or None,
        description=description or origin.description or None,
        calibration=calibration,
        ports=opened.replay_urls(factor),
        tier=tier,
        stream=stream,
        control=control,
        lossless=True if factor == 0 else None,
        exit_at_end=not stay,
        record=record,
        record_maps=record is not None or None,
    )
    for part in opened.parts if isinstance(opened, RecordingSet) else [opened]:
        warn_of_damage(part)
    raise typer.Exit(_run_daemon(settings))


def warn_of_damage(recording: Recording) -> None:
    """Tell on standard error that a recording is not all there."""
    summary = recording.summary
    if summary.ending:
        typer.echo(
            f"{recording.path} is {summary.ending}. There are {summary.duration_s:.1f} s up to "
            "where it ends",
            err=True,
        )


def _run_daemon(settings: DaemonConfig) -> int:
    """Serve until the daemon is stopped, and return its exit status."""
    from tactomo.daemon import Daemon
    from tactomo.log import configure_logging

    configure_logging(settings.log_level, settings.log_format)
    return Daemon(settings).run()


def _endpoint(text: str) -> str:
    from tactomo.endpoint import check_endpoint

    try:
        return check_endpoint(text)
    except ValueError as error:
        raise typer.BadParameter(f"--bind {text}: {error}") from error


def _speed(text: str) -> float:
    """Return the factor; 0 for "max"."""
    try:
        factor = 0.0 if text == "max" else float(text)
    except ValueError:
        factor = -1.0
    if not 0.0 <= factor < float("inf"):
        raise typer.BadParameter(f"--speed {text}: give a factor above 0, or max")
    return factor

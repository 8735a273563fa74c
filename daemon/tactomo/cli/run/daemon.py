"""`tactomo daemon` and `tactomo replay`: maps and contacts of a device, or of a recording."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tactomo.cli import options
from tactomo.cli.output import say
from tactomo.errors import TactomoError

if TYPE_CHECKING:
    from tactomo_models import SensorDescription

    from tactomo.config import DaemonConfig
    from tactomo.recordings.recording import Recording
    from tactomo.recordings.replay import Playback

app = options.typer_app()


@app.command(
    epilog=options.examples(
        "tactomo daemon --port /dev/ttyACM0",
        "tactomo daemon --sensor left_forearm --port /dev/ttyACM0 --port /dev/ttyACM1",
        "tactomo daemon /etc/tactomo/left_forearm.toml --method tikhonov",
        "tactomo daemon robot.toml",
        "tactomo daemon --port /dev/ttyACM0 --set recording.maps=true",
    )
)
def daemon(
    config: Annotated[
        Path | None, typer.Argument(help="Configuration (TOML); options override its keys.")
    ] = None,
    sensor: Annotated[
        str | None, typer.Option("--sensor", "-s", help="The sensor's name in the stream. [skin]")
    ] = None,
    description: options.GivenDescription = None,
    port: Annotated[
        list[str] | None,
        typer.Option("--port", "-p", help="Serial device or pyserial URL; twice for two boards."),
    ] = None,
    protocol: options.GivenProtocol = None,
    method: options.GivenMethod = None,
    budget_ms: Annotated[
        float | None,
        typer.Option(help="Work per frame, in ms of a 2.5 GHz core. [the method's own]"),
    ] = None,
    stream: Annotated[
        str | None, typer.Option(help=f"Address of the stream. [{options.DEFAULT_STREAM}]")
    ] = None,
    control: Annotated[
        str | None, typer.Option(help=f"Address for commands. [{options.DEFAULT_CONTROL}]")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Any other key of the configuration, such as recording.maps=true; repeat.",
        ),
    ] = None,
) -> None:
    """Read a skin's ports, reconstruct, and publish maps and contacts until stopped.

    A configuration may describe several skins, each in a table [skins.NAME]. Each skin gets a
    process, and a process that ends is started again. --sensor starts this skin alone.

    At the start, nothing may touch the skin for a second: changes are measured against these first
    scans, the reference. `tactomo tare` takes a new reference at any time.

    `tactomo service example` shows every key of the configuration. `--set` takes any key:
    `lossless=true`, `tare_scans=40`, `metrics=127.0.0.1:9460`, `recording.file=grasp.mcap`.
    """
    from tactomo.config import DaemonConfig, load_skins

    settings = load_skins(
        config,
        **{
            **dict(_setting(each) for each in set_ or ()),
            "name": sensor,
            "description": description,
            "ports": port or None,
            "protocol": protocol,
            "method": method,
            "budget_ms": budget_ms,
            "stream": stream,
            "control": control,
        },
    )
    if isinstance(settings, DaemonConfig):
        raise typer.Exit(_run_daemon(settings))
    raise typer.Exit(_run_skins(settings))


def _setting(text: str) -> tuple[str, Any]:
    """Return key and value of "recording.maps=true"; a value that is no TOML is a string."""
    import tomllib

    key, equals, value = text.partition("=")
    if not equals or not key:
        raise typer.BadParameter(f"{text!r} is not KEY=VALUE", param_hint="'--set'")
    try:
        return key, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key, value


@app.command(
    epilog=options.examples(
        "tactomo replay grasp.mcap --viewer",
        "tactomo replay grasp.mcap --speed 0.25",
        "tactomo replay grasp.mcap --speed max --record frames.mcap",
    )
)
def replay(
    recording: options.RecordingFile,
    speed: Annotated[
        str, typer.Option(help="Factor of the recorded speed, or max: as fast as reconstructed.")
    ] = "1.0",
    with_viewer: Annotated[
        bool, typer.Option("--viewer", help="Also serve the page, and stay at the end.")
    ] = False,
    sensor: Annotated[
        str | None, typer.Option("--sensor", "-s", help="Name in the stream. [the recorded one]")
    ] = None,
    description: options.RecordedDescription = None,
    calibration: Annotated[
        Path | None,
        typer.Option(help="Pressure calibration, from `tactomo calibrate`. [the recorded one]"),
    ] = None,
    method: options.Method = "auto",
    stream: options.ServeStream = None,
    control: options.ServeControl = None,
    viewer_port: options.ViewerPort = None,
    stay: Annotated[
        bool, typer.Option("--stay", help="Keep running after the recording's end.")
    ] = False,
    start: Annotated[
        float, typer.Option(min=0.0, help="Start, seconds after the recording's beginning.")
    ] = 0.0,
    loop: Annotated[bool, typer.Option("--loop", help="Restart at the end.")] = False,
    paused: Annotated[bool, typer.Option("--paused", help="Wait for the page's Play.")] = False,
    wait_for_page: Annotated[bool, typer.Option("--wait-for-page", hidden=True)] = False,
    record: Annotated[
        Path | None, typer.Option(help="Record the replay to this file, with maps and contacts.")
    ] = None,
) -> None:
    """Play a recording through the daemon, which cannot tell it from a device.

    The recorded bytes take the way of live bytes, so the maps equal those of the live run. Without
    --viewer and --stay, the replay ends with the recording.

    Each file of a recording that a daemon has cut into several is played by itself.

    With --viewer, the replay shows its first frame and waits until a browser opens the page. The
    page, or the command `replay` of the control socket, pauses, steps, moves and slows the replay.
    """
    factor = _speed(speed)
    options.need_recording(recording)
    from tactomo.cli.run.demo import free_of, show_replay
    from tactomo.recordings.recording import open_recording

    stream, control = free_of((stream, options.DEFAULT_STREAM), (control, options.DEFAULT_CONTROL))
    opened = open_recording(recording)
    if start > (length_s := opened.summary.duration_s):
        raise typer.BadParameter(f"--start {start:g}: the recording ends after {length_s:.3f} s")
    origin = opened.origin
    if with_viewer:
        if record is not None:
            raise typer.BadParameter("--record goes without --viewer")
        more = ["--method", method]
        more += [] if description is None else ["--description", description]
        more += [] if calibration is None else ["--calibration", str(calibration)]
        more += ["--start", str(start), *(["--loop"] if loop else [])]
        more += ["--paused"] if paused else ["--wait-for-page"]
        name = sensor or origin.sensor or options.DEFAULT_NAME
        show_replay(recording, speed, name, stream, control, viewer_port, more)
        return
    from tactomo_models import load_description

    from tactomo.config import load_config

    carried = load_description(description) if description else origin.read_description()
    settings = load_config(
        name=sensor or origin.sensor or None,
        description=description or carried.name,
        calibration=calibration,
        ports=opened.replay_urls(factor),
        method=method,
        stream=stream,
        control=control,
        lossless=factor == 0,
        exit_at_end=not stay,
        recording={"file": record, "maps": record is not None},
    )
    warn_of_damage(opened)

    def begin(playback: Playback) -> None:
        playback.steer(paused or wait_for_page, None, loop)
        playback.waits_for_page = wait_for_page
        if start or playback.is_paused:
            playback.move(start)  # while paused, the first frame is shown

    raise typer.Exit(_run_daemon(settings, begin, None if description else carried))


def warn_of_damage(recording: Recording) -> None:
    """Tell on standard error that a recording is not all there."""
    summary = recording.summary
    if summary.ending:
        say(
            f"{recording.path} is {summary.ending}. There are {summary.duration_s:.1f} s up to "
            "where it ends",
            err=True,
        )


def _run_daemon(
    settings: DaemonConfig,
    begin_replay: Callable[[Playback], None] = lambda _: None,
    description: SensorDescription | None = None,
) -> int:
    _prepare(settings)
    from tactomo.service.daemon import Daemon

    daemon = Daemon(settings, description=description)
    if daemon.playback is not None:
        begin_replay(daemon.playback)
    status = daemon.run()
    if settings.exit_at_end and daemon.recording_failure:
        raise TactomoError(
            f"{settings.recording.file} ended early: {daemon.recording_failure}",
            "make room for the maps, or name a file where there is more",
        )
    return status


def _run_skins(skins: tuple[DaemonConfig, ...]) -> int:
    _prepare(skins[0])
    from tactomo.cli.run.skins import SkinProcesses

    return SkinProcesses(skins).run()


def _prepare(settings: DaemonConfig) -> None:
    from tactomo.log import configure_logging
    from tactomo.memory import return_freed_memory

    return_freed_memory()
    configure_logging(settings.log_level, settings.log_format)


def _speed(text: str) -> float:
    if text == "max":
        return 0.0
    try:
        factor = float(text)
    except ValueError:
        factor = -1.0
    if not 1e-3 <= factor <= 1e3:
        raise typer.BadParameter(f"--speed {text}: give a factor from 0.001 to 1000, or max")
    return factor

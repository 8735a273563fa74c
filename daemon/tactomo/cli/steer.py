"""`tactomo status`, `tare`, `record`, `tier` and `poke`: one request to a running program each."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tactomo.cli.app import (
    DEFAULT_CONTROL,
    DEFAULT_STREAM,
    DEFAULT_TWIN_CONTROL,
    STEER,
    ControlAddress,
    JsonOutput,
    KeysFolder,
    Method,
    StreamAddress,
    app,
    examples,
)
from tactomo.cli.complaints import complaints
from tactomo.errors import TactomoError

if TYPE_CHECKING:
    from rich.table import Table
    from tactomo_client import Daemon, RecordedFile

HEARD_WITHIN_S = 3.0
"""A status comes every second."""
SOON_S = 3.0
USUAL_TARE_SCANS = 20
"""Where no reference says yet how many the daemon takes."""


@app.command(
    rich_help_panel=STEER,
    epilog=examples(
        "tactomo status",
        "tactomo status -s left_forearm",
        "tactomo status -s left_forearm --stream tcp://127.0.0.1:5570",
        "tactomo status --json | jq .latency_ms",
    ),
)
def status(
    sensor: Annotated[
        str | None,
        typer.Option(
            "--sensor",
            "-s",
            help="Of this sensor, by its stream; so through a proxy, too. [by the control socket]",
        ),
    ] = None,
    stream: StreamAddress = DEFAULT_STREAM,
    control: ControlAddress = DEFAULT_CONTROL,
    keys: KeysFolder = None,
    as_json: JsonOutput = False,
) -> None:
    """Show how the daemon is: first what is wrong and what to do about it, then all there is.

    Ports, rates, latency, the time of each stage, what was lost, what happened since the start.
    `tactomo doctor` looks deeper.
    """
    from tactomo_client import request

    answer = request("status", control, keys=keys) if sensor is None else None
    if answer is None:
        answer = _heard_status(str(sensor), stream, keys)
    if as_json:
        typer.echo(json.dumps(answer, indent=2, default=str))
        return
    from rich.console import Console
    from rich.markup import escape

    console = Console()
    for complaint in complaints(answer):
        colour = "bold red" if complaint.severity == "error" else "yellow"
        console.print(f"[{colour}]{escape(complaint.what)}[/]\n    {escape(complaint.next_step)}")
    console.print(status_table(answer))


@app.command(
    rich_help_panel=STEER,
    epilog=examples("tactomo tare"),
)
def tare(control: ControlAddress = DEFAULT_CONTROL, keys: KeysFolder = None) -> None:
    """Take a new reference: the next scans of the *unloaded* skin count as "nothing pressed".

    Leave the skin alone for a second, then run this. Needed after mounting the skin, after a
    change of temperature, and when contacts show up where nobody presses.
    """
    from tactomo_client import Daemon
    from tactomo_client.control import TARE_TIMEOUT_S

    with Daemon(control, keys=keys) as daemon:
        needs_s = _tare_s(daemon.request("status"))
        if needs_s > SOON_S:
            typer.echo(f"leave the skin alone: its scans take {needs_s:.0f} s to come", err=True)
        taken = daemon.tare(TARE_TIMEOUT_S + 2 * needs_s)
    typer.echo(f"new reference from {taken.scans} dual scans")
    if taken.contacts:
        typer.echo(
            f"{taken.contacts} contact(s) were shown meanwhile and now count as nothing pressed; "
            "if something was on the skin, take it off and tare again",
            err=True,
        )


def _tare_s(status: Mapping[str, Any]) -> float:
    """Return how long a reference's scans take to come, in seconds, by the last one's number."""
    scans = (status.get("reference") or {}).get("scans") or USUAL_TARE_SCANS
    rate_hz = (status.get("rates") or {}).get("frames_hz") or 0.0
    return float(scans / rate_hz) if rate_hz else 0.0


@app.command(
    rich_help_panel=STEER,
    epilog=examples(
        "tactomo record grasp.mcap --seconds 10",
        "tactomo record grasp.mcap --maps",
        "tactomo record start grasp.mcap",
        "tactomo record start        (into the daemon's folder)",
        "tactomo record stop",
    ),
)
def record(
    what: Annotated[
        str,
        typer.Argument(
            metavar="start|stop|FILE",
            help="Start a recording and return, stop it, or record FILE while this runs.",
        ),
    ],
    path: Annotated[Path | None, typer.Argument(help="For `start`: the file.")] = None,
    seconds: Annotated[
        float | None,
        typer.Option(min=0.1, help="For FILE: how long; until Ctrl-C when left out."),
    ] = None,
    maps: Annotated[
        bool, typer.Option("--maps", help="With maps and contacts. [as the daemon is configured]")
    ] = False,
    control: ControlAddress = DEFAULT_CONTROL,
    keys: KeysFolder = None,
) -> None:
    """Record what the ports say (every byte, with its time) into an MCAP file.

    The daemon writes the file, so it keeps recording when this command ends, and the path is one
    on the daemon's computer. Without a path it records into its folder, cut into files of which
    the newest are kept, as its configuration says under [recording]. `tactomo replay` plays a file
    again; each of several replays by itself.
    """
    from tactomo_client import Daemon

    daemon = Daemon(control, keys=keys)
    if what not in ("start", "stop"):
        if path is not None:
            raise typer.BadParameter("give one file, or `start FILE`")
        _record_for(daemon, Path(what), seconds, maps or None)
        return
    if seconds is not None:
        raise typer.BadParameter("--seconds goes with FILE, not with start or stop")
    if what == "stop":
        if path is not None or maps:
            raise typer.BadParameter("stop takes no file, and no --maps")
        _tell_recorded(daemon.record_stop())
        return
    typer.echo(f"recording to {daemon.record_start(path, maps=maps or None).path}")


@app.command(
    rich_help_panel=STEER,
    epilog=examples("tactomo tier levelset", "tactomo tier auto --budget-ms 20"),
)
def tier(
    name: Annotated[
        Method,
        typer.Argument(help="The tier; auto chooses one for each frame."),
    ],
    budget_ms: Annotated[
        float | None, typer.Option(min=0.1, help="Time that one reconstruction may take.")
    ] = None,
    control: ControlAddress = DEFAULT_CONTROL,
    keys: KeysFolder = None,
) -> None:
    """Choose how much model a frame is given, while the daemon runs."""
    from tactomo_client import Daemon

    with Daemon(control, keys=keys) as daemon:
        in_force = daemon.set_tier(name).tier
        if budget_ms is not None:
            daemon.set_budget(budget_ms)
    typer.echo(f"tier {in_force}")


@app.command(
    rich_help_panel=STEER,
    epilog=examples(
        "tactomo poke press x_mm=10 y_mm=-20 pressure_kpa=180",
        "tactomo poke release",
        "tactomo poke mute channel=structure seconds=3",
        "tactomo poke garbage count=500",
        "tactomo poke unplug",
        "tactomo poke replug",
        "tactomo poke status",
    ),
)
def poke(
    command: Annotated[str, typer.Argument(help="A command of the twin, see below.")],
    arguments: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME=VALUE]...", help="Its arguments.")
    ] = None,
    control: Annotated[
        str, typer.Option("--control", help="Address of the twin's control socket.")
    ] = DEFAULT_TWIN_CONTROL,
) -> None:
    """Press, move, release and break a running twin, as a test of your own robot would.

    `press` (x_mm, y_mm, id, radius_mm, pressure_kpa, shape; the same id again moves it),
    `release` (id), `clear`, `scene` (what presses now), `play` (the scripted scene from its start),
    `noise` (noise_v), `drift` (swing_k, period_s, step_k, press_creep, ...), `mute` (channel,
    seconds), `garbage` (count, port), `unplug` and `replug` (port), `status`.
    """
    from tactomo_client import request

    answer = request(command, control, **dict(_named(argument) for argument in arguments or []))
    if answer:
        typer.echo(json.dumps(answer, indent=2))


def _heard_status(sensor: str, stream: str, keys: Path | None) -> dict[str, Any]:
    """Return the status that a sensor's stream tells, every second and to each newcomer."""
    from tactomo_client import subscribe

    with subscribe(sensor, kind="status", address=stream, keys=keys) as statuses:
        status = statuses.wait(HEARD_WITHIN_S)
    if status is not None:
        return dict(status.fields)
    raise TactomoError(
        f"nothing is heard of sensor {sensor!r} at {stream}",
        "is its daemon running under this name? `tactomo status` without -s asks the one whose "
        "control socket is at --control",
    )


def status_table(status: dict[str, Any]) -> Table:
    """Return a status message as a table for people; what it does not know shows as "-"."""
    from rich.table import Table

    table = Table(title=f"{status['sensor']}: {status['state']}", show_header=False)
    for name, value in _status_rows(status):
        table.add_row(f"[bold]{name}[/]", value)
    return table


def _status_rows(status: dict[str, Any]) -> list[tuple[str, str]]:
    rates = status.get("rates") or {}
    latency = status.get("latency_ms") or {}
    recording = status.get("recording")
    reference = status.get("reference") or {}
    description = status.get("description") or {}
    rows = [
        ("daemon", f"{status.get('version')}, up {status.get('uptime_s', 0.0):.0f} s"),
        ("sensor", f"{description.get('model')} ({', '.join(description.get('modalities', []))})"),
        ("pressure", _pressure(description)),
        ("source", str((status.get("source") or {}).get("kind"))),
        *(("port", _port_line(port)) for port in status.get("ports", [])),
        (
            "rates",
            f"{_number(rates.get('frames_hz'))} frames/s; scans/s: "
            f"magnitude {_number(rates.get('magnitude_hz'))}, "
            f"structure {_number(rates.get('structure_hz'))}",
        ),
        ("latency", _percentiles(latency)),
        *(
            (f"  {stage}", _percentiles(times))
            for stage, times in (status.get("stage_ms") or {}).items()
        ),
        ("tier", f"{status.get('tier') or '-'} (asked for: {status.get('tier_requested')})"),
        ("budget", _budget(status.get("budget_ms"), status.get("plan") or {})),
        ("flags", ", ".join(status.get("flags", [])) or "none"),
        (
            "misfit",
            f"{_number(status.get('misfit'))} (1: explained to the noise; too much is flagged)",
        ),
        (
            "lost",
            f"{status.get('dropped_scans', 0)} dual scans dropped, "
            f"{status.get('incomplete_scans', 0)} incomplete",
        ),
        ("reference", f"{reference['scans']} dual scans" if reference else "none yet"),
        ("baseline", _baseline(status.get("baseline") or {})),
        ("recording", _recording(recording, status.get("recorder") or {})),
        ("subscribers", str(status.get("subscribers", "-"))),
        ("events", _events(status.get("events") or {})),
        *(("  last", _trouble(each)) for each in (status.get("events") or {}).get("troubles", [])),
        ("process", _process(status.get("process") or {}, status.get("uptime_s") or 0.0)),
    ]
    return rows


def _pressure(description: dict[str, Any]) -> str:
    """Say what turns a change into a pressure."""
    calibration = description.get("calibration")
    if calibration:
        low, high = calibration["range_kpa"]
        return (
            f"calibrated {calibration['taken'][:10]} by {calibration['readings']} readings: "
            f"{low:.0f} to {high:.0f} kPa ± {calibration['sigma_kpa']:.1f}"
        )
    if description.get("pressure_max_kpa") is None:
        return "none: no magnitude channel"
    return "by the description's table; `tactomo calibrate` makes it this sensor's"


def _baseline(baseline: dict[str, Any]) -> str:
    """Say whether the reference follows drift, and how far it has gone since the tare."""
    from rich.markup import escape

    state, refusal = str(baseline.get("state") or "-"), baseline.get("refusal")
    told = f"[yellow]{state}:[/] {escape(refusal)}" if refusal else state
    gone = [
        f"{channel} {drift['gain']:+.2%}, unevenly {drift['uneven']:.2%}"
        for channel, drift in (baseline.get("drift") or {}).items()
    ]
    return "; ".join([told, *gone])


def _recording(recording: dict[str, Any] | None, recorder: dict[str, Any]) -> str:
    if recording:
        return f"{recording['path']} ({recording['bytes'] / 1e6:.1f} MB)"
    waits_for = recorder.get("waits_for")
    return f"[red]waits:[/] {waits_for}" if waits_for else "off"


def _events(events: dict[str, Any]) -> str:
    counts = events.get("counts") or {}
    return ", ".join(f"{name} {count}" for name, count in sorted(counts.items())) or "none"


def _trouble(trouble: dict[str, Any]) -> str:
    from rich.markup import escape

    age_s = trouble.get("age_s") or 0.0
    colour = "red" if trouble.get("severity") == "error" else "yellow"
    ago = f"{age_s:.0f} s" if age_s < 120 else f"{age_s / 60:.0f} min"
    return f"[{colour}]{trouble.get('name')}[/], {ago} ago: {escape(str(trouble.get('detail')))}"


def _process(process: dict[str, Any], uptime_s: float) -> str:
    memory_bytes = process.get("memory_bytes")
    memory = "-" if memory_bytes is None else f"{memory_bytes / 1e6:.0f} MB"
    share = 1e2 * (process.get("cpu_s") or 0.0) / max(uptime_s, 1.0)
    return (
        f"pid {process.get('pid', '-')}, {share:.1f} % of a core on average, "
        f"{memory}, {process.get('threads', '-')} threads"
    )


def _port_line(port: dict[str, Any]) -> str:
    device = port.get("device") or {}
    state = port.get("state", "open") if port.get("connected") else "[red]not open[/]"
    corrupt, problem = port.get("corrupt", 0), port.get("problem")
    return (
        f"{port.get('url')} ({state}), {device.get('device_id', 'no hello yet')}, "
        f"{', '.join(device.get('channels', [])) or '-'}; {port.get('packets', 0)} packets, "
        + (f"[yellow]{corrupt} corrupt[/]" if corrupt else "none corrupt")
        + (f"; [yellow]{problem}[/]" if problem else "")
    )


def _budget(budget_ms: float | None, plan: dict[str, Any]) -> str:
    """Say what time a frame may take, and what it is given for that."""
    source = f"machine speed: {plan.get('source', '-')}"
    if budget_ms is None:
        return f"the tier's own; {source}"
    given = f"{plan.get('tier')}, {_number(plan.get('modelled_ms'))} modelled ms"
    return f"{budget_ms:g} ms: {given}; {source}"


def _percentiles(times: dict[str, Any]) -> str:
    return f"p50 {_number(times.get('p50'))} ms, p99 {_number(times.get('p99'))} ms"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _record_for(daemon: Daemon, path: Path, seconds: float | None, maps: bool | None) -> None:
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    size = TextColumn("{task.fields[size]}")
    columns = (TextColumn("recording"), BarColumn(), TimeElapsedColumn(), size)
    begin_s = time.monotonic()
    with (
        daemon.record(path, maps=maps) as recording,
        suppress(KeyboardInterrupt),  # the way to end a recording without --seconds
        Progress(*columns, transient=True) as progress,
    ):
        task = progress.add_task(recording.path, total=seconds, size="")
        while seconds is None or time.monotonic() - begin_s < seconds:
            now = daemon.status().recording
            passed_s = time.monotonic() - begin_s
            recorded = f"{now.bytes / 1e6:.1f} MB" if now else ""
            progress.update(task, completed=passed_s, size=recorded)
            left_s = 0.5 if seconds is None else seconds - passed_s
            time.sleep(max(0.0, min(0.5, left_s)))
    if recording.file is not None:
        _tell_recorded(recording.file)


def _tell_recorded(file: RecordedFile) -> None:
    typer.echo(f"recorded {file.path} ({file.bytes / 1e6:.2f} MB)")


def _named(argument: str) -> tuple[str, Any]:
    """Return name and value of "x_mm=10"; the value is a number where it reads as one."""
    name, equals, text = argument.partition("=")
    if not equals or not name:
        raise typer.BadParameter(f"{argument!r} is not NAME=VALUE")
    for read in (int, float):
        try:
            return name, read(text)
        except ValueError:
            continue
    return name, text

"""`tactomo status`, `tare`, `record`, `method`, `poke`: one request to a running program each."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tactomo.cli import options
from tactomo.cli.output import mapped, print_json, say
from tactomo.cli.sensors import find_commanded, find_twin, newest_status, of_this_version, reader_of
from tactomo.errors import TactomoError
from tactomo.plain import counted, plain

if TYPE_CHECKING:
    from tactomo_client import Daemon, RecordedFile, Status
    from tactomo_client.schema import (
        Baseline,
        EventCounts,
        Percentiles,
        Port,
        Process,
        SensorDescription,
        Trouble,
    )

SOON_S = 3.0
START_S = 60.0  # in which a daemon builds its models and takes a reference
USUAL_TARE_SCANS = 20  # where no reference says yet how many the daemon takes

app = options.typer_app()


@app.command(epilog=options.examples("tactomo tare"))
def tare(
    sensor: options.Sensor = None,
    address: options.Address = None,
    keys: options.KeysFolder = None,
) -> None:
    """Take a new reference: the next scans of the *unloaded* skin count as "nothing pressed".

    Leave the skin alone for a second, then run this. Needed after mounting the skin, after a
    change of temperature, and when contacts show up where nobody presses.
    """
    from tactomo_client import Daemon
    from tactomo_client.control import TARE_TIMEOUT_S

    with Daemon(find_commanded(sensor, address, keys).control, keys=keys) as daemon:
        needs_s = _tare_s(daemon.request("status"))
        if needs_s > SOON_S:
            say(f"leave the skin alone: the scans take {needs_s:.0f} s to come", err=True)
        taken = daemon.tare(TARE_TIMEOUT_S + 2 * needs_s)
    say(f"new reference from {taken.scans} dual scans")
    if taken.contacts:
        say(
            f"shown meanwhile: {counted(taken.contacts, 'contact')}. If something was on the skin, "
            "it now counts as nothing pressed: take it off and tare again",
            err=True,
        )


def _tare_s(status: Mapping[str, Any]) -> float:
    """Return how long a reference's scans take to come, in seconds, by the last one's number."""
    scans = (status.get("reference") or {}).get("scans") or USUAL_TARE_SCANS
    rate_hz = (status.get("rates") or {}).get("frames_hz") or 0.0
    return float(scans / rate_hz) if rate_hz else 0.0


@app.command(
    epilog=options.examples(
        "tactomo record grasp.mcap --seconds 10",
        "tactomo record grasp.mcap --maps",
        "tactomo record start grasp.mcap",
        "tactomo record start        (into the daemon's folder)",
        "tactomo record stop",
    )
)
def record(
    what: Annotated[
        str,
        typer.Argument(
            metavar="start|stop|FILE",
            help="Start a recording and return, stop it, or record FILE while this runs.",
        ),
    ],
    name: Annotated[str | None, typer.Argument(metavar="[FILE]", help="For `start`.")] = None,
    seconds: Annotated[
        float | None,
        typer.Option(min=0.1, max=3.2e7, help="For FILE: how long; until Ctrl-C when left out."),
    ] = None,
    maps: Annotated[
        bool, typer.Option("--maps", help="With maps and contacts. [as the daemon is configured]")
    ] = False,
    sensor: options.Sensor = None,
    address: options.Address = None,
    keys: options.KeysFolder = None,
) -> None:
    """Record every byte of the ports, with its time, into an MCAP file.

    The daemon writes the file on its own computer, into its `recording.folder` alone (by default
    ~/.local/share/tactomo/recordings; for `tactomo demo`, the folder of its start), and continues
    when this command ends. `start` without FILE cuts the recording into files and keeps the newest,
    as configured under [recording]. `tactomo replay` plays a file.
    """
    from tactomo_client import Daemon

    to_file = what not in ("start", "stop")
    if to_file and name is not None:
        raise typer.BadParameter("give one file, or `start FILE`")
    if not to_file and seconds is not None:
        raise typer.BadParameter("--seconds goes with FILE, not with start or stop")
    if what == "stop" and (name is not None or maps):
        raise typer.BadParameter("stop takes no file, and no --maps")
    daemon = Daemon(find_commanded(sensor, address, keys).control, keys=keys)
    if to_file:
        _record_for(daemon, what, seconds, maps or None)
    elif what == "stop":
        _print_recorded(daemon.record_stop())
    else:
        say(f"recording to {daemon.record_start(name, maps=maps or None).path}")


@app.command(
    epilog=options.examples("tactomo method levelset", "tactomo method auto --budget-ms 20")
)
def method(
    name: Annotated[
        str,
        typer.Argument(
            help="The method; auto chooses for each frame. `tactomo status` lists those that the "
            "daemon has.",
            autocompletion=options.method_names,
        ),
    ],
    budget_ms: Annotated[
        float | None, typer.Option(min=0.1, help="Work per frame, in ms of a 2.5 GHz core.")
    ] = None,
    sensor: options.Sensor = None,
    address: options.Address = None,
    keys: options.KeysFolder = None,
) -> None:
    """Choose the reconstruction method while the daemon runs.

    A running daemon offers your own method (my_module:MyMethod) only if the daemon was started with
    that method, or if the method's distribution is installed beside the daemon.
    """
    from tactomo_client import Daemon

    with Daemon(find_commanded(sensor, address, keys).control, keys=keys) as daemon:
        in_force = daemon.set_method(name).tier
        if budget_ms is not None:
            daemon.set_budget(budget_ms)
    say(f"method {in_force}")


@app.command(
    epilog=options.examples(
        "tactomo poke press x_mm=10 y_mm=-20 pressure_kpa=180",
        "tactomo poke release",
        "tactomo poke mute channel=structure seconds=3",
        "tactomo poke garbage count=500",
        "tactomo poke unplug",
        "tactomo poke replug",
        "tactomo poke status",
    )
)
def poke(
    command: Annotated[str, typer.Argument(help="A command of the twin, see above.")],
    arguments: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME=VALUE]...", help="The command's arguments.")
    ] = None,
    address: Annotated[
        str | None,
        typer.Option(
            "--address", "-a", help="Address of the twin's control socket. [the only twin's]"
        ),
    ] = None,
) -> None:
    """Press, move, release and break a running twin, as a test of your own robot would.

    Commands: `press` (x_mm, y_mm, id, radius_mm, pressure_kpa, shape; the same id again moves the
    press), `release` (id), `clear`, `scene` (list the present presses), `play` (restart the
    scripted scene), `noise` (noise_v), `drift` (swing_k, period_s, step_k, press_creep, ...),
    `mute` (channel, seconds), `garbage` (count, port), `unplug` and `replug` (port), `status`.

    `press` waits for the daemon's reference, at most 60 s: an earlier press would be part of it.
    """
    from tactomo_client import request

    named = dict(_named(argument) for argument in arguments or [])
    twin = find_twin(address)
    if command == "press":
        _await_reference(twin)
    answer = request(command, twin, **named)
    if answer.pop("released", True) is False:
        raise TactomoError("no press has this id", "`tactomo poke scene` lists the presses")
    if answer:
        print_json(answer)


def _await_reference(twin: str) -> None:
    """Wait until the daemon that reads a twin has its reference; say so."""
    end_s, said = time.monotonic() + START_S, ""
    while why := _untared(twin):
        if time.monotonic() > end_s:
            say("this press becomes part of the reference; later: `tactomo tare`", err=True)
            return
        if why != said:
            say(f"waiting: {why}", err=True)
        said = why
        time.sleep(0.1)


def _untared(twin: str) -> str:
    """Say why a press would become part of a reference; empty where it would not."""
    from tactomo_client import request

    told = request("status", twin)
    reader = reader_of(port["path"] for port in told["ports"])
    if reader is None:  # or a program of the user's own, for a second: a daemon is known by then
        is_read = any(port["open"] and port["sent"] > told["rate_hz"] for port in told["ports"])
        return "" if is_read else "no program reads the twin yet"
    status = request("status", reader.control)
    if status["state"] == "taring" or not status["reference"]:
        return f"{reader.sensor} has no reference yet"
    return ""


def _record_for(daemon: Daemon, name: str, seconds: float | None, maps: bool | None) -> None:
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

    from tactomo.cli.children import interrupt_at_end
    from tactomo.cli.console import progress

    interrupt_at_end()  # the daemon would go on, and fill its disk
    size = TextColumn("{task.fields[size]}")
    columns = (TextColumn("recording"), BarColumn(), TimeElapsedColumn(), size)
    with (
        daemon.record(name, maps=maps) as recording,
        suppress(KeyboardInterrupt),  # the way to end a recording without --seconds
        progress(*columns) as bar,
    ):
        begin_s = time.monotonic()  # a disk may have taken seconds over the start
        task = bar.add_task(recording.path, total=seconds, size="")
        while seconds is None or time.monotonic() - begin_s < seconds:
            now = daemon.status().recording
            passed_s = time.monotonic() - begin_s
            recorded = f"{now.bytes / 1e6:.1f} MB" if now else ""
            bar.update(task, completed=passed_s, size=recorded)
            left_s = 0.5 if seconds is None else seconds - passed_s
            time.sleep(max(0.0, min(0.5, left_s)))
    if recording.file is not None:
        _print_recorded(recording.file)


def _print_recorded(file: RecordedFile) -> None:
    say(f"recorded {file.path} ({file.bytes / 1e6:.2f} MB)")


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


@app.command(
    epilog=options.examples(
        "tactomo status",
        "tactomo status -s left_forearm",
        "tactomo status --address tcp://robot:5560 --keys ~/keys/robot",
        "tactomo status --json | jq .latency_ms",
    )
)
def status(
    sensor: options.Sensor = None,
    address: options.Address = None,
    keys: options.KeysFolder = None,
    as_json: options.JsonOutput = False,
) -> None:
    """Show the daemon's state: problems with their next steps first, then all values.

    Values: ports, rates, latency, time of each stage, losses, and events since the start. `tactomo
    doctor` examines the skin itself.
    """
    answer = newest_status(sensor, address, keys)
    if as_json:
        print_json(answer)
        return
    for line in lines_of(answer):
        typer.echo(line)


def lines_of(answer: Mapping[str, Any]) -> list[str]:
    """Return what is printed of a status.

    Raises TactomoError where another program, or another version, made it of other types.
    """
    from tactomo_client.control import to_status

    lines = []
    with of_this_version():
        status = to_status(mapped(answer, lambda v: plain(v) if isinstance(v, str) else v))
        for issue in status.issues:
            colour = "red" if issue.severity == "error" else "yellow"
            lines += [typer.style(issue.what, fg=colour, bold=True), f"    {issue.next_step}"]
        lines.append(f"{status.sensor}: {_words(status.state)}")
        rows = _rows(status)
    return lines + [f"{typer.style(f'{name:<13} ', bold=True)}{value}" for name, value in rows]


def _rows(status: Status) -> list[tuple[str, str]]:
    from tactomo_client.appearance import companion_words
    from tactomo_client.schema import SensorDescription

    description = status.description or SensorDescription()
    recording, reference, rates = status.recording, status.reference, status.rates
    scan_rates = (
        f"{channel} {_number(getattr(rates, f'{channel}_hz', None))}"
        for channel in description.modalities
    )
    return [
        ("daemon", f"{status.version}, up {status.uptime_s:.0f} s"),
        ("sensor", f"{description.model} ({', '.join(description.modalities)})"),
        ("pressure", _pressure(description)),
        ("source", status.source.kind),
        *(("port", _port_line(port)) for port in status.ports),
        ("rates", f"{_number(rates.frames_hz)} frames/s; scans/s: {', '.join(scan_rates)}"),
        ("latency", _percentiles(status.latency_ms)),
        *((f"  {stage}", _percentiles(times)) for stage, times in status.stage_ms.items()),
        ("method", f"{status.tier_requested}; the newest frame by {status.tier or '-'}"),
        ("  methods", ", ".join(status.methods) or "-"),
        ("budget", _budget(status.budget_ms, status.plan.share)),
        ("flags", "; ".join(map(_flag, sorted(status.flags))) or "none"),
        ("misfit", _misfit(status.misfit)),
        (
            "lost",
            f"{counted(status.dropped_scans, 'dual scan')} dropped and "
            f"{status.incomplete_scans} incomplete since the start, "
            f"{counted(status.frames, 'frame')} made",
        ),
        ("reference", counted(reference.scans, "dual scan") if reference else "none yet"),
        ("baseline", _baseline(status.baseline)),
        *(("companion", f"{k} {companion_words(each)}") for k, each in status.companions.items()),
        ("recording", f"{recording.path} ({_mb(recording.bytes)})" if recording else "off"),
        ("subscribers", str(status.subscribers)),
        ("events", _events(status.events)),
        *(("  last", _trouble(each)) for each in status.events.troubles),
        ("process", _process(status.process, status.uptime_s) if status.process else "-"),
    ]


def _pressure(description: SensorDescription) -> str:
    """Say what turns a change into a pressure."""
    if calibration := description.calibration:
        low, high = calibration.range_kpa
        return (
            f"calibrated {calibration.taken[:10]} by {calibration.readings} readings: "
            f"{low:.0f} to {high:.0f} kPa ± {calibration.sigma_kpa:.1f}"
        )
    if description.pressure_max_kpa is None:
        return "none: no magnitude channel"
    return "by the description's table; `tactomo calibrate` makes it this sensor's"


def _baseline(baseline: Baseline) -> str:
    """Say whether the reference follows drift, and how far it has gone since the tare."""
    state, refusal = baseline.state, baseline.refusal
    gone = [
        f"{channel} drifted by {drift.gain:+.2%}, unevenly by {drift.uneven:.2%}"
        for channel, drift in baseline.drift.items()
    ]
    return "; ".join([f"{_warn(state)}: {refusal}" if refusal else state, *gone])


def _events(events: EventCounts) -> str:
    from tactomo.events import times

    told = (f"{_words(name)} {times(count)}" for name, count in sorted(events.counts.items()))
    return ", ".join(told) or "none"


def _trouble(trouble: Trouble) -> str:
    age_s = trouble.age_s or 0.0
    ago = f"{age_s:.0f} s" if age_s < 120 else f"{age_s / 60:.0f} min"
    return f"{_warn(_words(trouble.name))}, {ago} ago: {trouble.detail}"


def _process(process: Process, uptime_s: float) -> str:
    share = 1e2 * process.cpu_s / max(uptime_s, 1.0)
    return (
        f"pid {process.pid}, {share:.1f} % of a core on average, "
        f"{_mb(process.memory_bytes)}, {process.threads} threads"
    )


def _mb(size_bytes: float | None) -> str:
    return "-" if size_bytes is None else f"{size_bytes / 1e6:.1f} MB"


def _port_line(port: Port) -> str:
    device_id = port.device.device_id if port.device else "no device has answered yet"
    channels = port.device.channels if port.device else ()
    return (
        f"{port.url} ({port.state or '-'}), {device_id}, {', '.join(channels) or '-'}; "
        f"{port.packets} packets, {port.corrupt} corrupt"
    )


def _budget(budget_ms: float | None, share: float) -> str:
    """Say how much work a frame may take."""
    left = f", {share:.0%} of it while other programs use the processor" if share < 1 else ""
    return ("the method's own" if budget_ms is None else f"{budget_ms:g} ms of work") + left


def _percentiles(times: Percentiles | None) -> str:
    return "-" if times is None else f"p50 {times.p50:.2f} ms, p99 {times.p99:.2f} ms"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _misfit(misfit: float | None) -> str:
    if misfit is None:
        return "unknown: no map yet"
    return f"{misfit:.2f} times the noise (about 1: the map explains the voltages)"


def _flag(name: str) -> str:
    from tactomo.service.health_issues import FLAG_ADVICE

    return f"{name}: {FLAG_ADVICE[name][0]}" if name in FLAG_ADVICE else name


def _words(name: str) -> str:
    return name.replace("_", " ")


def _warn(text: str) -> str:
    return typer.style(text, fg="yellow")

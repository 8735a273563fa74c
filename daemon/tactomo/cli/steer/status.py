"""`tactomo status`: what is wrong with a running daemon, and all that it says of itself."""

from __future__ import annotations

from typing import Any

import typer

from tactomo.cli import options
from tactomo.cli.output import print_json
from tactomo.cli.sensors import newest_status, of_this_version
from tactomo.plain import counted, plain

app = options.typer_app()


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
    for line in lines_of(_plain(answer)):
        typer.echo(line)


def lines_of(status: dict[str, Any]) -> list[str]:
    """Return what is printed of a status.

    Raises TactomoError where another program, or another version, made it of other types.
    """
    lines = []
    with of_this_version():
        for issue in status.get("issues") or []:
            colour = "red" if issue["severity"] == "error" else "yellow"
            lines += [typer.style(issue["what"], fg=colour, bold=True), f"    {issue['next_step']}"]
        lines.append(f"{status['sensor']}: {_words(status['state'])}")
        rows = _rows(status)
    return lines + [f"{typer.style(f'{name:<13} ', bold=True)}{value}" for name, value in rows]


def _plain(told: Any) -> Any:
    """Return what was told with no text in it that a terminal would obey."""
    if isinstance(told, dict):
        return {plain(key): _plain(value) for key, value in told.items()}
    if isinstance(told, list | tuple):
        return [_plain(value) for value in told]
    return plain(told) if isinstance(told, str) else told


def _rows(status: dict[str, Any]) -> list[tuple[str, str]]:
    from tactomo_client.appearance import companion_words

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
            + ", ".join(
                f"{channel} {_number(rates.get(f'{channel}_hz'))}"
                for channel in description.get("modalities", [])
            ),
        ),
        ("latency", _percentiles(latency)),
        *(
            (f"  {stage}", _percentiles(times))
            for stage, times in (status.get("stage_ms") or {}).items()
        ),
        (
            "method",
            f"{status.get('tier_requested')}; the newest frame by {status.get('tier') or '-'}",
        ),
        ("  methods", ", ".join(status.get("methods") or []) or "-"),
        ("budget", _budget(status.get("budget_ms"), status.get("plan") or {})),
        ("flags", "; ".join(map(_flag, status.get("flags", []))) or "none"),
        ("misfit", _misfit(status.get("misfit"))),
        (
            "lost",
            f"{counted(status.get('dropped_scans', 0), 'dual scan')} dropped and "
            f"{status.get('incomplete_scans', 0)} incomplete since the start, "
            f"{counted(status.get('frames', 0), 'frame')} made",
        ),
        ("reference", counted(reference["scans"], "dual scan") if reference else "none yet"),
        ("baseline", _baseline(status.get("baseline") or {})),
        *(
            ("companion", f"{name} {companion_words(each)}")
            for name, each in (status.get("companions") or {}).items()
        ),
        ("recording", f"{recording['path']} ({_mb(recording['bytes'])})" if recording else "off"),
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
    state, refusal = str(baseline.get("state") or "-"), baseline.get("refusal")
    gone = [
        f"{channel} drifted by {drift['gain']:+.2%}, unevenly by {drift['uneven']:.2%}"
        for channel, drift in (baseline.get("drift") or {}).items()
    ]
    return "; ".join([f"{_warn(state)}: {refusal}" if refusal else state, *gone])


def _events(events: dict[str, Any]) -> str:
    from tactomo.events import times

    counts = events.get("counts") or {}
    told = (f"{_words(name)} {times(count)}" for name, count in sorted(counts.items()))
    return ", ".join(told) or "none"


def _trouble(trouble: dict[str, Any]) -> str:
    age_s = trouble.get("age_s") or 0.0
    ago = f"{age_s:.0f} s" if age_s < 120 else f"{age_s / 60:.0f} min"
    return f"{_warn(_words(trouble.get('name')))}, {ago} ago: {trouble.get('detail')}"


def _process(process: dict[str, Any], uptime_s: float) -> str:
    share = 1e2 * (process.get("cpu_s") or 0.0) / max(uptime_s, 1.0)
    return (
        f"pid {process.get('pid', '-')}, {share:.1f} % of a core on average, "
        f"{_mb(process.get('memory_bytes'))}, {process.get('threads', '-')} threads"
    )


def _mb(size_bytes: float | None) -> str:
    return "-" if size_bytes is None else f"{size_bytes / 1e6:.1f} MB"


def _port_line(port: dict[str, Any]) -> str:
    device = port.get("device") or {}
    return (
        f"{port.get('url')} ({port.get('state', '-')}), "
        f"{device.get('device_id', 'no device has answered yet')}, "
        f"{', '.join(device.get('channels', [])) or '-'}; {port.get('packets', 0)} packets, "
        f"{port.get('corrupt', 0)} corrupt"
    )


def _budget(budget_ms: float | None, plan: dict[str, Any]) -> str:
    """Say how much work a frame may take."""
    share = plan.get("share", 1.0)
    left = f", {share:.0%} of it while other programs use the processor" if share < 1 else ""
    return ("the method's own" if budget_ms is None else f"{budget_ms:g} ms of work") + left


def _percentiles(times: dict[str, Any]) -> str:
    return f"p50 {_number(times.get('p50'))} ms, p99 {_number(times.get('p99'))} ms"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _misfit(misfit: float | None) -> str:
    if misfit is None:
        return "unknown: no map yet"
    return f"{misfit:.2f} times the noise (about 1: the map explains the voltages)"


def _flag(name: str) -> str:
    from tactomo.service.health_issues import FLAG_ADVICE

    return f"{name}: {FLAG_ADVICE[name][0]}" if name in FLAG_ADVICE else name


def _words(name: object) -> str:
    return str(name).replace("_", " ")


def _warn(text: object) -> str:
    return typer.style(str(text), fg="yellow")

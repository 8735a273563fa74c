"""`tactomo doctor`: whether a skin and its device are well, and what to do about what is not."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tactomo.cli import options
from tactomo.cli.output import print_json, say
from tactomo.cli.sensors import find_sensor
from tactomo.errors import TactomoError
from tactomo.plain import plain

if TYPE_CHECKING:
    from tactomo_models.health.diagnosis import Diagnosis
    from tactomo_models.health.findings import Finding, Level

    from tactomo.cli.doctor.evidence import Evidence

# Of each level: colour and mark of a line, verdict in a word, and what follows the verdict.
LEVELS = {
    "ok": ("green", "", "healthy", ""),
    "unknown": (None, "? ", "unknown", ": too little is known"),
    "advice": ("yellow", "! ", "healthy", ", with some advice"),
    "fault": ("red", "✗ ", "ill", ": follow the next steps of the lines marked ✗"),
    "broken": ("red", "✗ ", "broken", ": no reading of this device can be trusted"),
}

app = options.typer_app()


@app.command(
    epilog=options.examples(
        "tactomo doctor",
        "tactomo doctor -s left_forearm --seconds 30",
        "tactomo doctor grasp.mcap --frames 0:100",
        "tactomo doctor tank.npz -d tank_disc",
        "tactomo doctor new_device.npz --array baseline --json",
    )
)
def doctor(
    what: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FILE]",
            help="A recording (.mcap) or scans (.npz, .mat, text); without, a daemon that runs.",
        ),
    ] = None,
    sensor: options.Sensor = None,
    address: options.Address = None,
    seconds: Annotated[
        float, typer.Option(min=1.0, max=3600.0, help="Seconds of listening to the daemon.")
    ] = 10.0,
    description: Annotated[
        str | None,
        options.description_option(
            " [the daemon's, the recording's; of other files the pattern alone]"
        ),
    ] = None,
    frames: Annotated[
        str | None,
        typer.Option(metavar="FIRST:END", help="Scans at rest of a file. [the stillest]"),
    ] = None,
    array: Annotated[
        str | None, typer.Option(help="Array of an .npz file with scans at rest.")
    ] = None,
    pattern: Annotated[
        str | None,
        typer.Option(help="Pattern of a file's voltages: 16:adjacent. [the one that fits]"),
    ] = None,
    as_json: options.JsonOutput = False,
    keys: options.KeysFolder = None,
) -> None:
    """Examine a skin at rest: noise, reciprocity, electrodes, clipping, drift and line.

    `tactomo status` has the latency. **Nothing may touch the skin meanwhile.** Exit status 0:
    healthy (maybe with advice). 1: ill (something needs repair), broken (no reading can be
    trusted), or unknown.

    *SNR* is the ratio of the voltages to their standard deviation: 60 dB is good, below 36 dB is
    ill, below 20 dB broken. *Reciprocity*: on any sheet, V(drive; measure) = V(measure; drive), so
    the device causes any difference. A difference of up to 5 % over all voltages is usual; above 20
    %, nothing can be located. Electrodes count from 0: *dead* (reads nothing), *loose* (noisier
    than the others, or jumps), *misread* (breaks a law of any sheet: an open or shorted lead),
    *swapped* (two leads changed places; needs a description).

    `tactomo doctor` reads files as `tactomo reconstruct` does. `--array` names scans at rest, (T,
    voltages); without it, an array called reference, baseline, rest, empty or vh is taken. Without
    a description, `--pattern` gives the order of the voltages, or the command takes the pattern
    that fits the zeros or the reciprocity. The report says how the file was read.
    """
    chosen = options.frame_slice(frames)
    if what is not None and what.suffix.lower() == ".mcap":
        options.need_recording(what)
    from tactomo_client.keys import as_keys
    from tactomo_models.health.findings import worst

    from tactomo.cli.console import Console
    from tactomo.cli.doctor.evidence import of_daemon, stream_findings

    with Console(stderr=True).status("examining") as line_shown:
        if what is None:
            if chosen is not None or array is not None:
                raise typer.BadParameter("--frames and --array go with a file")
            found = find_sensor(sensor, address, keys)
            words = "listening to the daemon, {:.0f} of {:g} s: leave the skin alone"
            evidence = of_daemon(
                *(found.sensor, found.stream, seconds, description, as_keys(keys)),
                lambda passed_s: line_shown.update(words.format(passed_s, seconds)),
            )
        else:
            evidence = _of_file(what, description, chosen, array, pattern)
        channels = _diagnose(evidence)
    line = stream_findings(evidence)
    levels = [diagnosis.level for diagnosis in channels.values()]
    levels += [finding.level for finding in line if finding.level != "unknown"]
    verdict = worst(iter(levels))
    if as_json:
        print_json(report(evidence, channels, line, verdict))
    else:
        _print(evidence, channels, line, verdict)
    raise typer.Exit(0 if LEVELS[verdict][2] == "healthy" else 1)


def _of_file(
    what: Path,
    description: str | None,
    frames: slice | None,
    array: str | None,
    pattern: str | None,
) -> Evidence:
    from tactomo_models.array_files import READERS

    from tactomo.cli.doctor.evidence import of_arrays, of_recording

    suffix = what.suffix.lower()
    if suffix == ".mcap":
        from tactomo.cli.run.daemon import warn_of_damage
        from tactomo.recordings.recording import open_recording

        recording = open_recording(what)
        warn_of_damage(recording)
        return of_recording(recording, description, frames)
    scans = (".npz", *READERS)
    if suffix in scans:
        return of_arrays(what, description, array, pattern, frames)
    step = f"give a recording (.mcap), scans ({', '.join(scans)}), or no file"
    raise TactomoError(f"{what} is of no kind that is read", step)


def _diagnose(evidence: Evidence) -> dict[str, Diagnosis]:
    from tactomo_models import SensorDescription, load_or_build_artifact
    from tactomo_models.health.diagnosis import diagnose

    layout = evidence.layout
    known = layout if isinstance(layout, SensorDescription) else None
    even = None if known is None else load_or_build_artifact(known).bare
    found = {}
    for name, scans in evidence.scans.items():
        has_channel = known is not None and name in known.channels
        found[name] = diagnose(
            layout,
            scans.volts,
            times_s=scans.times_s,
            even=even,
            saturated=scans.saturated,
            **({"contrast": known.contrast(name)} if has_channel else {}),  # type: ignore[arg-type, union-attr]
        )
    return found


def report(
    evidence: Evidence, channels: dict[str, Diagnosis], line: list[Finding], verdict: Level
) -> dict[str, Any]:
    """Return all that was found, for programs."""
    return {
        "examined": evidence.title,
        "notes": list(evidence.notes),
        "verdict": LEVELS[verdict][2],
        "channels": {
            name: {
                "verdict": LEVELS[diagnosis.level][2],
                "electrodes": list(diagnosis.electrodes),
                "findings": [_plain(finding) for finding in diagnosis.findings],
                "snr_db": diagnosis.snr_db.round(2).tolist(),
            }
            for name, diagnosis in channels.items()
        },
        "stream": [_plain(finding) for finding in line],
    }


def _plain(finding: Finding) -> dict[str, Any]:
    return {
        "about": finding.about,
        "level": str(finding.level),
        "detail": finding.detail,
        "next_step": finding.next_step,
        **finding.figures,
    }


def _print(
    evidence: Evidence, channels: dict[str, Diagnosis], line: list[Finding], verdict: Level
) -> None:
    """Print lines that the terminal alone breaks: a command in one can be copied."""
    say(evidence.title)
    for note in evidence.notes:
        say(note)
    for name, diagnosis in channels.items():
        _print_findings(name, diagnosis.findings)
    if line:
        _print_findings("stream", line)
    colour, _, word, more = LEVELS[verdict]
    typer.secho(f"\n{word}", fg=colour, bold=True, nl=False)
    say(more)


def _print_findings(title: str, findings: Sequence[Finding]) -> None:
    say(f"\n{title}")
    for finding in findings:
        colour, mark, _, _ = LEVELS[finding.level]
        about = f"{mark}{finding.about.replace('_', ' ')}: {finding.detail}"
        typer.secho(f"  {plain(about)}", fg=colour)
        if finding.next_step:
            say(f"      {finding.next_step}")

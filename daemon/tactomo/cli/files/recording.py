"""`tactomo info`, `recover` and `import`: a file described, mended, and made of scans."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tactomo.cli.options import (
    DEFAULT_DESCRIPTION,
    DEFAULT_NAME,
    Description,
    GivenChannel,
    JsonOutput,
    NewName,
    RecordingFile,
    ReferenceFrames,
    examples,
    frame_slice,
    need_recording,
    typer_app,
)
from tactomo.cli.output import print_json, progress_bar, say

if TYPE_CHECKING:
    from tactomo_models import SensorDescription

    from tactomo.recordings.recording import Recording, Summary
    from tactomo.recordings.recovery import Recovery

app = typer_app()


@app.command(
    epilog=examples(
        "tactomo info grasp.mcap",
        "tactomo info paper_square",
        "tactomo info my.toml",
    )
)
def info(
    what: Annotated[
        str,
        typer.Argument(
            help="A recording (.mcap), a file that `tactomo reconstruct` reads (.npz, .mat, .csv, "
            ".eit), a built artifact, or a sensor description: a shipped name or a TOML file."
        ),
    ],
    as_json: JsonOutput = False,
) -> None:
    """Describe a recording, a file of scans or a sensor description."""
    facts = _facts(what)
    if as_json:
        print_json(facts)
        return
    from rich.table import Table
    from rich.text import Text

    from tactomo.cli.console import Console

    shown = Table(title=what, show_header=False)
    for name, value in facts.items():
        shown.add_row(Text(name, "bold"), _words(value))
    Console().print(shown)


def _date(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns * 1e-9).isoformat(" ", "seconds") if time_ns else ""


def _facts(what: str) -> dict[str, Any]:
    suffix = Path(what).suffix.lower()
    if suffix == ".mcap":
        need_recording(Path(what))
        from tactomo.recordings.recording import open_recording

        return _recording_facts(open_recording(what))
    from tactomo_models import load_description
    from tactomo_models.array_files import READERS

    if suffix in (".npz", ".eit", *READERS) or Path(what).is_dir():
        return _array_facts(Path(what))
    return _description_facts(load_description(what))


def _recording_facts(recording: Recording) -> dict[str, Any]:
    summary = recording.summary
    facts: dict[str, Any] = {
        "sensor": summary.origin.sensor,
        "description": summary.origin.description,
        "began": _date(summary.start_ns),
        "seconds": round(summary.duration_s, 3),
        "bytes": summary.file_bytes,
        "complete": summary.is_complete,
        "ports": {
            url: f"{summary.port_bytes.get(number, 0)} bytes"
            for number, url in enumerate(summary.origin.ports)
        },
        "scans": dict(summary.scans.items()),
        "devices": [f"{hello.device_id}, {hello.firmware}" for hello in summary.hellos],
        "corrupt packets": summary.corrupt,
        "faulty packets": summary.faulty,
        "reconstructed frames": summary.frames,
        "references": summary.references,
        "recorded by": f"tactomo {summary.origin.version}",
    }
    if summary.ending:
        facts["ends"] = summary.ending
    if summary.recovered_gaps is not None:
        facts["recovered, parts missing"] = summary.recovered_gaps
    return facts


def _array_facts(path: Path) -> dict[str, Any]:
    """Describe a built artifact, or any other file of arrays, by what is in it."""
    from tactomo.recordings.imported_scans import load_arrays

    arrays = load_arrays(path)
    facts = {name: array.item() for name, array in arrays.items() if array.ndim == 0}
    kind = "artifact" if {"sha256", "sensor", "jacobian"} <= arrays.keys() else "arrays"
    shapes = {
        name: f"{array.dtype} {array.shape}" for name, array in arrays.items() if array.ndim > 0
    }
    return {"kind": kind, "bytes": path.stat().st_size, **facts, "arrays": shapes}


def _mount_in_words(description: SensorDescription) -> str:
    mount = description.mount
    assert mount is not None
    words = f"{mount.kind} on {mount.frame}"
    if description.stretching is None:
        return words
    lengths = description.stretching.stretches
    return f"{words}, {lengths.min():.2f} to {lengths.max():.2f} times the sheet's lengths"


def _description_facts(description: SensorDescription) -> dict[str, Any]:
    from tactomo_protocol import MAX_SAMPLES

    width_mm, height_mm = description.width_m * 1e3, description.height_m * 1e3
    magnitude, count = description.magnitude, description.measurements
    return {
        "name": description.name,
        **({"title": description.title} if description.title else {}),
        "sheet": f"{description.sheet.shape}, {width_mm:g} x {height_mm:g} mm",
        "electrodes": description.electrode_count,
        **({"mount": _mount_in_words(description)} if description.mount else {}),
        **({"companions": ", ".join(description.companion)} if description.companion else {}),
        "voltages a scan": count
        if count <= MAX_SAMPLES
        else f"{count}: of files alone, as a live scan has {MAX_SAMPLES} at most",
        "pattern": str(description.pattern),
        "instrument": f"{description.instrument.voltages} voltages",
        "channels": ", ".join(description.channels),
        "map": f"{description.map.nodes_x} x {description.map.nodes_y} nodes",
        "answers to": "no pressure calibration"
        if magnitude is None
        else f"{magnitude.response.pressure_kpa[-1]:g} kPa at most",
        "sha256 of its physics": description.sha256,
    }


def _words(value: Any) -> str:
    if isinstance(value, dict):
        return "\n".join(f"{name}: {each}" for name, each in value.items()) or "none"
    if isinstance(value, list):
        return "\n".join(str(each) for each in value) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value)


@app.command(
    epilog=examples("tactomo recover grasp.mcap", "tactomo recover grasp.mcap -o whole.mcap")
)
def recover(
    recording: RecordingFile,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", dir_okay=False, help="The new file. [FILE-recovered.mcap beside it]"
        ),
    ] = None,
) -> None:
    """Rewrite a cut or damaged recording with an index, so that any MCAP tool opens it.

    Keeps every part that a checksum confirms, also beyond damage in the middle, and lists the
    losses. The damaged file stays unchanged. A replay of the new file gives the maps of the live
    run. After a gap, the replay starts cold; where the reference is lost, there are no maps.
    """
    need_recording(recording)
    from tactomo.recordings.recording import open_recording
    from tactomo.recordings.recovery import recover as rewrite

    target = output or recording.parent / f"{recording.stem}-recovered.mcap"
    with progress_bar("recovering") as show:
        recovery = rewrite(recording, target, show)
    say(f"{target}: {_kept(open_recording(target).summary)}")
    for line in _lost(recovery):
        say(line)


def _kept(summary: Summary) -> str:
    scans = ", ".join(f"{count} {c}" for c, count in summary.scans.items())
    return f"kept {summary.duration_s:.1f} s, {scans or 'no'} scans, {summary.frames} frames"


def _lost(recovery: Recovery) -> list[str]:
    if recovery.is_intact:
        return ["lost: nothing"]
    lines = [f"lost: {recovery.lost_bytes} bytes"]
    for gap in recovery.gaps:
        scans = ", ".join(f"{n} {channel}" for channel, n in gap.scans.items())
        lines.append(f"  a gap of {gap.seconds:.2f} s: {scans or 'an unknown number of'} scans")
    if recovery.frames_lost:
        lines.append(f"  {recovery.frames_lost} frames whose reference or whose scans are lost")
    if recovery.is_cut:
        lines.append("  the end, however much that was: it is cut off or damaged")
    if not recovery.knows_origin:
        lines.append("  the beginning: replay it with --sensor and --description")
    return lines


@app.command(
    "import",
    epilog=examples(
        "tactomo import tank.npz tank.mcap -d tank_disc --reference-frames 0:20",
        "tactomo import presses.npz presses.mcap --rate 20",
        "tactomo import setup_00001/ tank.mcap -d sciospec_disc --reference-frames 0:20",
    ),
)
def import_scans(
    scans: Annotated[
        list[Path],
        typer.Argument(
            metavar="IN",
            help="A file such as .npz, .mat, .csv; or .eit files, or a folder of them.",
        ),
    ],
    recording: Annotated[Path, typer.Argument(metavar="OUT.mcap", help="The recording to write.")],
    description: Description = DEFAULT_DESCRIPTION,
    channel: GivenChannel = None,
    reference_frames: ReferenceFrames = None,
    rate: Annotated[
        float | None, typer.Option(min=0.01, help="Scans a second. [the file's own times, t]")
    ] = None,
    sensor: NewName = DEFAULT_NAME,
) -> None:
    """Turn measured scans (.npz, .eit) into a recording that replays through the daemon.

    Reads the layouts of `tactomo reconstruct` (magnitude, structure and their references; frames of
    one channel in a .mat or text), single-ended readings of EIT instruments, and Sciospec's .eit
    files. Single-ended readings are `volts` (T, injections, electrodes) with `injection`
    (injections, 2) and `t`. Their differences of neighbouring electrodes become the voltages, in
    the description's order; of complex volts, the part in phase with the current counts. Sciospec's
    program saves one .eit file per frame; the files are read in the order of their dates. Readings
    of companions (`companion_NAME`) are kept.
    """
    from tactomo_models import load_description
    from tactomo_models.sensor.description_file import carried_text
    from tactomo_protocol import Channel

    from tactomo.cli.console import progress
    from tactomo.recordings.imported_scans import read_scans
    from tactomo.recordings.recording_writer import write_recording

    reference = frame_slice(reference_frames)
    measured, path = load_description(description), Path(description)
    known = None if channel is None else Channel(channel)
    read = read_scans(scans, measured, known)
    times_s = read.times(rate)
    mean_rate_hz = (len(times_s) - 1) / times_s[-1] if times_s[-1] > 0 else 0.0
    total = read.count * len(read.volts)
    with progress() as bar:
        length = write_recording(
            recording,
            read.hello(measured, float(mean_rate_hz)),
            bar.track(read.packets(times_s, measured), total, description="importing"),
            sensor=sensor,
            # a shipped one's name, or a path that holds wherever the recording goes
            description=str(path.absolute()) if path.exists() else description,
            description_sha256=measured.sha256,
            description_text=carried_text(measured, description),
            reference=read.reference_of(reference),
        )
    for note in read.notes:
        say(note)
    say(
        f"{recording}: {read.count} scans in {times_s[-1]:.1f} s "
        f"({mean_rate_hz:.1f}/s), {length / 1e6:.2f} MB"
    )

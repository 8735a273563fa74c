"""`tactomo info`, `import` and `reconstruct`: what can be done with files alone."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from tactomo.cli.app import DEFAULT_DESCRIPTION, FILES, JsonOutput, Method, app, examples

if TYPE_CHECKING:
    from tactomo_models import SensorDescription

    from tactomo.recording import Recording

DescriptionOption = Annotated[
    str,
    typer.Option(
        "--sensor",
        "--description",
        "-d",
        help="What the sensor is made of: a shipped name or a TOML file.",
    ),
]


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        "tactomo info grasp.mcap",
        "tactomo info ~/.local/share/tactomo/recordings",
        "tactomo info paper_square",
        "tactomo info my.toml",
    ),
)
def info(
    what: Annotated[
        str,
        typer.Argument(
            help="A recording (.mcap), a folder of them, a built artifact (.npz), or a sensor "
            "description: a shipped name or a TOML file."
        ),
    ],
    as_json: JsonOutput = False,
) -> None:
    """Describe a recording, a folder of recordings, a built artifact or a sensor description."""
    if Path(what).is_dir():
        _show_folder(Path(what), as_json)
        return
    facts = _facts(what)
    if as_json:
        typer.echo(json.dumps(facts, indent=2))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(title=what, show_header=False)
    for name, value in facts.items():
        table.add_row(f"[bold]{name}[/]", _words(value))
    Console().print(table)


def _show_folder(folder: Path, as_json: bool) -> None:
    """List the recordings in a folder by their names, which is by their age.

    One that is not closed is being written, or was cut off, or is damaged.
    """
    rows = [_recording_line(path) for path in sorted(folder.glob("*.mcap"))]
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(title=str(folder))
    for name in ("recording", "sensor", "began", "seconds", "MB", "ends"):
        justify: Literal["right", "left"] = "right" if name in ("seconds", "MB") else "left"
        table.add_column(name, justify=justify, no_wrap=name != "recording", overflow="fold")
    for row in rows:
        table.add_row(*(str(value) for value in row.values()))
    Console().print(table)


def _recording_line(path: Path) -> dict[str, Any]:
    from tactomo.errors import RecordingError
    from tactomo.recording import open_recording

    line = {"recording": path.name, "sensor": "", "began": "", "seconds": 0.0}
    line["MB"] = round(path.lstat().st_size / 1e6, 2)
    try:
        recording = open_recording(path)
    except RecordingError:
        return {**line, "ends": "no recording"}
    span = recording.span
    return {
        **line,
        "sensor": recording.origin.sensor,
        "began": _date(span.start_ns),
        "seconds": round((span.end_ns - span.start_ns) * 1e-9, 1),
        "ends": "closed" if span.is_complete else "not closed",
    }


def _date(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns * 1e-9).isoformat(" ", "seconds") if time_ns else ""


def _facts(what: str) -> dict[str, Any]:
    suffix = Path(what).suffix.lower()
    if suffix == ".mcap":
        from tactomo.recording import open_recording

        return _recording_facts(open_recording(what))
    if suffix == ".npz":
        return _array_facts(Path(what))
    from tactomo_models import load_description

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
        "scans": {channel.name.lower(): count for channel, count in summary.scans.items()},
        "devices": [f"{hello.device_id}, {hello.firmware}" for hello in summary.hellos],
        "corrupt packets": summary.corrupt,
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
    from tactomo.imported import load_arrays

    arrays = load_arrays(path)
    facts = {name: array.item() for name, array in arrays.items() if array.ndim == 0}
    kind = "artifact" if {"sha256", "sensor", "jacobian"} <= arrays.keys() else "arrays"
    shapes = {
        name: f"{array.dtype} {array.shape}" for name, array in arrays.items() if array.ndim > 0
    }
    return {"kind": kind, "bytes": path.stat().st_size, **facts, "arrays": shapes}


def _description_facts(description: SensorDescription) -> dict[str, Any]:
    sheet = description.sheet
    magnitude = description.magnitude
    return {
        "name": description.name,
        "title": description.title,
        "sheet": f"{sheet.shape}, {sheet.width_m * 1e3:g} x {description.height_m * 1e3:g} mm",
        "electrodes": description.electrode_count,
        "voltages a scan": description.measurements,
        "pattern": str(description.pattern),
        "instrument": f"{description.instrument.voltages} voltages",
        "channels": ", ".join(description.modalities),
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
    "import",
    rich_help_panel=FILES,
    epilog=examples(
        "tactomo import tank.npz tank.mcap --sensor tank_disc --reference-frames 0:20",
        "tactomo import presses.npz presses.mcap --rate 20",
        "tactomo import setup_00001/ tank.mcap --sensor sciospec_disc --reference-frames 0:20",
    ),
)
def import_scans(
    scans: Annotated[
        list[Path],
        typer.Argument(metavar="IN", help="An .npz file; .eit files, or a folder of them."),
    ],
    recording: Annotated[Path, typer.Argument(metavar="OUT.mcap", help="The recording to write.")],
    sensor: DescriptionOption = DEFAULT_DESCRIPTION,
    channel: Annotated[
        Literal["magnitude", "structure"] | None,
        typer.Option(help="Which channel single-ended volts are. [the sensor's only one]"),
    ] = None,
    reference_frames: Annotated[
        str | None,
        typer.Option(metavar="FIRST:END", help="Unloaded frames to be the reference, from 0."),
    ] = None,
    rate: Annotated[
        float | None, typer.Option(min=0.01, help="Scans a second. [the file's own times, t]")
    ] = None,
    name: Annotated[str, typer.Option("--name", help="The sensor's name in the stream.")] = "skin",
) -> None:
    """Turn measured scans (.npz, .eit) into a recording that replays through the daemon.

    Reads the layout of `tactomo reconstruct` (magnitude, structure and their references), and
    single-ended readings as EIT instruments save them: `volts` (T, injections, electrodes) with
    `injection` (injections, 2) and `t`. Those become differences of neighbouring electrodes in the
    description's order; of complex volts the real part counts. So do the .eit files that Sciospec's
    own program saves, one a frame, in the order of their dates.
    """
    from rich.progress import track
    from tactomo_models import load_description
    from tactomo_protocol import Channel

    from tactomo.imported import read_scans
    from tactomo.recording_writer import write_recording

    reference = frame_slice(reference_frames)
    description = load_description(sensor)
    known = None if channel is None else Channel[channel.upper()]
    read = read_scans(scans, description, known)
    times_s = read.times(rate)
    mean_rate_hz = (len(times_s) - 1) / times_s[-1] if times_s[-1] > 0 else 0.0
    total = read.count * len(read.volts)
    length = write_recording(
        recording,
        read.hello(description, float(mean_rate_hz)),
        track(read.packets(times_s), "importing", total, transient=True),
        sensor=name,
        description=_portable(sensor),
        description_sha256=description.sha256,
        reference=read.reference_of(reference),
    )
    for note in read.notes:
        typer.echo(note)
    typer.echo(
        f"{recording}: {read.count} scans in {times_s[-1]:.1f} s "
        f"({mean_rate_hz:.1f}/s), {length / 1e6:.2f} MB"
    )


def _portable(description: str) -> str:
    """Return a description's name as it is, and its path made absolute."""
    path = Path(description)
    return str(path.absolute()) if path.exists() else description


def frame_slice(text: str | None) -> slice | None:
    """Return the slice that "0:20" means."""
    if text is None:
        return None
    first, colon, end = text.partition(":")
    try:
        if not colon:
            raise ValueError
        frames = slice(int(first or 0), int(end) if end else None)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not FIRST:END, such as 0:20") from None
    return frames


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        "tactomo reconstruct scans.npz maps.npz",
        "tactomo reconstruct scans.npz maps.npz --method tikhonov --sensor my_skin.toml",
    ),
)
def reconstruct(
    scans: Annotated[Path, typer.Argument(metavar="IN.npz", help="Scans and references.")],
    maps: Annotated[Path, typer.Argument(metavar="OUT.npz", help="The file to write.")],
    method: Annotated[
        Method, typer.Option(help="One for every frame, or auto: what each frame needs.")
    ] = "auto",
    sensor: DescriptionOption = DEFAULT_DESCRIPTION,
    calibration: Annotated[
        Path | None,
        typer.Option(help="Of pressure, by `tactomo calibrate`. [the description's response]"),
    ] = None,
) -> None:
    """Reconstruct a file of scans, without a daemon.

    IN holds `magnitude` and `structure` (T, M) volts and `magnitude_reference`,
    `structure_reference` (M,); structure may be missing. OUT gets `map` (T, ny, nx), the relative
    conductivity change; `structure` (T, ny, nx) from 0 to 1; `misfit`, `confidence` (the
    correlation with the truth that the network expects, where one was asked), `flags` and
    `seconds` (T,); and the contacts as flat arrays `contact_frame`, `contact_x_mm`, `contact_y_mm`,
    `contact_area_mm2`, `contact_magnitude`, `contact_sigma` (of the magnitude), and the standard
    uncertainties `contact_x_sigma_mm`, `contact_y_sigma_mm`, `contact_area_sigma_mm2`; and how hard
    is pressed, `contact_pressure_kpa`, `contact_force_n`, their uncertainties
    `contact_pressure_sigma_kpa`, `contact_force_sigma_n`, and `contact_pressure_range` (*within*,
    *below*, *above* or *unknown*). Where the sensor's objects conduct `either_way`, such as metal
    and plastic in a tank, `structure` is -1 in those that conduct worse.

    Frames follow one another, as in a stream: each one starts from what the last one found. Give
    scenes that have nothing to do with each other in files of their own.

    `misfit` is what the model left unexplained, in units of the scans' noise: about 1 is good, and
    above 2 (1.5 over both channels, for *hybrid*) the frame is flagged.

    `flags` adds up what stands in the way of trusting a frame: 1 structure missing, 2 magnitude
    missing, 4 invalid voltage, 8 no reference, 16 misfit high, 32 not converged, 64 reference
    mismatch, 128 electrode fault, 256 noise high, 512 channels swapped, 1024 saturated,
    2048 low confidence, 4096 channels skewed (live only).

    Methods: *tikhonov* and *noser* are one linear step, regularised so that the image is as noisy,
    relative to its signal, as the scans are (noise figure 1); *pls-paper* is the level set of the
    paper that tactomo is compared with, linear and cold; *fit* models a few outlines, *levelset*
    shapes of any form, both nonlinear and down to the scans' noise; *network* is our fusion network
    alone; in *hybrid* it proposes, outlines are fitted to the scans, and a second network redraws
    what they show; *cnn-single* and *cnn-multimodal* are the paper's networks. *auto* takes what a
    frame needs: *hybrid* where the sensor has its networks, else *fit* or *levelset*.
    """
    from rich.progress import Progress
    from tactomo_models import load_description
    from tactomo_models.batch import reconstruct_file
    from tactomo_models.calibration_file import calibration_of

    description = load_description(sensor)
    curve = None if calibration is None else calibration_of(description, calibration).curve
    with Progress(transient=True) as progress:
        task = progress.add_task("reconstructing", total=None)

        def show(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        frames = reconstruct_file(
            scans, maps, description=description, method=method, progress=show, curve=curve
        )
    typer.echo(f"wrote {maps}: {frames} frames")

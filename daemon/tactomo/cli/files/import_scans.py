"""`tactomo import`: measured scans as a recording that replays through the daemon."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tactomo.cli import options
from tactomo.cli.output import say

app = options.typer_app()


@app.command(
    "import",
    epilog=options.examples(
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
    description: options.Description = options.DEFAULT_DESCRIPTION,
    channel: options.GivenChannel = None,
    reference_frames: options.ReferenceFrames = None,
    rate: Annotated[
        float | None, typer.Option(min=0.01, help="Scans a second. [the file's own times, t]")
    ] = None,
    sensor: options.NewName = options.DEFAULT_NAME,
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

    reference = options.frame_slice(reference_frames)
    measured = load_description(description)
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
            description=_portable(description),
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


def _portable(description: str) -> str:
    """Return a description's name as it is, and its path made absolute."""
    path = Path(description)
    return str(path.absolute()) if path.exists() else description

"""`tactomo reconstruct`: a file of scans to a file of maps, without a daemon."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from tactomo.cli.options import (
    DEFAULT_DESCRIPTION,
    Description,
    Force,
    GivenChannel,
    ReferenceFrames,
    examples,
    frame_slice,
    methods_option,
    typer_app,
)
from tactomo.cli.output import progress_bar, say
from tactomo.cli.plot.plot import picture_option, prepare_file, save_figure
from tactomo.plain import counted

app = typer_app()


@app.command(
    epilog=examples(
        "tactomo reconstruct scans.npz maps.npz",
        "tactomo reconstruct scans.npz maps.npz --method tikhonov -d my_skin.toml",
        "tactomo reconstruct scans.npz maps.npz --method fit,noser --picture maps.png",
        "tactomo reconstruct tank.mat maps.npz -d tank_disc --reference-frames 0:20",
        "tactomo reconstruct a.csv a.npz -d tank_disc --reference b.csv --pattern 32:1",
    ),
)
def reconstruct(
    scans: Annotated[
        Path, typer.Argument(metavar="IN", help="Scans: .npz, .mat, .csv, .txt, .eit.")
    ],
    maps: Annotated[Path, typer.Argument(metavar="OUT.npz", help="The file to write.")],
    method: Annotated[list[str] | None, methods_option(" [auto]")] = None,
    description: Description = DEFAULT_DESCRIPTION,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="Pressure calibration, from `tactomo calibrate`. [the description's response]"
        ),
    ] = None,
    taught: Annotated[
        Path | None,
        typer.Option(help="Model of `tactomo teach`: corrects places of single contacts."),
    ] = None,
    rest: Annotated[
        Path | None, typer.Option("--reference", help="File of scans of the unpressed sensor.")
    ] = None,
    reference_frames: ReferenceFrames = None,
    pattern: Annotated[
        str | None,
        typer.Option(help="Pattern of IN's voltages, see above. [the description's pattern]"),
    ] = None,
    array: Annotated[
        str | None, typer.Option(help="Name of the array of scans in IN. [the one that fits]")
    ] = None,
    channel: GivenChannel = None,
    picture: Annotated[
        Path | None, picture_option("Draw the frames that tell most, a row for each method")
    ] = None,
    force: Force = False,
) -> None:
    """Reconstruct a file of scans, without a daemon.

    OUT may be an earlier result of this command; other files are overwritten only with `--force`.

    IN holds `magnitude` and `structure` (T, M) in volts, and `magnitude_reference`,
    `structure_reference` (M,), or (n, M) scans at rest; structure may be missing. `companion_NAME`
    (T,) holds readings of a companion of the description, `companion_NAME_reference` those at rest.
    IN may also be a file that `tactomo import` reads, or hold frames of one channel, a frame per
    row or column: an array of a .mat (up to version 7), or numbers in text (.csv, .txt). The
    reference is then an array called reference, baseline, rest, empty or vh, `--reference-frames`
    of IN, or the mean of the file `--reference`. `--pattern 32:adjacent`, `16:opposite:adjacent` or
    `16:adjacent:rotated` replaces the description's electrodes and pattern.

    OUT holds, for T frames: `map` (relative conductivity change), `pressure_kpa` and `structure` (0
    bare to 1 pressed), each (T, ny, nx) with NaN where unknown; `misfit` (about 1 is good),
    `confidence`, `force_n`, `flags` and `seconds` (T,); and the contacts of all frames as flat
    arrays: `contact_frame`, `contact_x_mm`, `contact_pressure_kpa` and so on. docs/files.md
    explains each array.

    Frames form a sequence, as in a stream: each solve starts from the result of the frame before.
    Put unrelated scenes into files of their own.

    `flags` is the sum of the reasons to distrust a frame: 1 structure missing, 2 magnitude missing,
    4 invalid voltage, 8 no reference, 16 misfit high, 32 not converged, 64 reference mismatch, 128
    electrode fault, 256 noise high, 512 channels swapped, 1024 saturated, 2048 low confidence, 4096
    channels skewed and 16384 reference disputed (live only), 8192 no usable scan, 32768 untaught,
    65536 creeping (live only), 131072 companion missing, 262144 companion disputed.

    Methods: *tikhonov* and *noser* take one linear step, regularised so that the image has the same
    noise relative to its signal as the scans (noise figure 1). *fit* fits contacts, *levelset*
    shapes of any form; both are nonlinear and fit to the scans' noise. *network* is a network
    alone. *auto* is *fit*; where the sensor has a network, the network proposes the start of the
    fit, and makes the map where no fit explains the scans. Where objects conduct `either_way`,
    *fit* and *auto* are *noser*. The laboratory adds *pls-paper*, the level set of the paper that
    tactomo is compared with, and the paper's networks, *cnn-single* and *cnn-multimodal*. Of
    several methods, OUT holds the maps of the first; the picture shows all.
    """
    from tactomo_models import load_description
    from tactomo_models.batch import ReferencedScans, reconstruct_file, reference_at_rest
    from tactomo_models.calibration.calibration_file import CALIBRATIONS
    from tactomo_models.calibration.taught_skin import TAUGHT
    from tactomo_models.sensor.named_pattern import NamedPattern
    from tactomo_protocol import Channel

    from tactomo.recordings.imported_scans import read_scans

    prepare_file(maps, force=force or _is_of_reconstruct(maps), source=scans)
    sensor = load_description(description)
    named = None if pattern is None else NamedPattern.of_name(pattern)
    if named is not None:
        sensor = named.applied(sensor)
    curve = None if calibration is None else CALIBRATIONS.of(sensor, calibration).curve
    lesson = None if taught is None else TAUGHT.of(sensor, taught)
    one = None if channel is None else Channel(channel)
    frames_at_rest = frame_slice(reference_frames)
    unpressed = None if rest is None else read_scans(rest, sensor, one, pattern=named)
    turn_rad = None if unpressed is None else unpressed.turned_rad
    read = read_scans(scans, sensor, one, array=array, pattern=named, turn_rad=turn_rad)
    given = {str(name): volts for name, volts in read.volts.items()}
    if unpressed is not None:
        reference = unpressed.reference_of(slice(None))
    else:
        reference = read.reference_of(frames_at_rest) if frames_at_rest else None
    if reference is None:
        own = {str(name): volts for name, volts in read.reference.items()}
        at_rest = read.companions_at_rest.items()
        reference = reference_at_rest(scans, given, own, sensor, at_rest)
    elif reference.lacks_noise:
        reference = reference.with_noise_of(sensor, *map(given.get, Channel))
    for note in read.notes:
        say(note, err=True)
    methods = method or ["auto"]
    with tempfile.TemporaryDirectory(prefix="tactomo-") as folder:
        files = {name: Path(folder, f"{at}.npz") for at, name in enumerate(methods)}
        files[methods[0]] = maps
        for name, file in files.items():
            with progress_bar(f"reconstructing by {name}") as show:
                made = reconstruct_file(
                    scans,
                    file,
                    read=ReferencedScans(given, reference, read.companions),
                    description=sensor,
                    method=name,
                    progress=show,
                    curve=curve,
                    taught=lesson,
                )
            if made.failed:
                say(
                    f"{made.failure}; instead, tikhonov made {counted(made.failed, 'frame')}",
                    err=True,
                )
            if file == maps:
                say(f"wrote {maps}: {made.frames} frames")
            if file == maps and made.repeated:
                say(
                    f"left out: {counted(made.repeated, 'scan')} that repeat earlier ones, though "
                    "scans at rest have noise; either the converter is frozen, or the file holds "
                    "frames twice",
                    err=True,
                )
        if not maps.is_file():  # such as /dev/null
            return
        from tactomo.cli.files.reconstructed import draw_methods, print_summary

        print_summary(maps)
        if picture is not None:
            save_figure(draw_methods(files, sensor, f"{scans.name}, {sensor.name}"), picture)
            say(f"wrote {picture}")


def _is_of_reconstruct(path: Path) -> bool:
    """Whether a file is what this command writes, which can be computed again."""
    from zipfile import BadZipFile, ZipFile

    from tactomo_models.foreign_file import open_regular

    try:
        with open_regular(path) as file, ZipFile(file) as archive:
            return {"seconds.npy", "misfit.npy", "contact_frame.npy"} <= set(archive.namelist())
    except (OSError, BadZipFile):
        return False

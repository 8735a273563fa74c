"""`tactomo export`: a recording's frames for other programs: Foxglove, a spreadsheet, NumPy."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated

import typer

from tactomo.cli.files.recorded_frames import (
    FromOption,
    RecordedFrames,
    ToOption,
    recorded_frames,
)
from tactomo.cli.options import Force, RecordedDescription, examples, typer_app
from tactomo.cli.plot.plot import prepare_file
from tactomo.cli.run.foxglove import need_foxglove, placement_of, write_layout
from tactomo.errors import TactomoError

if TYPE_CHECKING:
    from tactomo_client import Frame
    from tactomo_foxglove import Placement

KINDS = {".mcap": "frames for Foxglove", ".csv": "contacts", ".npz": "maps and contacts"}

app = typer_app()


@app.command(
    epilog=examples(
        "tactomo export grasp.mcap grasp_foxglove.mcap --layout skin.json",
        "tactomo export grasp.mcap contacts.csv --from 2 --to 10",
        "tactomo export grasp.mcap maps.npz",
    ),
)
def export(
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="RECORDING",
            help="A recording (.mcap), or the folder of one in several files.",
        ),
    ],
    output: Annotated[
        Path, typer.Argument(metavar="OUT", help="The file to write: .mcap, .csv or .npz.")
    ],
    start_s: FromOption = 0.0,
    end_s: ToOption = None,
    description: RecordedDescription = None,
    layout: Annotated[
        Path | None,
        typer.Option(help="For .mcap: write the layout, too, to import in Foxglove."),
    ] = None,
    parent: Annotated[str, typer.Option(help="For .mcap: frame that the sensor hangs on.")] = (
        "world"
    ),
    pose: Annotated[
        str,
        typer.Option(
            metavar="X,Y,Z[,ROLL,PITCH,YAW]",
            help="For .mcap: pose in that frame, metres and degrees.",
        ),
    ] = "0,0,0",
    force: Force = False,
) -> None:
    """Write the frames of a recording for other programs; the extension of OUT says for which.

    *.mcap* opens in Foxglove: 3D, Image and Plot panels show what `tactomo foxglove` shows live.
    Needs foxglove-sdk: `pip install 'tactomo[foxglove]'`.

    *.csv* has a row for each contact in each frame, and one with an empty `id` for a frame in which
    nothing is pressed. Units are in the names; what is unknown is empty. Numbers are exact.

    *.npz* has `time_s`, `acquired_realtime_ns`, `scan_counter`, `age_s` (T,), `x_mm` (nx,), `y_mm`
    (ny,), `pressure_kpa` (T, ny, nx), and all that `tactomo reconstruct` writes but `seconds`.

    Frames are the recorded ones (`tactomo record --maps`). Without any, or with `--description`,
    the recording is reconstructed first, by the same code as live. Times are in seconds from the
    recording's beginning. The size of a recording does not matter: memory stays small.
    """
    kind = _kind(output)
    for file in (output, *([layout] if layout else [])):
        prepare_file(file, force=force, source=recording)
    write = _writer(kind, parent, pose, output.parent)
    with recorded_frames(recording, description, start_s, end_s, output.parent) as frames:
        count = _write(output, lambda file: write(frames, file))
        if layout is not None:
            write_layout(layout, frames.sensor)
    typer.echo(f"wrote {output}: {KINDS[kind]}, {count} frames")


def _kind(output: Path) -> str:
    kind = output.suffix.lower()
    if kind not in KINDS:
        raise typer.BadParameter(f"{output}: give a file that ends in {', '.join(KINDS)}")
    return kind


def _writer(
    kind: str, parent: str, pose: str, scratch: Path
) -> Callable[[RecordedFrames, IO[bytes]], int]:
    if kind == ".mcap":
        need_foxglove()
        placement = placement_of(parent, pose)
        return lambda frames, file: _write_mcap(frames, file, placement)
    if kind == ".csv":
        return _write_csv
    return lambda frames, file: _write_npz(frames, file, scratch)


def _write(output: Path, write: Callable[[IO[bytes]], int]) -> int:
    """Write a file as a whole; return how many frames went into it.

    Raises:
        TactomoError: it cannot be written, or there is no frame to be written.
    """
    from tactomo_models.archive import write_whole

    count = 0

    def write_some(file: IO[bytes]) -> None:
        nonlocal count
        if not (count := write(file)):
            raise TactomoError(
                "there are no frames between these times", "`tactomo info` tells how long it is"
            )

    try:
        write_whole(output, write_some)
    except OSError as error:
        raise TactomoError(
            f"cannot write {output}: {error.strerror or error}",
            "make room, or name a file that you may write",
        ) from error
    return count


def _write_mcap(frames: RecordedFrames, file: IO[bytes], placement: Placement) -> int:
    from tactomo_foxglove import write_mcap

    from tactomo.imaging.frames import description_fields

    about = {} if frames.description is None else description_fields(frames.description)

    def timed() -> Iterator[tuple[int, Frame, float | None]]:
        for time_s, frame, age_s in frames.with_progress(frames.moments(), "exporting"):
            yield frames.start_ns + round(time_s * 1e9), frame, age_s

    return write_mcap(timed(), file, frames.sensor, about, placement)


def _write_csv(frames: RecordedFrames, file: IO[bytes]) -> int:
    from tactomo.cli.files.csv import write_contacts

    return write_contacts(frames.with_progress(frames.moments("contacts"), "exporting"), file)


def _write_npz(frames: RecordedFrames, file: IO[bytes], scratch: Path) -> int:
    from tactomo.cli.files.npz import write_maps

    return write_maps(frames.with_progress(frames.moments(), "exporting"), file, scratch)

"""`tactomo export`: a recording's frames for other programs: Foxglove, a spreadsheet, NumPy."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tactomo.cli.app import FILES, app, examples
from tactomo.cli.foxglove import need_foxglove, placement_of, write_layout
from tactomo.cli.plot import prepare_file
from tactomo.cli.recorded import (
    DescriptionOption,
    FromOption,
    RecordedFrames,
    ToOption,
    recorded_frames,
)
from tactomo.errors import TactomoError

if TYPE_CHECKING:
    from tactomo_client import Frame

KINDS = {".mcap": "frames for Foxglove", ".csv": "contacts", ".npz": "maps and contacts"}


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        "tactomo export grasp.mcap grasp_foxglove.mcap --layout skin.json",
        "tactomo export grasp.mcap contacts.csv --from 2 --to 10",
        "tactomo export grasp.mcap maps.npz",
        "tactomo export maps.npz contacts.csv",
    ),
)
def export(
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="RECORDING",
            help="A recording (.mcap), the folder of one in several files, or the OUT.npz of "
            "`tactomo reconstruct`.",
        ),
    ],
    output: Annotated[
        Path, typer.Argument(metavar="OUT", help="The file to write: .mcap, .csv or .npz.")
    ],
    start_s: FromOption = 0.0,
    end_s: ToOption = None,
    description: DescriptionOption = None,
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
) -> None:
    """Write the frames of a recording for other programs; the extension of OUT says for which.

    *.mcap* opens in Foxglove: 3D, Image and Plot panels show what `tactomo foxglove` shows live.
    Needs foxglove-sdk: `pip install 'tactomo[foxglove]'`.

    *.csv* has a row for each contact in each frame, and one with an empty `id` for a frame in which
    nothing is pressed. Units are in the names; what is unknown is empty. Numbers are exact.

    *.npz* has `time_s`, `acquired_realtime_ns`, `scan_counter`, `age_s` (T,), `x_mm` (nx,), `y_mm`
    (ny,), `pressure_kpa` (T, ny, nx), and all that `tactomo reconstruct` writes but `seconds`.

    Frames are the recorded ones (`--record-maps`, `tactomo record --maps`). Without any, or with
    `--sensor`, the recording is reconstructed first, by the same code as live. Times are in seconds
    from the recording's beginning. The size of a recording does not matter: memory stays small.
    """
    kind = _kind(output)
    if recording.suffix.lower() == ".npz":
        _export_arrays(recording, output)
        return
    if kind == ".mcap":
        need_foxglove()
        placed = placement_of(parent, pose)
    if output.exists() and recording.exists() and output.samefile(recording):
        raise typer.BadParameter(f"{output} is the recording itself; name another file")
    prepare_file(output)
    with recorded_frames(recording, description, start_s, end_s, output.parent) as frames:
        with _written_whole(output) as part:
            if kind == ".mcap":
                count = _write_mcap(frames, part, placed)
            elif kind == ".csv":
                count = _write_csv(frames, part)
            else:
                count = _write_npz(frames, part)
            if not count:
                raise TactomoError(
                    f"there are no frames of {recording} between these times",
                    "`tactomo info` tells how long it is",
                )
    if layout is not None:
        write_layout(layout, frames.sensor)
    typer.echo(f"wrote {output}: {KINDS[kind]}, {count} frames")


def _kind(output: Path) -> str:
    kind = output.suffix.lower()
    if kind not in KINDS:
        raise typer.BadParameter(f"{output}: give a file that ends in {', '.join(KINDS)}")
    return kind


@contextlib.contextmanager
def _written_whole(output: Path) -> Iterator[Path]:
    """Yield where to write, beside `output`, which is replaced by it if all goes well."""
    part = output.with_name(f".{output.name}.part")
    try:
        yield part
        os.replace(part, output)
    except OSError as error:
        raise TactomoError(
            f"cannot write {output}: {error.strerror or error}",
            "make room, or name a file that you may write",
        ) from error
    finally:
        part.unlink(missing_ok=True)


def _write_mcap(frames: RecordedFrames, output: Path, placed: object) -> int:
    from tactomo_foxglove import Placement, write_mcap

    from tactomo.frames import description_fields

    assert isinstance(placed, Placement)
    about = {} if frames.description is None else description_fields(frames.description)

    def timed() -> Iterator[tuple[int, Frame]]:
        for time_s, frame in frames.shown(frames.moments(), "exporting"):
            yield frames.start_ns + round(time_s * 1e9), frame

    return write_mcap(timed(), output, frames.sensor, about, placed)


def _write_csv(frames: RecordedFrames, output: Path) -> int:
    from tactomo.cli.export_csv import write_contacts

    return write_contacts(frames.shown(frames.moments("contacts"), "exporting"), output)


def _write_npz(frames: RecordedFrames, output: Path) -> int:
    from tactomo.cli.export_npz import write_maps

    return write_maps(frames.shown(frames.moments(), "exporting"), output)


def _export_arrays(arrays: Path, output: Path) -> None:
    from tactomo.cli.export_csv import write_contacts_of_arrays

    if output.suffix.lower() != ".csv":
        raise typer.BadParameter(f"{output}: of an .npz file only a .csv can be made")
    prepare_file(output)
    with _written_whole(output) as part:
        count = write_contacts_of_arrays(arrays, part)
    typer.echo(f"wrote {output}: contacts, {count} frames")

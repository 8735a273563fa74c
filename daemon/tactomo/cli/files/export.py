"""`tactomo export`: a recording's frames for other programs: Foxglove, ROS 2, tables."""

from __future__ import annotations

import csv
import io
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any, Final, TypeAlias

import typer

from tactomo.cli.files.recorded_frames import (
    FromOption,
    Gaps,
    RecordedFrames,
    TimedFrame,
    ToOption,
    recorded_frames,
)
from tactomo.cli.options import (
    Force,
    RecordedDescription,
    RecordingFiles,
    examples,
    need_recording,
    typer_app,
)
from tactomo.cli.output import say
from tactomo.cli.plot.plot import prepare_file
from tactomo.cli.run.serve import write_layout
from tactomo.errors import TactomoError, needs, os_errors_as

if TYPE_CHECKING:
    from tactomo_client import Frame

KINDS = {".mcap": "frames for Foxglove", ".csv": "contacts"}
BAG, DATASET = "a ROS 2 bag", "a LeRobot dataset"
TimedFrames: TypeAlias = Iterator[TimedFrame]
Writer: TypeAlias = Callable[[RecordedFrames, TimedFrames, Any], int]
"""Writes moments into an open file, or a folder that it makes; returns how many there were."""

app = typer_app()


@app.command(
    epilog=examples(
        "tactomo export grasp.mcap grasp_foxglove.mcap --layout skin.json",
        "tactomo export grasp.mcap grasp_bag --ros2",
        "tactomo export grasp.mcap dataset --lerobot --robot steps.csv --task lift",
        "tactomo export grasp.mcap contacts.csv --from 2 --to 10",
    )
)
def export(
    recording: RecordingFiles,
    output: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            help="The file to write: .mcap, .csv; a new folder with --ros2, --lerobot.",
        ),
    ],
    ros2: Annotated[
        bool, typer.Option("--ros2", help="Write a ROS 2 bag of standard messages.")
    ] = False,
    lerobot: Annotated[
        bool, typer.Option("--lerobot", help="Write a LeRobot dataset, without loss.")
    ] = False,
    robot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.csv",
            help="For --lerobot: the robot's steps to align with: monotonic_s or realtime_s, "
            "episode, action.*, and its state.",
        ),
    ] = None,
    fps: Annotated[
        int | None,
        typer.Option(min=1, max=1000, help="For --lerobot: steps a second. [the robot's, or 30]"),
    ] = None,
    task: Annotated[str, typer.Option(help="For --lerobot: the task, in words.")] = "touch",
    start_s: FromOption = 0.0,
    end_s: ToOption = None,
    description: RecordedDescription = None,
    layout: Annotated[
        Path | None, typer.Option(help="For .mcap: also write a layout to import in Foxglove.")
    ] = None,
    force: Force = False,
) -> None:
    """Write the frames of a recording in a format of other programs, by the extension of OUT.

    *.mcap* opens in Foxglove: 3D and Plot panels show what `tactomo foxglove` shows live.
    Needs foxglove-sdk: `pip install 'tactomo[foxglove]'`.

    *--ros2* writes a folder for `ros2 bag play`: maps and contacts as PointCloud2, WrenchStamped
    and PoseWithCovarianceStamped, and diagnostics. Needs rosbags, and no ROS: `pip install
    'tactomo[ros2]'`.

    *--lerobot* writes a LeRobot dataset: maps and contacts as exact numbers, with masks for unknown
    values. Needs lerobot, and Python 3.12.

    *.csv* has a row for each contact in each frame; a frame without contacts has a row with an
    empty `id`. Names hold the units; unknown values are empty. Numbers are exact.

    Maps as arrays: `tactomo_client.recording` reads a recording in Python.

    The frames are the recorded frames (`tactomo record --maps`). Where there are none, or with
    `--description`, the command first reconstructs the recording, by the same code as live. Times
    are seconds from the recording's beginning. Memory stays small for a recording of any size. Lost
    frames, clock steps and restarts are counted on standard error.
    """
    kind = BAG if ros2 else DATASET if lerobot else _kind(output)
    is_folder = ros2 or lerobot
    if robot is not None and not lerobot:
        raise typer.BadParameter("--robot is for --lerobot")
    need_recording(recording)
    if is_folder:
        _prepare_folder(output)
    for file in (*([] if is_folder else [output]), *([layout] if layout else [])):
        prepare_file(file, force=force, source=recording)
    gaps = Gaps()
    told: list[str] = []
    write = _dataset_writer(robot, fps, task, gaps, told) if kind == DATASET else _writer(kind)
    with recorded_frames(recording, description, start_s, end_s, output.parent) as frames:
        moments = frames.moments("contacts" if kind == ".csv" else "map")
        watched = gaps.watch(frames.with_progress(moments, "exporting"))
        into = _write_folder if is_folder else _write_file
        step = "make room, or name a file that you may write"
        with os_errors_as(TactomoError, f"cannot write {output}", step):
            count = into(output, lambda out: write(frames, watched, out))
        if layout is not None:
            write_layout(layout, frames.sensor)
    for line in (*gaps.lines(), *told):
        say(line, err=True)
    of = "steps" if kind == DATASET else "frames"
    say(f"wrote {output}: {KINDS.get(kind, kind)}, {count} {of}")


def _kind(output: Path) -> str:
    kind = output.suffix.lower()
    if kind not in KINDS:
        raise typer.BadParameter(
            f"{output}: give a file that ends in {', '.join(KINDS)}, or add --ros2 or --lerobot"
        )
    return kind


def _writer(kind: str) -> Writer:
    if kind == ".csv":
        return lambda _, moments, file: write_contacts(moments, file)
    if kind == ".mcap":
        with needs("Foxglove", "pip install 'tactomo[foxglove]'"):
            from tactomo_foxglove import write_mcap

        def write(frames: RecordedFrames, moments: TimedFrames, file: IO[bytes]) -> int:
            return write_mcap(_timed(frames, moments), file, frames.sensor, _about(frames))

        return write
    with needs("a ROS 2 bag", "pip install 'tactomo[ros2]'"):
        from tactomo_ros2.bag import write_bag

    def write_folder(frames: RecordedFrames, moments: TimedFrames, folder: Path) -> int:
        from tactomo_client.filled import filled
        from tactomo_client.schema import Mount

        about = _about(frames)
        mount = filled(Mount, about["mount"]) if about.get("mount") else None
        return write_bag(_timed(frames, moments), folder, frames.sensor, mount)

    return write_folder


def _about(frames: RecordedFrames) -> dict[str, Any]:
    """What a status says of the sensor."""
    from tactomo.imaging.frames import description_fields

    return {} if frames.description is None else description_fields(frames.description)


def _dataset_writer(
    robot: Path | None, fps: int | None, task: str, gaps: Gaps, told: list[str]
) -> Writer:
    from tactomo.cli.files.lerobot import need_lerobot, read_robot_log, write_dataset

    log = None if robot is None else read_robot_log(robot)
    need_lerobot()

    def write(frames: RecordedFrames, moments: TimedFrames, folder: Path) -> int:
        count, lines = write_dataset(moments, folder, frames.sensor, gaps, log, fps, task)
        told.extend(lines)
        return count

    return write


def _prepare_folder(output: Path) -> None:
    if output.suffix.lower() in KINDS:
        raise typer.BadParameter(f"{output}: that is a folder; name {output.with_suffix('')}")
    if output.exists():
        raise TactomoError(f"{output} exists already", "name another folder, or delete this one")
    if not os.access(output.parent, os.W_OK):
        raise TactomoError(f"cannot write {output}", "name a folder in one that you may write to")


def _checked(count: int) -> int:
    if not count:
        raise TactomoError(
            "there are no frames between these times", "`tactomo info` shows its length"
        )
    return count


def _write_file(output: Path, write: Callable[[IO[bytes]], int]) -> int:
    from tactomo_models.archive import write_whole

    count = 0

    def write_some(file: IO[bytes]) -> None:
        nonlocal count
        count = _checked(write(file))

    write_whole(output, write_some)
    return count


def _write_folder(output: Path, write: Callable[[Path], int]) -> int:
    """Write a folder as a whole; under another name it would have files of that name."""
    with tempfile.TemporaryDirectory(prefix=".tactomo-", dir=output.parent) as scratch:
        count = _checked(write(Path(scratch) / output.name))
        (Path(scratch) / output.name).rename(output)
    return count


def _timed(
    frames: RecordedFrames, moments: TimedFrames
) -> Iterator[tuple[int, Frame, float | None]]:
    """Yield the moments with their times in nanoseconds since 1970."""
    for time_s, frame, age_s in moments:
        yield frames.start_ns + round(time_s * 1e9), frame, age_s


FRAME_COLUMNS: Final = (
    "time_s",
    "acquired_realtime_ns",
    "session",
    "sequence",
    "scan_counter",
    "tier",
    "misfit",
    "confidence",
    "total_force_n",
    "total_force_sigma_n",
    "flags",
    "age_s",
)
ARRAY_COLUMNS: Final = {"magnitude_sigma": "contact_sigma", "frame": "contact_mount_frame"}
"""Columns whose array in the .npz of `tactomo reconstruct` is not named `contact_` and theirs."""


def write_contacts(moments: Iterable[TimedFrame], output: IO[bytes]) -> int:
    """Write the contacts of frames; return how many frames there were."""
    from tactomo_client import Contact
    from tactomo_client.schema import table_row

    columns, count = tuple(table_row(Contact(0, 0.0, 0.0, 0.0))), 0
    text = io.TextIOWrapper(output, encoding="utf-8", newline="")
    writer = csv.writer(text)
    writer.writerow([*FRAME_COLUMNS, *columns])
    for time_s, frame, age_s in moments:
        count += 1
        start = [
            f"{time_s:.9f}",
            *(getattr(frame, name.removeprefix("total_")) for name in FRAME_COLUMNS[1:-2]),
            " ".join(sorted(frame.flags)),
            age_s,
        ]
        for contact in frame.contacts or (None,):
            cells = dict.fromkeys(columns, "") if contact is None else table_row(contact)
            writer.writerow([*start, *cells.values()])
    text.detach()  # flushes it; the file stays open
    return count

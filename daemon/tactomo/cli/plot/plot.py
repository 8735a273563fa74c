"""`tactomo plot`: a recording on a page: its maps, its contacts over sheet and time, its health."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tactomo.cli.files.recorded_frames import FromOption, ToOption, recorded_frames
from tactomo.cli.options import (
    Force,
    RecordedDescription,
    RecordingFiles,
    examples,
    need_recording,
    typer_app,
)
from tactomo.cli.output import say
from tactomo.errors import TactomoError, needs, os_errors_as
from tactomo.plain import counted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE_DPI = 125

app = typer_app()


@app.command(
    epilog=examples(
        "tactomo plot grasp.mcap -o grasp.png",
        "tactomo plot grasp.mcap -o push.pdf --from 2 --to 8",
    )
)
def plot(
    recording: RecordingFiles,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="The picture: .png, .svg or .pdf.")
    ] = Path("recording.png"),
    start_s: FromOption = 0.0,
    end_s: ToOption = None,
    description: RecordedDescription = None,
    force: Force = False,
) -> None:
    """Draw a recording on one page.

    Maps: a map for each stretch with the same contacts, the longest stretches first, marked by
    letters. The contacts' paths. Pressure and force over time, with a band of two standard
    uncertainties (95 %) where known. Misfit: the rms of the residual in units of the noise; about 1
    is good. The method and the flags of each frame. Timing: the age of frames at publication, the
    time between frames, and lost frames.

    Uses the recorded maps (`tactomo record --maps`). Without recorded maps, the command first
    reconstructs the recording, by the same code as live. Needs matplotlib: `pip install
    'tactomo[plot]'`.
    """
    need_recording(recording)
    prepare_picture(output, force=force)
    from tactomo.cli.plot.course import Course, read_course, read_maps
    from tactomo.cli.plot.page import draw_page

    with recorded_frames(recording, description, start_s, end_s, output.parent) as frames:
        course: Course = read_course(frames)
        if not course.times_s:
            raise TactomoError(
                f"there are no frames of {recording} between these times",
                "`tactomo info` shows its length",
            )
        maps = read_maps(frames, course)
        figure = draw_page(course, maps, frames.description, recording.name)
    save_figure(figure, output, PAGE_DPI)
    say(
        f"wrote {output}: {counted(len(course.tracks), 'contact')} in "
        f"{counted(len(course.times_s), 'frame')}, "
        f"{course.times_s[-1] - course.times_s[0]:.1f} s"
    )


def prepare_picture(output: Path, *, force: bool = True) -> None:
    """Make sure before the work that a picture of it can be drawn, without a display.

    Raises TactomoError where matplotlib is not installed, or as `prepare_file` does.
    """
    next_step = "give a .png, .svg or .pdf in a folder that you may write"
    if output.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise TactomoError(f"cannot write {output}: not a kind of picture", next_step)
    with needs("drawing", "pip install 'tactomo[plot]'"):
        import matplotlib
    matplotlib.use("Agg")
    prepare_file(output, force=force)


def picture_option(words: str) -> Any:
    """Return the option of a picture, which is made sure of before the command begins."""

    def prepared(context: typer.Context, output: Path | None) -> Path | None:
        if output is not None and not context.resilient_parsing:
            prepare_picture(output)
        return output

    return typer.Option(help=f"{words}: .png, .svg or .pdf. Needs matplotlib.", callback=prepared)


def prepare_file(output: Path, *, force: bool = True, source: Path | None = None) -> None:
    """Make sure before the work that a file can be written; what it holds stays as it is.

    What is there is written over with `force`, or where somebody at the terminal says so. Folders
    are not made. An empty file holds nothing. The file that is read, or one of a folder that is, is
    never written over.

    Raises:
        typer.BadParameter: it is what is read, `source`.
        TactomoError: it cannot be, or may not.
    """
    if not output.parent.is_dir():
        make = f"make it first: `mkdir -p {shlex.quote(str(output.parent))}`"
        raise TactomoError(f"cannot write {output}: there is no folder {output.parent}", make)
    is_new = not output.exists()
    if source is not None and not is_new:
        for read in source.glob("*.mcap") if source.is_dir() else (source,):
            if read.exists() and output.samefile(read):
                raise typer.BadParameter(f"{output} is what is read; name another file")
    if not force and not is_new and output.stat().st_size:
        can_ask = sys.stdin.isatty() and sys.stderr.isatty()
        if not can_ask or not typer.confirm(f"{output} exists: write over it?", err=True):
            raise TactomoError(f"{output} exists already", "name another file, or add --force")
    with os_errors_as(TactomoError, f"cannot write {output}", "name a file that you may write"):
        output.open("ab").close()
        if is_new:
            output.unlink()


def save_figure(figure: Figure, output: Path, dpi: int = 150) -> None:
    """Write a picture; raise TactomoError where it cannot be written."""
    from tactomo_models.archive import write_whole

    kind = output.suffix[1:].lower()
    try:
        write_whole(output, lambda file: figure.savefig(file, dpi=dpi, format=kind))
    except (OSError, ValueError) as error:
        raise TactomoError(
            f"cannot write {output}: {error}", "give a .png, .svg or .pdf that you may write"
        ) from error

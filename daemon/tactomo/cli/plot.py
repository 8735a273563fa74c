"""`tactomo plot`: a recording's contacts as a picture, where they went and when."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tactomo.cli.app import FILES, RecordingFile, app, examples
from tactomo.cli.programs import warn_of_damage
from tactomo.errors import TactomoError

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from tactomo_models import SensorDescription

    from tactomo.recording import Recording


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        "tactomo plot grasp.mcap -o grasp.png",
        "tactomo plot tank.mcap -o cup.png --smallest-mm2 200",
    ),
)
def plot(
    recording: RecordingFile,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="The picture: .png, .svg or .pdf.")
    ] = Path("contacts.png"),
    description: Annotated[
        str | None, typer.Option("--sensor", "--description", "-d", help="[the recorded one]")
    ] = None,
    smallest_mm2: Annotated[
        float, typer.Option("--smallest-mm2", min=0.0, help="Leave out smaller contacts.")
    ] = 0.0,
    title: Annotated[str | None, typer.Option(help="Above the picture.")] = None,
) -> None:
    """Draw the contacts of a recording: their path over the sheet, and their course in time.

    Uses the contacts in the recording if it has some (`tactomo daemon --record-maps`); otherwise
    the recording is reconstructed first, by the same code as live. Needs matplotlib:
    `pip install 'tactomo[plot]'`.
    """
    prepare_picture(output)
    from rich.console import Console
    from tactomo_models import load_description

    from tactomo.recording import open_recording

    opened = open_recording(recording)
    warn_of_damage(opened)
    sensor = description or opened.summary.origin.description
    points = _read_contacts(recording) if opened.summary.is_complete else []
    if not points:
        with Console(stderr=True).status("reconstructing the recording"):
            points = _reconstruct(opened, sensor)
    points = [point for point in points if point.area_mm2 >= smallest_mm2]
    if not points:
        raise TactomoError(
            f"there are no contacts in {recording}",
            "look at it with `tactomo replay --viewer`; it may need another --sensor",
        )
    _draw(points, load_description(sensor), title or recording.name, output)
    contacts = len({point.id for point in points})
    typer.echo(f"wrote {output}: {contacts} contact(s), {len(points)} positions")


@dataclass(frozen=True, slots=True)
class Point:
    """One contact in one frame."""

    time_s: float
    id: int
    x_mm: float
    y_mm: float
    area_mm2: float
    magnitude: float | None
    pressure_kpa: float | None


def prepare_picture(output: Path) -> None:
    """Make sure before the work that a picture of it can be drawn, without a display.

    Raises:
        TactomoError: matplotlib is not installed, or the picture could not be written.
    """
    next_step = "give a .png, .svg or .pdf in a folder that you may write"
    if not output.parent.is_dir():
        raise TactomoError(f"cannot write {output}: there is no folder {output.parent}", next_step)
    if output.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise TactomoError(f"cannot write {output}: not a kind of picture", next_step)
    try:
        import matplotlib
    except ImportError as error:
        raise TactomoError(
            "drawing needs matplotlib, which is not installed", "pip install 'tactomo[plot]'"
        ) from error
    matplotlib.use("Agg")
    prepare_file(output)


def prepare_folder(folder: Path) -> None:
    """Make sure before the work that pictures can be drawn into a folder, which is made.

    Raises:
        TactomoError: as `prepare_picture`, or the folder cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TactomoError(
            f"cannot make the folder {folder}: {error.strerror}", "give one that you may write"
        ) from error
    prepare_picture(folder / "figure.png")


def prepare_file(output: Path) -> None:
    """Make sure before the work that a file can be written; what it holds stays as it is.

    Raises:
        TactomoError: it cannot be.
    """
    is_new = not output.exists()
    try:
        output.open("ab").close()
        if is_new:
            output.unlink()
    except OSError as error:
        raise TactomoError(
            f"cannot write {output}: {error.strerror}", "name a file that you may write"
        ) from error


def save_figure(figure: Figure, output: Path) -> None:
    """Write a picture.

    Raises:
        TactomoError: it cannot be written.
    """
    try:
        figure.savefig(output, dpi=150)
    except (OSError, ValueError) as error:
        raise TactomoError(
            f"cannot write {output}: {error}", "give a .png, .svg or .pdf that you may write"
        ) from error


def _read_contacts(path: Path) -> list[Point]:
    """Return the contacts in a complete recording; none where it was made without them."""
    from mcap.reader import make_reader
    from tactomo_client.messages import CONTACTS, decode_message

    points: list[Point] = []
    first_us: int | None = None
    with path.open("rb") as file:
        for _, _, message in make_reader(file).iter_messages(
            topics=[CONTACTS], log_time_order=False
        ):
            fields = decode_message(message.data).fields
            first_us = fields["device_us"] if first_us is None else first_us
            time_s = (fields["device_us"] - first_us) * 1e-6
            for contact in fields["contacts"]:
                kept = {name: contact[name] for name in Point.__slots__ if name != "time_s"}
                points.append(Point(time_s, **kept))
    return points


def _reconstruct(recording: Recording, description: str) -> list[Point]:
    """Replay a recording through a daemon of our own, into one that has contacts."""
    from tactomo.config import load_config
    from tactomo.daemon import Daemon
    from tactomo.log import configure_logging

    configure_logging("error")
    with tempfile.TemporaryDirectory(prefix="tactomo-") as folder:
        path = Path(folder) / "contacts.mcap"
        config = load_config(
            name="plot",
            description=description,
            ports=recording.replay_urls(speed=0),
            stream=f"ipc://{folder}/stream",
            control=f"ipc://{folder}/control",
            lossless=True,
            exit_at_end=True,
            record=path,
            record_maps=True,
        )
        if Daemon(config).run() != 0:
            raise TactomoError(
                f"{recording.path} could not be replayed", "`tactomo replay` tells more"
            )
        return _read_contacts(path)


def _draw(points: list[Point], description: SensorDescription, title: str, output: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5.2), layout="constrained")
    figure.suptitle(title)
    halves: Any = figure.subfigures(1, 2, width_ratios=(1.1, 1.0))
    left, right = halves
    _draw_sheet(left, points, description)
    _draw_traces(right, points)
    save_figure(figure, output)


def _draw_sheet(figure: Any, points: list[Point], description: SensorDescription) -> None:
    from matplotlib.patches import Circle, Rectangle

    axes = figure.subplots()
    width, height = description.width_m * 1e3, description.height_m * 1e3
    style: dict[str, Any] = {"fill": False, "edgecolor": "0.4", "linewidth": 1.5}
    if description.sheet.shape == "disc":
        axes.add_patch(Circle((0, 0), width / 2, **style))
    else:
        axes.add_patch(Rectangle((-width / 2, -height / 2), width, height, **style))
    for number, (begin, end) in enumerate(description.electrode_ends_m * 1e3):
        axes.plot(*zip(begin, end, strict=True), color="black", linewidth=4, solid_capstyle="butt")
        x, y = (begin + end) / 2 * 1.08
        axes.text(x, y, str(number), ha="center", va="center", fontsize=7, color="0.4")
    for track in _by_contact(points):
        x, y = [point.x_mm for point in track], [point.y_mm for point in track]
        axes.plot(x, y, color="0.8", linewidth=0.8, zorder=1)
    dots = axes.scatter(
        [point.x_mm for point in points],
        [point.y_mm for point in points],
        c=[point.time_s for point in points],
        s=[max(4.0, point.area_mm2 / 40) for point in points],
        cmap="viridis",
        alpha=0.8,
        linewidths=0,
        zorder=2,
    )
    figure.colorbar(dots, ax=axes, label="time (s)", shrink=0.8)
    axes.set(
        xlim=(-0.57 * width, 0.57 * width),
        ylim=(-0.57 * height, 0.57 * height),
        aspect="equal",
        xlabel="x (mm)",
        ylabel="y (mm)",
        title="path, dots by area",
    )


def _draw_traces(figure: Any, points: list[Point]) -> None:
    rows = figure.subplots(3, 1, sharex=True)
    what, unit = _strength(points)
    for track in _by_contact(points):
        times = [point.time_s for point in track]
        rows[0].plot(times, [point.x_mm for point in track], ".-", markersize=2, linewidth=0.8)
        rows[1].plot(times, [point.y_mm for point in track], ".-", markersize=2, linewidth=0.8)
        strength = [getattr(point, what) for point in track]
        rows[2].plot(times, strength, ".-", markersize=2, linewidth=0.8)
    for axes, label in zip(rows, ("x (mm)", "y (mm)", unit), strict=True):
        axes.set_ylabel(label)
        axes.grid(visible=True, alpha=0.3)
    rows[2].set_xlabel("time (s)")


def _strength(points: Iterable[Point]) -> tuple[str, str]:
    """Return the attribute that best tells how hard is pressed, and its axis label."""
    known = list(points)
    if any(point.pressure_kpa is not None for point in known):
        return "pressure_kpa", "pressure (kPa)"
    if any(point.magnitude is not None for point in known):
        return "magnitude", "|Δσ|/σ₀"
    return "area_mm2", "area (mm²)"


def _by_contact(points: list[Point]) -> list[list[Point]]:
    """Return the points of each contact, in time."""
    tracks: dict[int, list[Point]] = {}
    for point in points:
        tracks.setdefault(point.id, []).append(point)
    return list(tracks.values())

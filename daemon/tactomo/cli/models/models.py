"""`tactomo models`: descriptions, drawn true to scale, and their models, built ahead of time."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from tactomo.cli.commands import Group
from tactomo.cli.console import Console
from tactomo.cli.options import DEFAULT_DESCRIPTION, Description, examples, typer_app
from tactomo.cli.output import say
from tactomo.cli.plot.electrodes import draw_electrodes, outline_path, outwards
from tactomo.cli.plot.plot import prepare_picture, save_figure
from tactomo.errors import TactomoError, needs, os_errors_as
from tactomo.plain import counted, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from tactomo_models import SensorDescription
    from tactomo_models.physics.sensitivity import Visibility

app = typer_app(
    help="Build and list the models of sensors.", name="models", cls=Group, no_args_is_help=True
)


@app.command(
    epilog=examples(
        "tactomo models build",
        "tactomo models build --description my_skin.toml",
    )
)
def build(description: Description = DEFAULT_DESCRIPTION) -> None:
    """Build the models of a sensor description: forward model, Jacobian, Tikhonov matrix.

    The daemon builds missing models at its start; this command saves the daemon the time. A hash
    binds the models to the description: after a change of geometry, build again. The models lie in
    the cache, where the daemon looks.
    """
    from tactomo_models import ArtifactError, load_description
    from tactomo_models.physics.artifact import (
        build_artifact,
        default_path,
        load_artifact,
        save_artifact,
    )

    sensor = load_description(description)
    path = default_path(sensor)
    try:
        load_artifact(path, sensor)
        say(f"{path} is up to date")
        return
    except ArtifactError:  # missing, damaged, or of another version: build it
        pass
    with Console(stderr=True).status(sensor.name) as line:
        artifact = build_artifact(sensor, lambda step: line.update(f"{sensor.name}: {step}"))
        save_artifact(artifact, path)
    say(f"wrote {path}")


@app.command(epilog=examples("tactomo models copy sciospec_disc tank.toml"))
def copy(
    name: Annotated[str, typer.Argument(help="A name from `tactomo models list`.")],
    path: Annotated[Path, typer.Argument(metavar="FILE.toml", help="The file to write.")],
) -> None:
    """Copy a shipped sensor description to a file of your own, to be changed there."""
    from tactomo_models.sensor.description_file import shipped_text

    _write_new(path, shipped_text(name))
    say(f"wrote {path}; give it to --description")


def _write_new(path: Path, text: str) -> None:
    step = "give the path of a new file"
    with (
        os_errors_as(TactomoError, f"cannot write {path}", step),
        path.open("x", encoding="utf-8") as file,
    ):
        file.write(text)


@app.command(
    "import",
    epilog=examples(
        "tactomo models import sole.dxf sole.toml",
        "tactomo models import palm.svg palm.toml --count 24 --electrode-mm 6",
        "tactomo models import fmdl.mat tank.toml --unit-mm 140 --electrode-mm 10",
    ),
)
def import_model(
    source: Annotated[
        Path, typer.Argument(metavar="IN", help="A .dxf, .svg, EIDORS .mat or pyEIT .npz file.")
    ],
    path: Annotated[Path, typer.Argument(metavar="OUT.toml", help="The description to write.")],
    unit_mm: Annotated[
        float | None,
        typer.Option(min=1e-3, max=1e5, help="Millimetres of a unit of the file. [the file's own]"),
    ] = None,
    electrode_mm: Annotated[
        float | None,
        typer.Option(min=0.01, max=1e4, help="Length of an electrode. [the file's]"),
    ] = None,
    electrodes: Annotated[
        str, typer.Option(metavar="LAYER", help="The drawing's layer of electrodes.")
    ] = "electrodes",
    outline: Annotated[
        str | None,
        typer.Option(metavar="LAYER", help="The drawing's layer of outline and holes. [all other]"),
    ] = None,
    count: Annotated[
        int | None,
        typer.Option(min=6, max=64, help="Place so many electrodes evenly along the outline."),
    ] = None,
) -> None:
    """Write the description of a sensor that a drawing or an EIT model shows.

    In drawings, the largest closed line is the outline; the others are holes. Electrodes are points
    or shapes on a layer (SVG: in a group), numbered in the order of the file. DXF needs ezdxf, SVG
    needs svgelements: `pip install 'tactomo[drawings]'`. An EIDORS model is a .mat of fwd_model.
    Of pyEIT, save node, element, el_pos, ex_mat and meas_mat by `numpy.savez`.
    """
    from tactomo_models.imported.drawing import read_drawing
    from tactomo_models.imported.mesh import read_model
    from tactomo_models.imported.model import describe, evenly_placed

    read_step, suffix = "give a .dxf, .svg, .mat or .npz file", source.suffix.lower()
    if suffix not in (".dxf", ".svg", ".mat", ".npz"):
        raise TactomoError(f"{source} is of no kind that is read", read_step)
    is_drawing = suffix in (".dxf", ".svg")
    with (
        os_errors_as(TactomoError, f"cannot read {source}", read_step),
        needs(suffix[1:].upper(), "pip install 'tactomo[drawings]'"),
    ):
        model = (
            read_drawing(source, electrodes, outline, unit_mm)
            if is_drawing
            else read_model(source, unit_mm)
        )
    if count is not None:
        model = evenly_placed(model, count)
    if not len(model.centres):
        raise TactomoError(
            f"{source} has no electrodes" + (f" on a layer {electrodes!r}" if is_drawing else ""),
            "name their layer by --electrodes, or place them evenly by --count",
        )
    name = re.sub(r"\W+", "_", path.stem.lower(), flags=re.ASCII).strip("_0123456789") or "sensor"
    text, sensor = describe(model, source, name, electrode_mm)
    _write_new(path, text)
    x_mm, y_mm = 1e3 * sensor.electrode_centres_m[0]
    say(
        f"wrote {path}: {sensor.sheet.shape} of {1e3 * sensor.width_m:.4g} x "
        f"{1e3 * sensor.height_m:.4g} mm, {counted(len(sensor.sheet.holes_m), 'hole')}, "
        f"{sensor.electrode_count} electrodes of {1e3 * sensor.electrodes.length_m:.3g} mm"
    )
    if model.pattern is not None and model.pattern.note:
        say(model.pattern.note)
    say(
        f"Electrode 0 is at ({x_mm:.1f}, {y_mm:.1f}) mm: `tactomo models draw {path}` shows all. "
        "Numbers, contact impedance, map and response are for you to check."
    )


@app.command(name="list")
def list_sensors() -> None:
    """List the sensor descriptions that come with tactomo."""
    from tactomo_models import load_description
    from tactomo_models.sensor.description_file import shipped_descriptions

    for name in shipped_descriptions():
        say(f"{name}  {load_description(name).title}")


MM_PER_INCH = 25.4
MARGIN_MM = 24.0  # around the sheet, for the electrodes' numbers and the axes'
HEAD_MM = 20.0  # for the title
MAP_MM = 90.0  # width of the maps beside it
SCALES = (10.0, 5.0, 2.0, 1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01)
SMALLEST_MM, LARGEST_MM = 50.0, 300.0  # of a sheet as drawn
HARDLY_SEEN = 5.0  # standard deviations: what is seen less clearly is not told from noise
DRIVE, MEASURE = "tab:red", "tab:blue"


@app.command(
    epilog=examples(
        "tactomo models draw my_sheet.toml -o my_sheet.png",
        "tactomo models draw my_sheet.toml -o my_sheet.pdf      (prints true to scale)",
        "tactomo models draw paper_square",
    )
)
def draw(
    sensor: Annotated[str, typer.Argument(help="A shipped description's name, or a TOML file.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The picture: .png, .svg or .pdf. [NAME.png]"),
    ] = None,
) -> None:
    """Draw a sensor description, true to scale, and where the sensor sees well.

    The drawing shows the sheet from the pressed side: the frame, which cannot be pressed, the
    electrodes with their numbers, the first drive pair with its measuring pairs, and the nodes of
    the map. Print it at 100 % and lay it on the sheet: a wrong numbering shows at once.

    Two maps beside the drawing show how clearly a light press is detected and how well it is
    located, by its place: to first order, with the noise of a usual converter. The command builds
    the sensor's models where they are missing. Needs matplotlib: `pip install 'tactomo[plot]'`.
    """
    from tactomo_models import load_description
    from tactomo_models.physics.artifact import load_or_build_artifact
    from tactomo_models.physics.sensitivity import find_visibility

    description = load_description(sensor)
    picture = output or Path(f"{description.name}.png")
    prepare_picture(picture)
    with Console(stderr=True).status(description.name):
        seen = find_visibility(description, load_or_build_artifact(description))
    _draw(description, seen, picture)
    say(f"wrote {picture}: {description.name}, {_scale_in_words(_scale(description))}")


def _scale(description: SensorDescription) -> float:
    """Millimetres on paper for one of the sheet: 1 for those of a size to be laid on."""
    size_mm = 1e3 * max(description.width_m, description.height_m)
    fitting = [s for s in SCALES if SMALLEST_MM <= s * size_mm <= LARGEST_MM]
    return min(fitting or SCALES, key=lambda s: (abs(s - 1), s))


def _scale_in_words(scale: float) -> str:
    return f"scale {scale:g} : 1" if scale > 1 else f"scale 1 : {1 / scale:g}"


def _draw(description: SensorDescription, seen: Visibility, output: Path) -> None:
    from matplotlib.figure import Figure

    scale = _scale(description)
    size_mm = 1e3 * scale * description.width_m, 1e3 * scale * description.height_m
    panel = [side + 2 * MARGIN_MM for side in size_mm]
    width, height = panel[0] + MAP_MM + 10, max(panel[1], 130.0) + HEAD_MM
    figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH))

    def place(left: float, bottom: float, wide: float, high: float) -> Axes:
        return figure.add_axes((left / width, bottom / height, wide / width, high / height))

    low = (height - HEAD_MM - panel[1]) / 2
    sheet = place(MARGIN_MM, low + MARGIN_MM, *size_mm)
    _draw_sheet(sheet, description, 1 / scale)
    title = plain(_title(description, scale))
    figure.text(8 / width, 1 - 5 / height, title, va="top", fontsize=9, parse_math=False)
    half = (height - HEAD_MM) / 2
    press = f"press of {1e3 * seen.diameter_m:.3g} mm that changes σ by 10 %"
    maps = (
        (seen.signal, f"{press}:\nsignal, in standard deviations of the noise", "viridis"),
        (1e3 * seen.place_m, f"{press}:\nstandard uncertainty of its place, mm", "viridis_r"),
    )
    for row, (image, label, colours) in enumerate(maps):
        axes = place(panel[0] + 8, half * (1 - row) + 12, MAP_MM - 18, half - 22)
        _draw_map(axes, description, image, label, colours)
    save_figure(figure, output)


def _title(description: SensorDescription, scale: float) -> str:
    map_ = description.map
    step_x, step_y = (
        1e3 * side / (nodes - 1)
        for side, nodes in (
            (description.width_m, map_.nodes_x),
            (description.height_m, map_.nodes_y),
        )
    )
    size = f"{1e3 * description.width_m:g} × {1e3 * description.height_m:g} mm"
    return (
        f"{description.name}: {size}, {_scale_in_words(scale)}, seen from the pressed side\n"
        f"{_electrodes_in_words(description)}; {description.measurements} voltages: "
        f"{description.pattern}\n"
        f"map {map_.nodes_x} × {map_.nodes_y} nodes, {step_x:.3g} × {step_y:.3g} mm apart; "
        f"channels: {', '.join(description.channels)}"
    )


def _electrodes_in_words(description: SensorDescription) -> str:
    electrodes = description.electrodes
    pads = sum(radius > 0 for radius in description.pad_radii_m)  # NaN of those on the rim
    words = []
    if pads < description.electrode_count:
        on_rim = f"{description.electrode_count - pads} electrodes"
        words.append(f"{on_rim}, {1e3 * electrodes.length_m:g} mm long")
    if pads and electrodes.pad_radius_m:
        words.append(f"{pads} pads, {2e3 * electrodes.pad_radius_m:g} mm across")
    return "; ".join(words)


def _draw_sheet(axes: Axes, description: SensorDescription, paper_mm: float) -> None:
    """The sheet in millimetres; `paper_mm` is what one of them on paper stands for."""
    half_x, half_y = 5e2 * description.width_m, 5e2 * description.height_m
    frame_m = description.sheet.frame_width_m
    _draw_outline(axes, description, 0.0, facecolor="0.88", edgecolor="black")
    line = "--" if frame_m else "none"
    _draw_outline(axes, description, frame_m, facecolor="white", edgecolor="0.5", linestyle=line)
    x, y = np.meshgrid(description.map_x_m, description.map_y_m)
    on = description.on_sheet(x, y)
    axes.plot(1e3 * x[on], 1e3 * y[on], ",", color="0.6", zorder=2)
    axes.plot(0, 0, "+", color="0.4", markersize=10, zorder=3)
    draw_electrodes(
        axes, description, 4 * paper_mm, {"color": "tab:red", "weight": "bold"}, zorder=7
    )
    _draw_pairs(axes, description, paper_mm)
    axes.set(xlim=(-half_x, half_x), ylim=(-half_y, half_y), xlabel="x (mm)", ylabel="y (mm)")
    axes.spines[:].set_visible(False)
    axes.tick_params(pad=24, length=0, labelsize=8, colors="0.4")


def _draw_outline(axes: Axes, description: SensorDescription, inset_m: float, **style: Any) -> None:
    from matplotlib.patches import PathPatch

    axes.add_patch(PathPatch(outline_path(description, inset_m), **style)).set_clip_on(False)


def _draw_pairs(axes: Axes, description: SensorDescription, paper_mm: float) -> None:
    """The first drive pair and the pairs that are measured meanwhile, inside the rim or on pads."""
    inwards = np.isnan(description.pad_radii_m)[:, None] * -outwards(description)
    inside = 1e3 * description.electrode_centres_m + 3 * paper_mm * inwards
    pairs = description.pairs
    source, sink = first = pairs.drive[0]
    meanwhile = pairs.measure[(pairs.drive == first).all(axis=1)]
    for plus, minus in meanwhile:
        axes.plot(*inside[[plus, minus]].T, color=MEASURE, linewidth=1, alpha=0.7, zorder=4)
    axes.annotate(
        "",
        xytext=inside[source],
        xy=inside[sink],
        arrowprops={"arrowstyle": "->", "color": DRIVE, "linewidth": 1.5},
        zorder=6,
    )
    handles: Sequence[Any] = [
        axes.plot([], [], color=DRIVE, label=f"first drive: {source} to {sink}")[0],
        axes.plot([], [], color=MEASURE, label=f"measured meanwhile: {len(meanwhile)} pairs")[0],
    ]
    above = 1 + 8 * paper_mm / (1e3 * description.height_m)
    axes.legend(
        handles=handles, loc="lower center", bbox_to_anchor=(0.5, above), fontsize=7, ncols=2
    )


def _draw_map(
    axes: Axes, description: SensorDescription, image: Any, label: str, colours: str
) -> None:
    x, y = 1e3 * description.map_x_m, 1e3 * description.map_y_m
    shown = axes.pcolormesh(x, y, image, cmap=colours, shading="nearest")
    axes.plot(*1e3 * description.electrode_centres_m.T, "ks", markersize=3, clip_on=False)
    if colours == "viridis" and np.nanmin(image) < HARDLY_SEEN < np.nanmax(image):
        axes.contour(x, y, image, [HARDLY_SEEN], colors="tab:red", linewidths=1)
        label += f" (red: {HARDLY_SEEN:g})"
    axes.set(aspect="equal", xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    axes.tick_params(labelsize=7)
    axes.set_title(label, fontsize=8, loc="left")
    axes.figure.colorbar(shown, ax=axes).ax.tick_params(labelsize=7)

"""`tactomo models`: descriptions, and what a sensor's reconstruction needs, built ahead of time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tactomo.cli.commands import Group
from tactomo.cli.models.drawing import app as drawing_app
from tactomo.cli.options import DEFAULT_DESCRIPTION, Description, examples, typer_app
from tactomo.cli.output import say
from tactomo.plain import counted

app = typer_app(
    help="Build and list the models of sensors.", name="models", cls=Group, no_args_is_help=True
)

app.add_typer(drawing_app)


@app.command(
    epilog=examples(
        "tactomo models build",
        "tactomo models build --description my_skin.toml",
        "tactomo models build --description my_skin.toml --output my_skin.npz",
    )
)
def build(
    description: Description = DEFAULT_DESCRIPTION,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="[the cache, where the daemon looks]")
    ] = None,
) -> None:
    """Build the models of a sensor description: forward model, Jacobian, Tikhonov matrix.

    The daemon builds missing models at its start; this command saves the daemon the time. A hash
    binds the models to the description: after a change of geometry, build again. A file is
    overwritten only if it already holds these models.
    """
    from tactomo_models import ArtifactError, load_description
    from tactomo_models.physics.artifact import (
        build_artifact,
        default_path,
        load_artifact,
        save_artifact,
    )

    from tactomo.cli.console import Console
    from tactomo.cli.plot.plot import prepare_file

    sensor = load_description(description)
    path = output or default_path(sensor)
    try:
        load_artifact(path, sensor)
        say(f"{path} is up to date")
        return
    except ArtifactError:  # missing, damaged, or of another sensor or version: build it
        if output is not None:
            prepare_file(output, force=False)
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
    from tactomo.errors import TactomoError, os_errors_as

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
    import re

    from tactomo_models.imported.drawing import read_drawing
    from tactomo_models.imported.mesh import read_model
    from tactomo_models.imported.model import describe, evenly_placed

    from tactomo.errors import TactomoError, needs, os_errors_as

    read_step = "give a .dxf, .svg, .mat or .npz file"
    is_drawing = source.suffix.lower() in (".dxf", ".svg")
    with (
        os_errors_as(TactomoError, f"cannot read {source}", read_step),
        needs(f"{source.suffix[1:].upper()}", "pip install 'tactomo[drawings]'"),
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

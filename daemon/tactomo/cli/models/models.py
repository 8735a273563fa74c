"""`tactomo models`: descriptions, and what a sensor's reconstruction needs, built ahead of time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tactomo.cli.commands import Group
from tactomo.cli.models.drawing import app as drawing_app
from tactomo.cli.options import DEFAULT_DESCRIPTION, Description, examples, typer_app
from tactomo.cli.output import say

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

    from tactomo.errors import TactomoError, os_errors_as

    text = shipped_text(name)
    step = "give the path of a new file"
    with (
        os_errors_as(TactomoError, f"cannot write {path}", step),
        path.open("x", encoding="utf-8") as file,
    ):
        file.write(text)
    say(f"wrote {path}; give it to --description")


@app.command(name="list")
def list_sensors() -> None:
    """List the sensor descriptions that come with tactomo."""
    from tactomo_models import load_description
    from tactomo_models.sensor.description_file import shipped_descriptions

    for name in shipped_descriptions():
        say(f"{name}  {load_description(name).title}")

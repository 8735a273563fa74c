"""`tactomo models`: descriptions, and what a sensor's reconstruction needs, built ahead of time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tactomo.cli.app import BUILD, DEFAULT_DESCRIPTION, app, examples
from tactomo.cli.files import DescriptionOption

models_app = typer.Typer(
    help="Build and list the models of sensors.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)
app.add_typer(models_app, name="models", rich_help_panel=BUILD)


@models_app.command(
    epilog=examples(
        "tactomo models build",
        "tactomo models build --sensor my_skin.toml",
        "tactomo models build --sensor my_skin.toml --output my_skin.npz",
    ),
)
def build(
    sensor: DescriptionOption = DEFAULT_DESCRIPTION,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="[the cache, where the daemon looks]")
    ] = None,
) -> None:
    """Build the models of a sensor description: forward model, Jacobian, Tikhonov matrix.

    The daemon does this by itself when they are missing; building ahead spares its first start.
    They are bound to the description by a hash: after a change of geometry, build again.
    """
    from rich.console import Console
    from tactomo_models import ArtifactError, load_description
    from tactomo_models.artifact import build_artifact, default_path, load_artifact, save_artifact

    description = load_description(sensor)
    path = output or default_path(description)
    try:
        load_artifact(path, description)
        typer.echo(f"{path} is up to date")
        return
    except ArtifactError:  # missing, damaged, or of another sensor or version: build it
        pass
    with Console(stderr=True).status(description.name) as shown:
        artifact = build_artifact(
            description, lambda step: shown.update(f"{description.name}: {step}")
        )
        save_artifact(artifact, path)
    typer.echo(f"wrote {path}")


@models_app.command(epilog=examples("tactomo models copy sciospec_disc tank.toml"))
def copy(
    name: Annotated[str, typer.Argument(help="Of those that `tactomo models list` shows.")],
    path: Annotated[Path, typer.Argument(metavar="FILE.toml", help="The file to write.")],
) -> None:
    """Copy a shipped sensor description to a file of your own, to be changed there."""
    from tactomo_models.description_file import shipped_text

    from tactomo.errors import TactomoError

    text = shipped_text(name)
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise TactomoError(
            f"cannot write {path}: {error.strerror}", "give the path of a file that is not there"
        ) from error
    typer.echo(f"wrote {path}; give it to --description, or --sensor")


@models_app.command(name="list")
def list_sensors() -> None:
    """List the sensor descriptions that come with tactomo."""
    from tactomo_models import load_description
    from tactomo_models.description_file import shipped_descriptions

    for name in shipped_descriptions():
        typer.echo(f"{name}  {load_description(name).title}")

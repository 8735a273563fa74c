"""`tactomo models simulate`: the scenes that networks are trained on."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tactomo.cli.app import DEFAULT_DESCRIPTION, JsonOutput, examples
from tactomo.cli.files import DescriptionOption
from tactomo.cli.models import models_app
from tactomo.cli.plot import prepare_picture
from tactomo.errors import TactomoError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, Task

EXTRA = frozenset({"dask", "distributed", "joblib", "onnx", "onnxscript", "torch"})
INTERRUPTED = 130

Picture = Annotated[
    Path | None,
    typer.Option(help="Draw some of the scenes: .png, .svg or .pdf. Needs matplotlib."),
]


@models_app.command(
    epilog=examples(
        "tactomo models simulate scenes/robust",
        "tactomo models simulate scenes/paper --preset paper --picture paper.png",
        "tactomo models simulate scenes/mine --sensor my_skin.toml --scenes 8000 --jobs 4",
        "tactomo models simulate scenes/robust --dask tcp://scheduler:8786",
    ),
)
def simulate(
    folder: Annotated[Path, typer.Argument(help="Where the scenes go; made if missing.")],
    preset: Annotated[
        Literal["paper", "robust"],
        typer.Option(
            help="As the paper's, or with errors as real skins have them and any contacts."
        ),
    ] = "robust",
    scenes: Annotated[
        int | None, typer.Option(min=1, help="How many. [paper: 12000, robust: 24000]")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the whole set.")] = 0,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Processes. [one for each core]", show_default=False)
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Let the workers of this Dask scheduler simulate; they need tactomo, not FOLDER.",
        ),
    ] = None,
    sensor: DescriptionOption = DEFAULT_DESCRIPTION,
    picture: Picture = None,
    as_json: JsonOutput = False,
) -> None:
    """Simulate scenes to train networks on: voltages of both channels, and the truth.

    Ctrl-C stops it, and the same command goes on where it stopped; with a larger --scenes a
    finished set grows. Scenes depend on the preset, the seed and their number alone, whatever
    makes them, and none is one of `tactomo evaluate`. Reckon with a tenth of a second for each on
    one core, and 2 MB for a thousand.

    *paper*: one to four ellipses that do not overlap, 0.75 to 0.95 S/m on an even sheet of 1 S/m,
    100 S/m in the structure channel. *robust*: none to six contacts of several shapes, flat or
    domed, lighter and heavier than the range as well; both signs; contrast 10 to 100; uneven
    sheets; uneven, displaced and now and then weak electrodes. Noise is added in training.

    Needs `pip install 'tactomo[train]'`; Dask comes with it.
    """
    from tactomo_models import load_description
    from tactomo_models.training.presets import SCENES
    from tactomo_models.training.simulate import simulate as simulate_scenes

    if picture is not None:
        prepare_picture(picture)
    description = load_description(sensor)
    total = scenes or SCENES[preset]
    steps = simulate_scenes(
        description, preset, folder, total, seed=seed, jobs=jobs or -1, dask=dask
    )
    with _training_extra():
        before, now = _follow(steps, total, f"{preset} scenes", folder)
    if as_json:
        settings = {"folder": str(folder), "preset": preset, "seed": seed}
        counts = {"scenes": before + now, "new": now}
        typer.echo(json.dumps({**settings, "sensor": description.name, **counts}))
    else:
        typer.echo(f"{folder}: {total} {preset} scenes, {now} of them new")
    if picture is not None:
        from tactomo_models.training.simulate import read_scenes

        from tactomo.cli.models_training_pictures import draw_scenes

        draw_scenes(read_scenes(folder), description, f"{preset} scenes, simulated", picture)
        typer.echo(f"wrote {picture}", err=True)


def _follow(steps: Iterator[int], total: int, what: str, folder: Path) -> tuple[int, int]:
    """Show the progress of a simulation.

    Returns:
        How many scenes were there before, and how many are new.
    """
    from rich.console import Console

    with _progress(Console(stderr=True)) as shown:
        before = done = next(steps)
        task = shown.add_task(what, total=total, completed=before, before=before)
        try:
            for more in steps:
                done += more
                shown.advance(task, more)
        except KeyboardInterrupt:
            shown.stop()
            typer.echo(
                f"stopped: {folder} has {done} of {total} scenes; run the same command again, it "
                "goes on there",
                err=True,
            )
            raise typer.Exit(INTERRUPTED) from None
    return before, done - before


def _progress(console: Console) -> Progress:
    """A bar with the rate and the time left, by what this run did, not those before it."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn
    from rich.text import Text

    class Pace(ProgressColumn):
        def render(self, task: Task) -> Text:
            made = task.completed - task.fields["before"]
            if not made or not task.elapsed or task.total is None:
                return Text("")
            rate = made / task.elapsed
            left = timedelta(seconds=round((task.total - task.completed) / rate))
            return Text(f"{rate:.1f}/s, {left} left")

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        Pace(),
        console=console,
        transient=True,
    )


@contextmanager
def _training_extra() -> Iterator[None]:
    """Tell what to install where a package that only training needs is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in EXTRA:
            raise
        raise TactomoError(
            f"training needs {error.name}, which is not installed",
            "pip install 'tactomo[train]'; without a GPU, a smaller PyTorch first: "
            "pip install torch --index-url https://download.pytorch.org/whl/cpu",
        ) from error

"""`tactomo models simulate` and `train`: scenes to learn from, and the network."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import typer
from tactomo.cli.options import DEFAULT_DESCRIPTION, Description, examples, typer_app
from tactomo.cli.output import say
from tactomo.errors import needs

if TYPE_CHECKING:
    from tactomo_lab.training.configurations import Prepared
    from tactomo_lab.training.train import Epoch, Settings, Training

EXTRA = (
    "pip install 'tactomo-lab[train]'; without a GPU, install the smaller PyTorch for CPUs first: "
    "see https://pytorch.org/get-started"
)
INTERRUPTED = 130

# The models' WIDTHS, which are not imported for a command line that only shows its help.
ConfigurationName: TypeAlias = Literal["ours", "ours-small"]

app = typer_app()


@app.command(
    epilog=examples(
        "tactomo models simulate scenes/robust",
        "tactomo models simulate scenes/mine -d my_skin.toml --scenes 8000 --jobs 4",
    )
)
def simulate(
    folder: Annotated[Path, typer.Argument(help="Folder for the scenes; made if missing.")],
    scenes: Annotated[int, typer.Option(min=1, max=10_000_000, help="How many.")] = 24000,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the whole set.")] = 0,
    jobs: Annotated[
        int | None,
        typer.Option(min=1, max=1024, help="Processes. [one for each core]", show_default=False),
    ] = None,
    sensor: Description = DEFAULT_DESCRIPTION,
) -> None:
    """Simulate scenes to train networks on: voltages of both channels, and the truth.

    FOLDER gets one file, when the last scene is done. Scenes depend only on the seed and their
    number, and none is a scene of `tactomo evaluate`. A scene takes a tenth of a second on one
    core, a thousand scenes take 2 MB.

    Scenes have none to ten contacts of several shapes, flat or soft, also lighter and heavier than
    the range; both signs; contrast 10 to 100; sheets up to as uneven as hand-made sheets; uneven,
    displaced and sometimes weak electrodes. Training adds the noise.
    """
    from tactomo.cli.console import progress
    from tactomo_models import load_description

    from tactomo_lab.training.training_scenes import simulate as simulate_scenes

    description = load_description(sensor)
    steps = simulate_scenes(description, folder, scenes, seed=seed, jobs=jobs)
    with progress(speed_estimate_period=600) as bar:
        task = bar.add_task("scenes", total=scenes)
        for more in steps:
            bar.advance(task, more)
    say(f"{folder}: {scenes} scenes")


@app.command(
    epilog=examples(
        "tactomo models train scenes/robust",
        "tactomo models train scenes/robust --epochs 5 --output trial.onnx",
    )
)
def train(
    folder: Annotated[Path, typer.Argument(help="Scenes, from `tactomo models simulate`.")],
    configuration: Annotated[
        ConfigurationName, typer.Option(help="The network (names above).")
    ] = "ours",
    epochs: Annotated[
        int | None,
        typer.Option(min=1, max=100_000, help="Passes over the scenes. [the configuration's]"),
    ] = None,
    batch: Annotated[
        int | None,
        typer.Option(min=1, max=1_000_000, help="Scenes in a step. [the configuration's]"),
    ] = None,
    rate: Annotated[
        float | None, typer.Option(min=1e-6, max=1.0, help="Learning rate. [the configuration's]")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of weights, order, noise and turns.")] = 0,
    device: Annotated[Literal["cpu", "cuda"], typer.Option(help="Device that computes.")] = "cpu",
    jobs: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Processes and threads. [one for each core]")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The network. [the cache, where tactomo looks]"),
    ] = None,
    checkpoint: Annotated[
        Path | None, typer.Option(help="Network to continue from. [FOLDER/CONFIGURATION.pt]")
    ] = None,
    sensor: Description = DEFAULT_DESCRIPTION,
) -> None:
    """Train a network on simulated scenes and export it to ONNX.

    Each epoch ends with a checkpoint: after Ctrl-C, the same command continues to the same network.
    Some scenes are held out; the command shows the correlation (ICC) of their maps with the truth,
    by noise and number of contacts.

    *ours* takes the voltages of all channels; *ours-small* is half as wide. Each takes one to two
    hours on two cores.

    tactomo then uses the network in the cache for this sensor, instead of the shipped network;
    delete the file to return to the shipped one. Needs `pip install 'tactomo-lab[train]'`.
    """
    from rich.text import Text
    from tactomo.cli.console import Console

    with needs("training", EXTRA):
        from tactomo_models import load_description
        from tactomo_models.methods.trained_networks import own_path

        from tactomo_lab.training.configurations import (
            KIND,
            SETTINGS,
            WIDTHS,
            export_trained,
            prepare,
        )
        from tactomo_lab.training.train import use

        use(device, jobs)
        description = load_description(sensor)
        settings = replace(
            SETTINGS,
            epochs=epochs or SETTINGS.epochs,
            batch=batch or SETTINGS.batch,
            rate=rate or SETTINGS.rate,
            seed=seed,
            device=device,
        )
        with Console(stderr=True).status(Text(f"reading {folder}")):
            prepared = prepare(WIDTHS[configuration], folder, description, seed)
        kept = checkpoint or folder / f"{configuration}.pt"
        training = _train(prepared, settings, kept, configuration)
        written = output or own_path(description, KIND)
        export_trained(prepared, training, written)
    say(f"wrote {written}: {written.stat().st_size / 1e6:.1f} MB")


def _train(
    prepared: Prepared, settings: Settings, checkpoint: Path, configuration: str
) -> Training:
    """Train to the end, and print what each epoch came to."""
    from tactomo.cli.console import Console, progress

    from tactomo_lab.training.train import begin, load_checkpoint, train

    console = Console(stderr=True)
    training = begin(prepared.network, settings)
    if checkpoint.exists():
        load_checkpoint(training, settings, checkpoint)
        console.print(f"going on after epoch {len(training.history)}, from {checkpoint}")
    with progress(speed_estimate_period=600) as shown:
        task = shown.add_task("")

        def report(step: int, steps: int, loss: float) -> None:
            epoch = len(training.history)
            name = f"{configuration}, epoch {epoch + 1} of {settings.epochs}, loss {loss:.4f}"
            done = epoch * steps + step
            shown.update(task, description=name, total=settings.epochs * steps, completed=done)

        try:
            for epoch in train(training, prepared.objective, settings, checkpoint, report):
                line = _in_words(epoch, len(training.history))
                shown.console.print(line, highlight=False, soft_wrap=True)
        except KeyboardInterrupt:
            done = f"{checkpoint} has {len(training.history)} of {settings.epochs} epochs"
            say(f"stopped: {done}; run the same command again, it goes on there", err=True)
            raise typer.Exit(INTERRUPTED) from None
    return training


def _in_words(epoch: Epoch, number: int) -> str:
    """One line: the loss, and the held-out correlations of each level of noise."""
    rows: dict[str, list[tuple[str, float]]] = {}
    for name, value in epoch.held_out.items():  # by names such as "40 dB, 2"
        noise, _, contacts = name.rpartition(", ")
        rows.setdefault(noise, []).append((contacts, value))
    names = "/".join(name for name, _ in next(iter(rows.values()), []))
    parts = [
        f"{noise} " + "/".join("–" if math.isnan(icc) else f"{icc:.3f}" for _, icc in row)
        for noise, row in rows.items()
    ]
    return f"epoch {number}: loss {epoch.loss:.4f}; held-out ICC ({names}): {', '.join(parts)}"

"""`tactomo evaluate ktc`: tanks of the Kuopio Tomography Challenge, scored as it scores them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from tactomo.cli.options import Description, JsonOutput, examples, typer_app
from tactomo.cli.output import print_json, say, table
from tactomo.cli.plot.plot import save_figure

from tactomo_lab.commands.measured import tank_of
from tactomo_lab.commands.report import Picture, shown

if TYPE_CHECKING:
    from tactomo_lab.evaluation.ktc import Challenge, ChallengeOutcome

app = typer_app()


@app.command(
    epilog=examples(
        "tactomo evaluate ktc ktc2023_training.npz --picture ktc.png",
        "tactomo evaluate ktc ktc2023_training.npz --level 7 --json",
    )
)
def ktc(
    file: Annotated[Path, typer.Argument(metavar="FILE.npz", help="Tanks, see above.")],
    level: Annotated[
        int | None,
        typer.Option(min=1, max=7, help="Lose the electrodes that this level has lost, too."),
    ] = None,
    sensor: Description = "tank_ktc2023",
    picture: Picture = None,
    as_json: JsonOutput = False,
) -> None:
    """Segment tanks of the Kuopio Tomography Challenge 2023, and score them as it did.

    FILE holds `injection` (T, 32, 76), the currents of each drive; `measurement` (32, 31), the
    weights of the electrodes' potentials; `reference` and `voltages` (T, 2356), drive by drive, of
    the empty and the full tank, nan where electrodes are lost; `truth` (T, 256, 256), 0 water, 1
    conducts worse, 2 better; and `level` (T,).

    A tank's score is the mean structural similarity of both kinds' images, 1 at best. A network
    trained on simulated tanks alone makes objects of five linear images, and these are refined
    until they explain the voltages. Level l of 1 to 7 loses the first 2 (l - 1) electrodes.
    """
    from tactomo_lab.evaluation.ktc import evaluate_challenge, read_challenge

    description = tank_of(sensor)
    given = read_challenge(file, description)
    if level is not None:
        given = given.at_level(level)
    tanks = list(shown(evaluate_challenge(given, description), len(given.truth), "tanks"))
    if as_json:
        told = ("level", "readings", "score", "misfit", "seconds")
        each = [{name: getattr(tank, name) for name in told} for tank in tanks]
        print_json({"simulated": False, "score": sum(t.score for t in tanks), "tanks": each})
    else:
        _print(tanks)
    if picture is not None:
        _draw(given, tanks, picture)
        say(f"wrote {picture}", err=True)


def _print(tanks: list[ChallengeOutcome]) -> None:
    from tactomo.cli.console import Console

    made = table("tank", "level", "readings", "score", "misfit", "CPU s")
    for number, tank in enumerate(tanks):
        figures = f"{tank.score:.3f}", f"{tank.misfit:.2f}", f"{tank.seconds:.1f}"
        made.add_row(str(number), str(tank.level), str(tank.readings), *figures)
    made.add_section()
    made.add_row("sum", "", "", f"{sum(tank.score for tank in tanks):.3f}", style="bold")
    Console().print(made)


def _draw(given: Challenge, tanks: list[ChallengeOutcome], output: Path) -> None:
    """Draw the truth above what was found, a column for each tank."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1.5 * len(tanks), 3.2), layout="constrained")
    panels: Any = figure.subplots(2, len(tanks), squeeze=False)
    for column, (truth, tank) in enumerate(zip(given.truth, tanks, strict=True)):
        for panel, image in zip(panels[:, column], (truth, tank.image), strict=True):
            panel.imshow(image, vmin=0, vmax=2)
            panel.set_axis_off()
        panels[0, column].set_title(f"level {tank.level}", fontsize=7)
        panels[1, column].set_title(f"{tank.score:.3f}", fontsize=7)
    save_figure(figure, output)

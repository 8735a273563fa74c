"""`tactomo evaluate tanks` and `skin`: sets of measured scans whose truth is known."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from tactomo.cli.options import Description, JsonOutput, examples, method_option, typer_app
from tactomo.cli.output import print_json, table
from tactomo.cli.plot.plot import save_figure
from tactomo.errors import TactomoError

from tactomo_lab.commands.evaluate import Picture, shown

if TYPE_CHECKING:
    from rich.status import Status

    from tactomo_lab.evaluation.tanks import TankOutcome, Tanks

app = typer_app()


@app.command(
    epilog=examples(
        "tactomo evaluate tanks tank_uef2017.npz --picture tanks.png",
        "tactomo evaluate tanks tank_uef2017.npz --method network --scale 0.78",
    )
)
def tanks(
    scans: Annotated[Path, typer.Argument(metavar="IN.npz", help="Measured tanks, see above.")],
    method: Annotated[
        str | None, method_option(" [tikhonov, noser and network, side by side]")
    ] = None,
    scale: Annotated[
        float | None,
        typer.Option(
            min=1e-30, help="Volts per ampere in a sheet of 1 S, per unit of dv. [not known]"
        ),
    ] = None,
    sensor: Description = "tank_uef2017",
    picture: Picture = None,
    as_json: JsonOutput = False,
) -> None:
    """Reconstruct round tanks with objects in them and compare with what stood there.

    IN holds `dv` (n, M), by how much each voltage grew when the objects came in, on one unknown
    scale common to all; `truth` (n, rows, columns), 1 in what conducts better than the saline and
    -1 in what conducts worse, row 0 at the top, the disc filling the picture; and `name` (n,).

    The figure is the Pearson correlation of the structure map with the truth over the disc.
    *network* makes objects of linear images and refines them, as in `tactomo evaluate ktc`; where
    the scale is not known, it averages over all that are likely. Its confidence is the correlation
    to expect. Other methods are the daemon's, which take the middle one of these scales.
    """
    from tactomo_models import load_description

    from tactomo_lab.evaluation.tanks import TankImager, evaluate_tanks, read_tanks

    description = load_description(sensor)
    if description.channels != ("structure",):
        raise TactomoError(
            f"{description.name!r} is no tank: it has a magnitude channel",
            "give a description of one channel, such as tank_uef2017",
        )
    methods = [method] if method else ["tikhonov", "noser", "network"]
    with _status("reading"):
        measured = read_tanks(scans, description)
        imager = TankImager(description)
    total = len(methods) * len(measured.names)
    outcomes = list(shown(evaluate_tanks(imager, measured, methods, scale), total, "tanks"))
    facts = {"simulated": False, "sensor": description.name, "scale": scale}
    if as_json:
        print_json({**facts, **_tanks_as_json(methods, outcomes)})
    else:
        _print_tanks(facts, methods, outcomes)
    if picture is not None:
        _draw_tanks(measured, methods, outcomes, picture)
        typer.echo(f"wrote {picture}", err=True)


def _status(what: str) -> Status:
    from rich.console import Console

    return Console(stderr=True).status(what)


def _mean(outcomes: Sequence[TankOutcome], method: str) -> float:
    of_method = [outcome.correlation for outcome in outcomes if outcome.method == method]
    return sum(of_method) / len(of_method)


def _tanks_as_json(methods: Sequence[str], outcomes: Sequence[TankOutcome]) -> dict[str, Any]:
    told = ("name", "method", "correlation", "misfit", "confidence", "seconds")
    return {
        "mean_correlation": {method: _mean(outcomes, method) for method in methods},
        "tanks": [{name: getattr(outcome, name) for name in told} for outcome in outcomes],
    }


def _print_tanks(
    facts: dict[str, Any], methods: Sequence[str], outcomes: Sequence[TankOutcome]
) -> None:
    from rich.console import Console

    made = table("correlation with the truth", *methods, "confidence")
    by_tank = [outcomes[i : i + len(methods)] for i in range(0, len(outcomes), len(methods))]
    for of_tank in by_tank:
        figures = (f"{outcome.correlation:.3f}" for outcome in of_tank)
        sure = [f"{o.confidence:.2f}" for o in of_tank if o.method == "network"]
        made.add_row(of_tank[0].name, *figures, *sure)
    made.add_section()
    means = (f"{_mean(outcomes, method):.3f}" for method in methods)
    made.add_row("[bold]mean[/]", *(f"[bold]{mean}[/]" for mean in means))
    longest = (max(o.seconds for o in outcomes if o.method == method) for method in methods)
    made.add_row("seconds, longest", *(f"{seconds:.2f}" for seconds in longest))
    console = Console()
    scale = "not known" if facts["scale"] is None else f"{facts['scale']:.3g}"
    console.print(f"measured tanks, {facts['sensor']}, scale {scale}")
    console.print(made)


def _draw_tanks(
    measured: Tanks, methods: Sequence[str], outcomes: Sequence[TankOutcome], output: Path
) -> None:
    """Draw the truth above each method's image, a column for each tank."""
    from matplotlib.figure import Figure

    columns, rows = len(measured.names), 1 + len(methods)
    figure = Figure(figsize=(1.5 * columns, 1.8 * rows), layout="constrained")
    panels: Any = figure.subplots(rows, columns, squeeze=False)
    for column, (name, truth) in enumerate(zip(measured.names, measured.truth, strict=True)):
        of_tank = outcomes[column * len(methods) : (column + 1) * len(methods)]
        images = [(truth, name)]
        images += [(o.image, f"{o.method} {o.correlation:.2f}") for o in of_tank]
        for panel, (image, title) in zip(panels[:, column], images, strict=True):
            panel.imshow(image, cmap="RdBu_r", vmin=-1, vmax=1)
            if truth.any():
                panel.contour(truth, [-0.5, 0.5], colors="black", linewidths=0.5)
            panel.set_title(title, fontsize=7)
            panel.set_axis_off()
    save_figure(figure, output)


@app.command(
    epilog=examples(
        "tactomo evaluate skin skin_round_presses.npz",
        "tactomo evaluate skin presses.npz -d my_round_skin.toml --json",
    )
)
def skin(
    presses: Annotated[Path, typer.Argument(metavar="IN.npz", help="Robot presses, see above.")],
    sensor: Description = "skin_round",
    as_json: JsonOutput = False,
) -> None:
    """Locate a robot's presses on a real skin, and compare with where it pressed.

    IN holds `lookup` (M, 4), the source, sink, v+ and v- electrode of each voltage; `dv` (n, M),
    by how much each voltage grew under the press; and `pos_m` (n, 2), where the robot pressed, in
    its own frame. How the skin lies in that frame is fitted to some presses and judged on others.
    """
    from rich.console import Console
    from tactomo_models import load_description

    from tactomo_lab.evaluation.skin_presses import localise, read_presses

    description = load_description(sensor)
    with _status("locating"):
        measured = read_presses(presses, description)
        found = localise(measured, description)
    if as_json:
        facts = {one.method: {"median_mm": one.median_mm, "most_mm": one.most_mm} for one in found}
        print_json({"presses": len(measured.changes), "methods": facts})
        return
    made = table("localisation error, mm", "median", "95 %")
    for one in found:
        made.add_row(one.method, f"{one.median_mm:.1f}", f"{one.most_mm:.1f}")
    console = Console()
    console.print(f"{len(measured.changes)} measured presses, {description.name}, cross-validated")
    console.print(made)

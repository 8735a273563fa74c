"""`tactomo evaluate measured`, `ktc` and `presses`: measured sets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

import typer
from tactomo.cli.options import Description, JsonOutput, examples, typer_app
from tactomo.cli.output import say, table
from tactomo.errors import TactomoError

from tactomo_lab.commands.report import shown, tell

if TYPE_CHECKING:
    from tactomo.cli.console import Console
    from tactomo_models import SensorDescription

app = typer_app()


class Measured(NamedTuple):
    """What a set shows: its figure, tables with their captions, all for programs."""

    ours: str
    details: list[str]
    facts: dict[str, Any]


class Kind(NamedTuple):
    """A kind of measured sets."""

    arrays: tuple[str, ...]  # what sets of the kind are recognised by: the names of their arrays
    description: str  # the shipped sensor that public sets are of
    measure: Callable[[Path, str], Measured]  # what measures a set, of its path and its sensor


def tank_of(sensor: str) -> SensorDescription:
    """Load the description of a round tank.

    Raises TactomoError where it is none.
    """
    from tactomo_models import load_description

    description = load_description(sensor)
    if description.sheet.shape != "disc" or description.channels != ("structure",):
        raise TactomoError(
            f"{description.name!r} is no round tank",
            "give a description of one, such as tank_uef2017 or tank_ktc2023",
        )
    return description


def saline_tanks(path: Path, sensor: str) -> Measured:
    """Correlate images of tanks with the truth, by three methods."""
    from scipy.stats import spearmanr

    from tactomo_lab.evaluation.tanks import TankImager, evaluate_tanks, read_tanks

    tank = tank_of(sensor)
    methods = ["network", "noser", "tikhonov"]
    tanks = read_tanks(path, tank)
    made = evaluate_tanks(TankImager(tank), tanks, methods)
    found = list(shown(made, len(methods) * len(tanks.names), "tanks"))
    of = {name: [one for one in found if one.method == name] for name in methods}
    ours, noser, tikhonov = (_mean([one.correlation for one in of[name]]) for name in methods)
    ranks = spearmanr(
        [one.confidence for one in of["network"]], [one.correlation for one in of["network"]]
    )
    details = [
        "Correlation with the truth:",
        *_table(
            ["tank", *methods, "confidence"],
            [
                [one[0].name, *(f"{o.correlation:.3f}" for o in one), f"{one[0].confidence:.2f}"]
                for one in zip(*of.values(), strict=True)
            ],
        ),
        f"The network's confidence ranks them by {ranks.statistic:.2f} (Spearman).",
    ]
    told = ("name", "method", "correlation", "misfit", "confidence", "seconds")
    facts = {
        "mean_correlation": {"network": ours, "noser": noser, "tikhonov": tikhonov},
        "tanks": [{name: getattr(one, name) for name in told} for one in found],
    }
    return Measured(f"{ours:.3f} (NOSER {noser:.2f}, Tikhonov {tikhonov:.2f})", details, facts)


def round_skin(path: Path, sensor: str) -> Measured:
    """Locate a robot's presses by several methods, cross-validated."""
    from tactomo_models import load_description

    from tactomo_lab.evaluation.skin_presses import METHODS, localise, read_presses

    skin = load_description(sensor)
    presses = read_presses(path, skin)
    found = list(shown(localise(presses, skin), len(METHODS), "methods"))
    physics = min(one.median_mm for one in found if "image" in one.method)
    taught = min(one.median_mm for one in found if "taught" in one.method)
    rows = [[one.method, f"{one.median_mm:.1f}", f"{one.most_mm:.1f}"] for one in found]
    return Measured(
        f"{taught:.1f} mm (median) taught by the other presses; {physics:.1f} mm by physics alone",
        ["Ten folds:", *_table(["error, mm", "median", "95 %"], rows)],
        {
            "presses": len(presses.changes),
            "methods": {
                one.method: {"median_mm": one.median_mm, "most_mm": one.most_mm} for one in found
            },
        },
    )


KINDS: Final = (
    Kind(("dv", "truth", "name"), "tank_uef2017", saline_tanks),
    Kind(("lookup", "dv", "pos_m"), "skin_round", round_skin),
)


@app.command(
    epilog=examples(
        "tactomo evaluate measured tank_uef2017.npz",
        "tactomo evaluate measured my_tanks.npz -d my_tank.toml --json",
    )
)
def measured(
    path: Annotated[
        Path, typer.Argument(metavar="FILE.npz", help="A public set, or one of your own.")
    ],
    sensor: Annotated[
        str | None,
        typer.Option("--description", "-d", help="Sensor of FILE. [the public set's]"),
    ] = None,
    as_json: JsonOutput = False,
) -> None:
    """Evaluate a measured set; prints Markdown.

    The arrays of FILE tell its kind. *Tanks with objects*: `dv` (n, M), the
    increase of each voltage by the objects, on one unknown scale common to all; `truth` (n, rows,
    columns), 1 where an object conducts better than the saline and -1 where worse, row 0 at the
    top, the disc filling the picture; `name` (n,). The figure is the Pearson correlation of the
    image with the truth over the disc; the network's confidence is the expected correlation.
    *Presses of a robot*: `lookup` (M, 4), the source, sink, v+ and v- electrode of each voltage;
    `dv` (n, M); `pos_m` (n, 2), the places in the robot's frame. Some presses fit the skin's place
    in that frame, the others judge it. `tactomo evaluate ktc` and `presses` take the other sets of
    docs/measured.md, which has the best published figures beside ours.
    """
    from threadpoolctl import threadpool_limits

    kind = _recognised(path)
    say(f"measuring {path.name}", err=True)
    with threadpool_limits(1):  # more threads wait for each other where others compute, too
        found = kind.measure(path, sensor or kind.description)
    text = "\n".join([f"{path.name}: {found.ours}", "", *found.details])
    told = {"simulated": False, "sets": {path.name: found.facts}}
    tell(told, as_json, lambda _: say(text))


def _recognised(path: Path) -> Kind:
    """Return the kind that a file has the arrays of.

    Raises TactomoError where the file cannot be read, or has the arrays of none.
    """
    from tactomo_lab.evaluation.measured_sets import read_set

    names = list(read_set(path, "measured scans"))
    for each in KINDS:
        if set(each.arrays) <= set(names):
            return each
    known = "; ".join(", ".join(each.arrays) for each in KINDS)
    raise TactomoError(
        f"{path} is no set of measured scans: it holds {', '.join(names) or 'nothing'}",
        f"give the arrays of one: {known}",
    )


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = [heads, ["---"] * len(heads), *rows]
    return ["", *(f"| {' | '.join(cells)} |" for cells in lines), ""]


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


# ------------------------------------------------------------------ one kind of set each


@app.command(
    epilog=examples(
        "tactomo evaluate ktc ktc2023_training.npz",
        "tactomo evaluate ktc ktc2023_training.npz --level 7 --json",
    )
)
def ktc(
    file: Annotated[Path, typer.Argument(metavar="FILE.npz", help="Tanks (format above).")],
    level: Annotated[
        int | None,
        typer.Option(min=1, max=7, help="Leave out the electrodes that this level has lost."),
    ] = None,
    sensor: Description = "tank_ktc2023",
    as_json: JsonOutput = False,
) -> None:
    """Segment tanks of the Kuopio Tomography Challenge 2023, and score them by its rules.

    FILE holds `injection` (T, 32, 76), the currents of each drive; `measurement` (32, 31), the
    weights of the electrodes' potentials; `reference` and `voltages` (T, 2356), drive by drive, of
    the empty and the full tank, NaN where electrodes are lost; `truth` (T, 256, 256), 0 water, 1
    conducts worse, 2 better; and `level` (T,).

    A tank's score is the mean structural similarity of both kinds' images; 1 is best. A network,
    trained on simulated tanks alone, turns five linear images into objects, and a level set refines
    the objects until they explain the voltages. Level l of 1 to 7 loses the first 2 (l - 1)
    electrodes.
    """
    from tactomo_lab.evaluation.ktc import evaluate_challenge, read_challenge

    description = tank_of(sensor)
    given = read_challenge(file, description)
    if level is not None:
        given = given.at_level(level)
    tanks = list(shown(evaluate_challenge(given, description), len(given.truth), "tanks"))
    total = sum(tank.score for tank in tanks)
    attributes = ("level", "readings", "score", "misfit", "seconds")
    each = [{name: getattr(tank, name) for name in attributes} for tank in tanks]

    def show(console: Console) -> None:
        made = table("tank", "level", "readings", "score", "misfit", "CPU s")
        for number, tank in enumerate(tanks):
            figures = f"{tank.score:.3f}", f"{tank.misfit:.2f}", f"{tank.seconds:.1f}"
            made.add_row(str(number), str(tank.level), str(tank.readings), *figures)
        made.add_section()
        made.add_row("sum", "", "", f"{total:.3f}", style="bold")
        console.print(made)

    told = {"simulated": False, "score": total, "tanks": each}
    tell(told, as_json, show)


@app.command(
    epilog=examples(
        "tactomo evaluate presses skins_anisotropy.npz --train 100",
        "tactomo evaluate presses skins_anisotropy.npz --train 800 --json",
    )
)
def presses(
    skins: Annotated[Path, typer.Argument(metavar="FILE.npz", help="Presses (format above).")],
    train: Annotated[int, typer.Option(min=1, help="Presses to learn from.")] = 200,
    as_json: JsonOutput = False,
) -> None:
    """Learn each skin from its first presses, and locate its last 800.

    FILE holds for each skin NAME_voltages (P, M), the voltage changes of each press, and NAME_xy_mm
    (P, 2), the places, both in order of time. If fewer than 800 presses are left after learning,
    half of the remaining presses are judged. Each skin is learnt from its own presses alone; the
    sheets' make does not matter.
    """
    from threadpoolctl import threadpool_limits

    from tactomo_lab.evaluation.taught_presses import judge, read_skins

    known = read_skins(skins)
    with threadpool_limits(1):
        found = list(shown(judge(known, train), len(known), "skins"))

    def show(console: Console) -> None:
        made = table("error, mm", "judged", "median", "95 %", "in σ", "taught", "since then")
        for one in found:
            errors = (f"{one.median_mm:.2f}", f"{one.p95_mm:.1f}")
            shares = (f"{one.within_sigma:.0%}", f"{one.is_taught:.0%}")
            since = " ".join(f"{median:.1f}" for median in one.median_mm_since)
            made.add_row(one.name, str(one.judged), *errors, *shares, since)
        made.add_section()
        means = (_mean([getattr(one, of) for one in found]) for of in ("median_mm", "p95_mm"))
        made.add_row("mean", "", *(f"{mean:.2f}" for mean in means), style="bold")
        console.print(f"measured presses, learnt from the first {train} of each skin")
        console.print(made)
        console.print(
            "in σ: coordinates within one reported standard uncertainty, 68 % where that is "
            "right; taught: presses of which the like was taught; since then: medians of the "
            "quarters of all later presses.",
            style="dim",
        )

    tell({"skins": [asdict(one) for one in found]}, as_json, show)

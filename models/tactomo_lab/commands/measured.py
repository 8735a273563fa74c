"""`tactomo evaluate measured`, `ktc` and `presses`: measured sets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from fnmatch import filter as matching
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

import typer
from tactomo.cli.options import Description, JsonOutput, examples, typer_app
from tactomo.cli.output import say, table
from tactomo.errors import TactomoError

from tactomo_lab.commands.report import Finding, shown, tell

if TYPE_CHECKING:
    from tactomo.cli.console import Console
    from tactomo_models import SensorDescription

app = typer_app()
File = Annotated[Path, typer.Argument(metavar="FILE.npz", help="A set of arrays (format below).")]


class Kind(NamedTuple):
    """A kind of measured sets."""

    arrays: tuple[str, ...]  # what sets of the kind are recognised by: patterns of arrays' names
    description: str  # the shipped sensor that public sets are of
    measure: Callable[[Path, str], Finding]  # what measures a set, of its path and its sensor


def _tank_of(sensor: str) -> SensorDescription:
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


def _saline_tanks(path: Path, sensor: str) -> Finding:
    """Correlate images of tanks with the truth, by three methods."""
    import numpy as np
    from scipy.stats import spearmanr

    from tactomo_lab.evaluation.tanks import TankImager, evaluate_tanks, read_tanks

    tank = _tank_of(sensor)
    methods = ["network", "noser", "tikhonov"]
    tanks = read_tanks(path, tank)
    made = evaluate_tanks(TankImager(tank), tanks, methods)
    found = list(shown(made, len(methods) * len(tanks.names), "tanks"))
    of = {name: [one for one in found if one.method == name] for name in methods}
    means = {name: float(np.mean([one.correlation for one in of[name]])) for name in methods}
    network = of["network"]
    ranks = spearmanr([one.confidence for one in network], [one.correlation for one in network])
    rows = table("tank", *methods, "confidence")
    for one in zip(*of.values(), strict=True):
        correlations = (f"{each.correlation:.3f}" for each in one)
        rows.add_row(one[0].name, *correlations, f"{one[0].confidence:.2f}")
    told = ("name", "method", "correlation", "misfit", "confidence", "seconds")
    return Finding(
        "mean correlation with the truth: "
        + ", ".join(f"{name} {mean:.3f}" for name, mean in means.items()),
        rows,
        f"The network's confidence ranks the tanks by {ranks.statistic:.2f} (Spearman).",
        {
            "mean_correlation": means,
            "tanks": [{name: getattr(one, name) for name in told} for one in found],
        },
    )


def _round_skin(path: Path, sensor: str) -> Finding:
    """Locate a robot's presses by physics and by teaching, cross-validated."""
    import numpy as np
    from tactomo_models import load_description

    from tactomo_lab.evaluation.presses import localise, read_presses

    skin = load_description(sensor)
    presses = read_presses(path, skin)
    found = {
        name: {"median_mm": float(np.median(mm)), "most_mm": float(np.quantile(mm, 0.95))}
        for name, mm in shown(localise(presses, skin), 2, "methods")
    }
    rows = table("error, mm", "median", "95 %")
    for name, one in found.items():
        rows.add_row(name, *(f"{mm:.1f}" for mm in one.values()))
    count = len(presses.changes)
    facts = {"presses": count, "methods": found}
    return Finding(f"{count} presses located", rows, "Judged in ten folds.", facts)


def _challenge(path: Path, sensor: str, level: int | None = None) -> Finding:
    """Score the challenge's tanks, without the electrodes that a level has lost."""
    from tactomo_lab.evaluation.ktc import evaluate_challenge, read_challenge

    description = _tank_of(sensor)
    given = read_challenge(path, description)
    if level is not None:
        given = given.at_level(level)
    tanks = list(shown(evaluate_challenge(given, description), len(given.truth), "tanks"))
    total = sum(tank.score for tank in tanks)
    rows = table("tank", "level", "readings", "score", "misfit", "CPU s")
    for number, tank in enumerate(tanks):
        figures = f"{tank.score:.3f}", f"{tank.misfit:.2f}", f"{tank.seconds:.1f}"
        rows.add_row(str(number), str(tank.level), str(tank.readings), *figures)
    told = ("level", "readings", "score", "misfit", "seconds")
    each = [{name: getattr(tank, name) for name in told} for tank in tanks]
    return Finding(f"sum of scores {total:.3f}", rows, "", {"score": total, "tanks": each})


def _taught_skins(path: Path, sensor: str, train: int = 200) -> Finding:
    """Learn each skin from its first presses and judge the last; any skin, whatever the sensor."""
    import numpy as np

    from tactomo_lab.evaluation.presses import judge, read_skins

    known = read_skins(path)
    found = list(shown(judge(known, train), len(known), "skins"))
    rows = table("error, mm", "judged", "median", "95 %", "in σ", "taught", "since then")
    for one in found:
        errors = (f"{one.median_mm:.2f}", f"{one.p95_mm:.1f}")
        shares = (f"{one.within_sigma:.0%}", f"{one.is_taught:.0%}")
        since = " ".join(f"{median:.1f}" for median in one.median_mm_since)
        rows.add_row(one.name, str(one.judged), *errors, *shares, since)
    return Finding(
        f"mean of medians {np.mean([one.median_mm for one in found]):.2f} mm, learnt from the "
        f"first {train} presses of each skin",
        rows,
        "in σ: coordinates within one reported standard uncertainty, 68 % where that is "
        "right; taught: presses of which the like was taught; since then: medians of the "
        "quarters of all later presses.",
        {"skins": [asdict(one) for one in found]},
    )


KINDS: Final = (
    Kind(("dv", "truth", "name"), "tank_uef2017", _saline_tanks),
    Kind(("lookup", "dv", "pos_m"), "skin_round", _round_skin),
    Kind(("injection", "measurement", "reference", "voltages"), "tank_ktc2023", _challenge),
    Kind(("*_voltages", "*_xy_mm"), "skin_round", _taught_skins),
)


def _tell(path: Path, as_json: bool, measure: Callable[[], Finding], of_sets: bool) -> None:
    """Measure a set and print what came out; as JSON by its name, where one of several kinds."""
    import scipy.linalg  # noqa: F401  # the limit is of libraries that are loaded
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):  # more threads wait for each other where others compute, too
        found = measure()

    def show(console: Console) -> None:
        console.print(f"measured, {path.name}: {found.words}")
        console.print(found.table)
        console.print(found.caption, style="dim")

    facts = {"sets": {path.name: found.facts}} if of_sets else found.facts
    tell({"simulated": False, **facts}, as_json, show)


@app.command(
    epilog=examples(
        "tactomo evaluate measured tank_uef2017.npz",
        "tactomo evaluate measured my_tanks.npz -d my_tank.toml --json",
    )
)
def measured(
    path: File,
    sensor: Annotated[
        str | None,
        typer.Option("--description", "-d", help="Sensor of FILE. [the public set's]"),
    ] = None,
    as_json: JsonOutput = False,
) -> None:
    """Evaluate a measured set of any kind.

    The arrays of FILE tell its kind. *Tanks with objects*: `dv` (n, M), the
    increase of each voltage by the objects, on one unknown scale common to all; `truth` (n, rows,
    columns), 1 where an object conducts better than the saline and -1 where worse, row 0 at the
    top, the disc filling the picture; `name` (n,). The figure is the Pearson correlation of the
    image with the truth over the disc; the network's confidence is the expected correlation.
    *Presses of a robot*: `lookup` (M, 4), the source, sink, v+ and v- electrode of each voltage;
    `dv` (n, M); `pos_m` (n, 2), the places in the robot's frame. Some presses fit the skin's place
    in that frame, the others judge it. *The challenge's tanks* and *presses on unknown skins*: see
    `tactomo evaluate ktc` and `presses`, which have options of their own. docs/measured.md has the
    best published figures beside ours.
    """
    kind = _recognised(path)
    say(f"measuring {path.name}", err=True)
    _tell(path, as_json, lambda: kind.measure(path, sensor or kind.description), of_sets=True)


def _recognised(path: Path) -> Kind:
    """Return the kind that a file has the arrays of.

    Raises TactomoError where the file cannot be read, or has the arrays of none.
    """
    from tactomo_lab.evaluation.measured_sets import read_set

    names = list(read_set(path, "measured scans"))
    for each in KINDS:
        if all(matching(names, pattern) for pattern in each.arrays):
            return each
    known = "; ".join(", ".join(each.arrays) for each in KINDS)
    raise TactomoError(
        f"{path} is no set of measured scans: it holds {', '.join(names) or 'nothing'}",
        f"give the arrays of one: {known}",
    )


@app.command(
    epilog=examples(
        "tactomo evaluate ktc ktc2023_training.npz",
        "tactomo evaluate ktc ktc2023_training.npz --level 7 --json",
    )
)
def ktc(
    file: File,
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
    _tell(file, as_json, lambda: _challenge(file, sensor, level), of_sets=False)


@app.command(
    epilog=examples(
        "tactomo evaluate presses skins_anisotropy.npz --train 100",
        "tactomo evaluate presses skins_anisotropy.npz --train 800 --json",
    )
)
def presses(
    skins: File,
    train: Annotated[int, typer.Option(min=1, help="Presses to learn from.")] = 200,
    as_json: JsonOutput = False,
) -> None:
    """Learn each skin from its first presses, and locate its last 800.

    FILE holds for each skin NAME_voltages (P, M), the voltage changes of each press, and NAME_xy_mm
    (P, 2), the places, both in order of time. If fewer than 800 presses are left after learning,
    half of the remaining presses are judged. Each skin is learnt from its own presses alone; the
    sheets' make does not matter.
    """
    _tell(skins, as_json, lambda: _taught_skins(skins, "", train), of_sets=False)

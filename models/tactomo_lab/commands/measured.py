"""`tactomo evaluate measured`, `ktc` and `presses`: measured sets, and what others say of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

import typer
from tactomo.cli.options import Description, JsonOutput, examples, typer_app
from tactomo.cli.output import say, table
from tactomo.errors import TactomoError

from tactomo_lab.commands.report import Picture, shown, tell

if TYPE_CHECKING:
    from tactomo.cli.console import Console
    from tactomo_models import SensorDescription

app = typer_app()

BEGIN: Final = "<!-- from here on by `tactomo evaluate measured`"
END: Final = "<!-- to here -->"
TRAINED: Final = (100, 200, 800)  # presses learnt from


class Measured(NamedTuple):
    """What a set shows: the figure of its row, tables with their captions, all for programs."""

    ours: str
    details: list[str]
    facts: dict[str, Any]


class PublicSet(NamedTuple):
    """A set that a reader can get.

    Attributes:
        file: what it is called.
        arrays: what sets of its kind are recognised by: how their arrays' names end.
        description: the shipped sensor that it is of; nothing where none has to be known.
        title: what it is.
        command: what measures it, behind `tactomo evaluate`.
        measure: the same, as a function of the path and the sensor.
        published: the best figure of others, with who says so; or a plain method's.
        apart: what is not comparable.
        source: where the raw data are.
    """

    file: str
    arrays: tuple[str, ...]
    description: str
    title: str
    command: str
    measure: Callable[[Path, str], Measured]
    published: str
    apart: str
    source: str


def challenge(path: Path, sensor: str) -> Measured:
    """Score the challenge's tanks at each level."""
    from tactomo_lab.evaluation.ktc import evaluate_challenge, read_challenge

    tank = tank_of(sensor)
    given = read_challenge(path, tank)
    levels = shown(range(1, 8), 7, "levels")
    tanks = [list(evaluate_challenge(given.at_level(level), tank)) for level in levels]
    means = [_mean([one.score for one in level]) for level in tanks]
    seconds = _mean([one.seconds for level in tanks for one in level])
    count = len(tanks[0])
    details = [
        f"Mean score of {count} tanks without the first 2 (level - 1) electrodes:",
        *_table(["level", *map(str, range(1, 8))], [["score", *(f"{m:.3f}" for m in means)]]),
        f"{seconds:.1f} s a tank on one core (processor time).",
    ]
    return Measured(f"{3 * sum(means):.1f} of 21", details, {"score_by_level": means})


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


def soft_skins(path: Path, sensor: str) -> Measured:
    """Learn skins from their first presses, and locate the last 800; of any make."""
    from tactomo_lab.evaluation.taught_presses import judge, read_skins

    skins, rows, means = read_skins(path), [], []
    for train in TRAINED:
        found = list(shown(judge(skins, train), len(skins), f"skins, {train} presses"))
        means.append(_mean([one.median_mm for one in found]))
        medians = [f"{one.median_mm:.1f}" for one in found]
        rows.append([str(train), *medians, f"{means[-1]:.1f}"])
    return Measured(
        f"{means[-1]:.1f} mm (mean of medians)",
        [
            "Median error, mm, by presses learnt from:",
            *_table(["presses", *(skin.name for skin in skins), "mean"], rows),
        ],
        {"mean_median_mm": dict(zip(map(str, TRAINED), means, strict=True))},
    )


SETS: Final = (
    PublicSet(
        "ktc2023_training.npz",
        ("injection", "measurement", "reference", "voltages", "truth"),
        "tank_ktc2023",
        "Kuopio Tomography Challenge 2023, 32 electrodes, sum of scores",
        "ktc FILE --level 1, to 7",
        challenge,
        "winner 15.24, other entries 12 to 15, the organisers' own 10.30 (the challenge's results)",
        "theirs are of 21 tanks that were kept back, three at each level; ours of the four "
        "training tanks at each level (mean × 21), which hold one or two objects and are easier",
        "[its public data](http://fips.fi/KTCrules.php)",
    ),
    PublicSet(
        "tank_uef2017.npz",
        ("dv", "truth", "name"),
        "tank_uef2017",
        "University of Eastern Finland 2017, saline tanks of 16 electrodes, mean correlation",
        "measured FILE",
        saline_tanks,
        "one-step NOSER 0.76 over the whole set; no published correlation was found",
        "the whole set has more tanks",
        "[Hauptmann et al. 2017](https://arxiv.org/abs/1704.01178)",
    ),
    PublicSet(
        "skin_round_presses.npz",
        ("lookup", "dv", "pos_m"),
        "skin_round",
        "Round e-skin of 80 mm (Hardman), 1250 robot presses",
        "measured FILE",
        round_skin,
        "none was found for these presses",
        "",
        "[DSHardman/Variable-Sensitivity-E-Skins](https://github.com/DSHardman/Variable-Sensitivity-E-Skins)",
    ),
    PublicSet(
        "skins_anisotropy.npz",
        ("_voltages", "_xy_mm"),
        "",
        "Five soft skins of 80 mm (Hardman), learnt from the first 800 presses of each, judged on "
        "the last 800",
        "presses FILE --train 800",
        soft_skins,
        "the authors' networks 4 to 11 mm; plain kernel ridge regression 3.0 mm",
        "the authors' were taught by about 2,000 presses, and are of other skins, too",
        "[DSHardman/Anisotropy](https://github.com/DSHardman/Anisotropy)",
    ),
)


@app.command(
    epilog=examples(
        "tactomo evaluate measured data/",
        "tactomo evaluate measured data/ --into docs/measured.md",
        "tactomo evaluate measured my_tanks.npz -d my_tank.toml --json",
    )
)
def measured(
    path: Annotated[
        Path, typer.Argument(metavar="DIR|FILE.npz", help="Where sets lie, or one of your own.")
    ],
    into: Annotated[
        Path | None, typer.Option(help="A page to put DIR's tables into, between its two marks.")
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option("--description", "-d", help="Sensor of FILE. [the public set's]"),
    ] = None,
    as_json: JsonOutput = False,
) -> None:
    """Evaluate a measured set, or the public sets in DIR beside the best published figures.

    Prints Markdown. The arrays of FILE tell its kind. *Tanks with objects*: `dv` (n, M), the
    increase of each voltage by the objects, on one unknown scale common to all; `truth` (n, rows,
    columns), 1 where an object conducts better than the saline and -1 where worse, row 0 at the
    top, the disc filling the picture; `name` (n,). The figure is the Pearson correlation of the
    image with the truth over the disc; the network's confidence is the expected correlation.
    *Presses of a robot*: `lookup` (M, 4), the source, sink, v+ and v- electrode of each voltage;
    `dv` (n, M); `pos_m` (n, 2), the places in the robot's frame. Some presses fit the skin's place
    in that frame, the others judge it. *Tanks of the Kuopio Tomography Challenge* and *presses on
    unknown skins*: as for `tactomo evaluate ktc` and `presses`, at every level and after 100, 200
    and 800 presses.

    The public sets are ktc2023_training.npz, tank_uef2017.npz, skin_round_presses.npz and
    skins_anisotropy.npz; the table names missing sets. All four take two minutes of one core.
    """
    if not path.is_dir():
        if into is not None:
            raise typer.BadParameter("--into goes with a folder")
        found = _measure(path, _recognised(path), sensor)
        lines = [f"{path.name}: {found.ours}", "", *found.details]
        _tell({path.name: found}, "\n".join(lines), as_json)
        return
    if sensor is not None:
        raise typer.BadParameter("--description goes with one file")
    before, after = ("", "") if into is None else _around(into)
    there = [each for each in SETS if (path / each.file).exists()]
    if not there:
        names = ", ".join(each.file for each in SETS)
        raise TactomoError(f"{path} holds none of the sets", f"put some there: {names}")
    sets = {each.file: _measure(path / each.file, each, None) for each in there}
    text = "\n".join(_page(sets)) + "\n"
    if into is None:
        _tell(sets, text, as_json)
        return
    from tactomo_models.archive import write_whole

    page = before + text + after
    write_whole(into, lambda file: file.write(page.encode()))
    say(f"wrote {into}", err=True)


def _tell(sets: dict[str, Measured], text: str, as_json: bool) -> None:
    told = {"simulated": False, "sets": {name: one.facts for name, one in sets.items()}}
    tell(told, as_json, lambda _: say(text))


def _measure(path: Path, kind: PublicSet, sensor: str | None) -> Measured:
    from threadpoolctl import threadpool_limits

    if sensor is not None and not kind.description:
        raise typer.BadParameter("--description: presses alone are learnt from; leave it out")
    say(f"measuring {path.name}", err=True)
    with threadpool_limits(1):  # more threads wait for each other where others compute, too
        return kind.measure(path, sensor or kind.description)


def _recognised(path: Path) -> PublicSet:
    """Return the public set that a file has the arrays of.

    Raises TactomoError where the file cannot be read, or has the arrays of none.
    """
    from tactomo_lab.evaluation.measured_sets import read_set

    names = list(read_set(path, "measured scans"))
    for each in SETS:
        if all(any(name.endswith(array) for name in names) for array in each.arrays):
            return each
    known = "; ".join(", ".join(each.arrays) for each in SETS)
    raise TactomoError(
        f"{path} is no set of measured scans: it holds {', '.join(names) or 'nothing'}",
        f"give the arrays of one: {known}",
    )


def _around(page: Path) -> tuple[str, str]:
    """Return what is on a page up to the mark where tables begin, and from where they end."""
    try:
        before, begin, rest = page.read_text("utf-8").partition(BEGIN)
    except OSError as error:
        raise TactomoError(f"cannot read {page}: {error.strerror}", "give a page") from error
    mark, _, tables = rest.partition("\n")
    if not begin or END not in tables:
        raise TactomoError(f"{page} has no marks", f"put {BEGIN} --> and {END} on lines of it")
    return f"{before}{begin}{mark}\n", tables[tables.index(END) :]


def _page(found: dict[str, Measured]) -> Iterator[str]:
    heads = ["set", "`tactomo evaluate`", "ours", "published, or a plain method", "not comparable"]
    rows = []
    for each in SETS:
        ours = found[each.file].ours if each.file in found else "not here"
        row = [f"{each.title}: {each.source}", f"`{each.command}`", ours, each.published]
        rows.append([*row, each.apart])
    yield from _table(heads, rows)
    for each in SETS:
        if each.file in found:
            yield from (f"## {each.file}", "", "\n".join(found[each.file].details).rstrip(), "")


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = [heads, ["---"] * len(heads), *rows]
    return ["", *(f"| {' | '.join(cells)} |" for cells in lines), ""]


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


# ------------------------------------------------------------------ one kind of set each


@app.command(
    epilog=examples(
        "tactomo evaluate ktc ktc2023_training.npz --picture ktc.png",
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
    picture: Picture = None,
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
    from tactomo_lab.commands.pictures import draw_tanks
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
    tell(told, as_json, show, picture, partial(draw_tanks, given.truth, tanks))


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

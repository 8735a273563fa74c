"""`tactomo evaluate measured`: every measured set in a folder, beside what others published."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import typer
from tactomo.cli.options import examples, typer_app
from tactomo.errors import TactomoError

app = typer_app()

BEGIN: Final = "<!-- from here on by `tactomo evaluate measured`"
END: Final = "<!-- to here -->"
TRAINED: Final = (100, 200, 800)  # presses learnt from


class Measured(NamedTuple):
    """What a set shows: the figure of its row, and tables with their captions."""

    ours: str
    details: list[str]


class PublicSet(NamedTuple):
    """A set that a reader can get.

    Attributes:
        file: what it is to be called; `tactomo evaluate COMMAND --help` names its arrays.
        title: what it is.
        command: what measures it, behind `tactomo evaluate`.
        measure: the same, as a function of the path.
        published: the best figure of others, with who says so; or a plain method's.
        apart: what is not comparable.
        source: where the raw data are.
    """

    file: str
    title: str
    command: str
    measure: Callable[[Path], Measured]
    published: str
    apart: str
    source: str


def challenge(path: Path) -> Measured:
    """Score the challenge's tanks at each level."""
    from tactomo_models import load_description

    from tactomo_lab.evaluation.ktc import evaluate_challenge, read_challenge

    tank = load_description("tank_ktc2023")
    given = read_challenge(path, tank)
    tanks = [list(evaluate_challenge(given.at_level(level), tank)) for level in range(1, 8)]
    means = [_mean([one.score for one in level]) for level in tanks]
    seconds = _mean([one.seconds for level in tanks for one in level])
    count = len(tanks[0])
    details = [
        f"Mean score of {count} tanks without the first 2 (level - 1) electrodes:",
        *_table(["level", *map(str, range(1, 8))], [["score", *(f"{m:.3f}" for m in means)]]),
        f"{seconds:.1f} s a tank on one core (processor time).",
    ]
    return Measured(f"{3 * sum(means):.1f} of 21", details)


def saline_tanks(path: Path) -> Measured:
    """Correlate images of tanks with the truth, by three methods."""
    from scipy.stats import spearmanr
    from tactomo_models import load_description

    from tactomo_lab.evaluation.tanks import TankImager, evaluate_tanks, read_tanks

    tank = load_description("tank_uef2017")
    methods = ["network", "noser", "tikhonov"]
    found = list(evaluate_tanks(TankImager(tank), read_tanks(path, tank), methods))
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
    return Measured(f"{ours:.3f} (NOSER {noser:.2f}, Tikhonov {tikhonov:.2f})", details)


def round_skin(path: Path) -> Measured:
    """Locate a robot's presses by several methods, cross-validated."""
    from tactomo_models import load_description

    from tactomo_lab.evaluation.skin_presses import localise, read_presses

    skin = load_description("skin_round")
    found = localise(read_presses(path, skin), skin)
    physics = min(one.median_mm for one in found if "image" in one.method)
    taught = min(one.median_mm for one in found if "taught" in one.method)
    rows = [[one.method, f"{one.median_mm:.1f}", f"{one.most_mm:.1f}"] for one in found]
    return Measured(
        f"{taught:.1f} mm (median) taught by the other presses; {physics:.1f} mm by physics alone",
        ["Ten folds:", *_table(["error, mm", "median", "95 %"], rows)],
    )


def soft_skins(path: Path) -> Measured:
    """Learn skins from their first presses, and locate the last 800."""
    from threadpoolctl import threadpool_limits

    from tactomo_lab.evaluation.taught_presses import judge, read_skins

    skins, rows, means = read_skins(path), [], []
    with threadpool_limits(1):
        for train in TRAINED:
            found = list(judge(skins, train))
            means.append(_mean([one.median_mm for one in found]))
            medians = [f"{one.median_mm:.1f}" for one in found]
            rows.append([str(train), *medians, f"{means[-1]:.1f}"])
    return Measured(
        f"{means[-1]:.1f} mm (mean of medians)",
        [
            "Median error, mm, by presses learnt from:",
            *_table(["presses", *(skin.name for skin in skins), "mean"], rows),
        ],
    )


SETS: Final = (
    PublicSet(
        "ktc2023_training.npz",
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
        "University of Eastern Finland 2017, saline tanks of 16 electrodes, mean correlation",
        "tanks FILE",
        saline_tanks,
        "one-step NOSER 0.76 over the whole set; no published correlation was found",
        "the whole set has more tanks",
        "[Hauptmann et al. 2017](https://arxiv.org/abs/1704.01178)",
    ),
    PublicSet(
        "skin_round_presses.npz",
        "Round e-skin of 80 mm (Hardman), 1250 robot presses",
        "skin FILE",
        round_skin,
        "none was found for these presses",
        "",
        "[DSHardman/Variable-Sensitivity-E-Skins](https://github.com/DSHardman/Variable-Sensitivity-E-Skins)",
    ),
    PublicSet(
        "skins_anisotropy.npz",
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
        "tactomo evaluate measured data/", "tactomo evaluate measured data/ --into docs/measured.md"
    )
)
def measured(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where the sets lie.")],
    into: Annotated[
        Path | None, typer.Option(help="A page to put the tables into, between its two marks.")
    ] = None,
) -> None:
    """Measure every public set that is in DIR, and tell it beside the best published figure.

    Prints Markdown. The sets: ktc2023_training.npz, tank_uef2017.npz, skin_round_presses.npz and
    skins_anisotropy.npz, with the arrays that `tactomo evaluate ktc`, `tanks`, `skin` and
    `presses` take; what is missing is said in its row. All four take two minutes of one core.
    """
    from rich.console import Console

    before, after = ("", "") if into is None else _around(into)
    there = [each for each in SETS if (folder / each.file).exists()]
    if not there:
        names = ", ".join(each.file for each in SETS)
        raise TactomoError(f"{folder} holds none of the sets", f"put some there: {names}")
    found = {}
    for each in there:
        with Console(stderr=True).status(each.file):
            found[each.file] = each.measure(folder / each.file)
    text = "\n".join(_page(found)) + "\n"
    if into is None:
        typer.echo(text)
        return
    from tactomo_models.archive import write_whole

    page = before + text + after
    write_whole(into, lambda file: file.write(page.encode()))
    typer.echo(f"wrote {into}", err=True)


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

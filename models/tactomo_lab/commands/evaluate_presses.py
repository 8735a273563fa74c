"""`tactomo evaluate presses`: what teaching brings on measured skins of unknown make."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from tactomo.cli.options import JsonOutput, examples, typer_app
from tactomo.cli.output import print_json, table

from tactomo_lab.commands.report import shown

app = typer_app()


@app.command(
    epilog=examples(
        "tactomo evaluate presses skins_anisotropy.npz --train 100",
        "tactomo evaluate presses skins_anisotropy.npz --train 800 --json",
    )
)
def presses(
    skins: Annotated[Path, typer.Argument(metavar="FILE.npz", help="Presses, see above.")],
    train: Annotated[int, typer.Option(min=1, help="Presses to learn from.")] = 200,
    as_json: JsonOutput = False,
) -> None:
    """Learn each skin from its first presses, and locate its last 800.

    FILE holds for each skin NAME_voltages (P, M), what each press changed, and NAME_xy_mm (P, 2),
    where it was, both in order of time. Half of the presses not learnt from are judged where they
    are fewer than 800. What the sheets are made of nobody needs to know: nothing but the presses
    is learnt from, of each skin by itself.
    """
    import numpy as np
    from tactomo.cli.console import Console
    from threadpoolctl import threadpool_limits

    from tactomo_lab.evaluation.taught_presses import judge, read_skins

    known = read_skins(skins)
    with threadpool_limits(1):
        found = list(shown(judge(known, train), len(known), "skins"))
    if as_json:
        print_json({"skins": [asdict(one) for one in found]})
        return
    made = table("error, mm", "judged", "median", "95 %", "in σ", "taught", "since then")
    for one in found:
        errors = (f"{one.median_mm:.2f}", f"{one.p95_mm:.1f}")
        shares = (f"{one.within_sigma:.0%}", f"{one.is_taught:.0%}")
        since = " ".join(f"{median:.1f}" for median in one.median_mm_since)
        made.add_row(one.name, str(one.judged), *errors, *shares, since)
    made.add_section()
    made.add_row(
        "mean",
        "",
        f"{np.mean([one.median_mm for one in found]):.2f}",
        f"{np.mean([one.p95_mm for one in found]):.1f}",
        style="bold",
    )
    console = Console()
    console.print(f"measured presses, learnt from the first {train} of each skin")
    console.print(made)
    console.print(
        "in σ: coordinates within one reported standard uncertainty, 68 % where that is "
        "right; taught: presses of which the like was taught; since then: medians of the "
        "quarters of all later presses.",
        style="dim",
    )

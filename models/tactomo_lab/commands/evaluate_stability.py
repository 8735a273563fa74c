"""`tactomo evaluate stability`: where methods fail, and whether they say so."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from tactomo.cli import options
from tactomo.cli.output import print_json, table
from tactomo.cli.plot.plot import picture_option

from tactomo_lab.commands.evaluate import Seeds, chosen_names, shown

if TYPE_CHECKING:
    from rich.table import Table

    from tactomo_lab.evaluation.stability import CaseScore, Trust

NAME_WIDTH, CELL_WIDTH = 17, 16  # characters of the first and of the other columns
IN_WORDS = "auto"  # the method whose doings are told in words, where it is among those asked for

app = options.typer_app()


@app.command(
    epilog=options.examples(
        "tactomo evaluate stability --count 2",
        "tactomo evaluate stability --regime jump,drift --method auto --picture flags.png",
        "tactomo evaluate stability --seeds reporting --jobs 2 --json > stability.json",
    )
)
def stability(
    seeds: Seeds = "tuning",
    count: Annotated[int, typer.Option(min=1, help="Cases of each regime.")] = 6,
    regime: Annotated[
        str | None, typer.Option(help="Which regimes, with commas. [all of them]")
    ] = None,
    method: Annotated[list[str] | None, options.methods_option(" [all that are available]")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes that share the work.")] = 1,
    sensor: options.Description = options.DEFAULT_DESCRIPTION,
    picture: Annotated[Path | None, picture_option("Draw an overview")] = None,
    as_json: options.JsonOutput = False,
) -> None:
    """Break what reconstruction relies on, one regime at a time, and see whether it is flagged.

    Noise, small contacts, many contacts, bad leads, drift, a stretched sheet, jumps and more: some
    simulated cases of each regime, reconstructed by every method. A map is bad where its ICC is
    below 0.7. What tells not to trust it: the flags misfit_high, not_converged, low_confidence,
    reference_mismatch, noise_high and channels_swapped, or that there is no map. The first run
    simulates (a second a case, some more where a case is several frames) and keeps the voltages
    in the cache.
    """
    from tactomo_models import available_methods, load_description

    from tactomo_lab.commands.chart import usable
    from tactomo_lab.evaluation.regimes import REGIMES
    from tactomo_lab.evaluation.stability import evaluate_regimes

    regimes = chosen_names(regime, REGIMES, "--regime")
    description = load_description(sensor)
    chosen = method or usable(description, available_methods())
    cases = evaluate_regimes(description, regimes, chosen, seeds, count, jobs=jobs)
    total = len(regimes) * count
    scores = [one.score for case in shown(cases, total, f"{seeds} cases") for one in case]
    settings = {
        "simulated": True,
        "sensor": description.name,
        "seeds": seeds,
        "cases_each": count,
        "methods": chosen,
    }
    if as_json:
        print_json({**settings, **_as_json(scores)})
    else:
        _print(settings, scores)
    if picture is not None:
        from tactomo_lab.commands.stability_pictures import draw_overview

        draw_overview(scores, picture)
        typer.echo(f"wrote {picture}", err=True)


def _as_json(scores: Sequence[CaseScore]) -> dict[str, Any]:
    from tactomo_lab.evaluation.regimes import REGIMES
    from tactomo_lab.evaluation.stability import trust_by_regime

    by_regime = {
        regime: {
            "what": REGIMES[regime].what if regime in REGIMES else "all of these regimes",
            "methods": {method: asdict(counts) for method, counts in by_method.items()},
        }
        for regime, by_method in trust_by_regime(scores).items()
    }
    return {"regimes": by_regime, "cases": [one.as_json() for one in scores]}


def _print(settings: dict[str, Any], scores: Sequence[CaseScore]) -> None:
    from rich.console import Console

    from tactomo_lab.evaluation.stability import trust_by_regime

    console = Console()
    console.print(
        f"Simulated, not measured: {settings['sensor']}, {settings['seeds']} seeds, "
        f"{settings['cases_each']} case(s) of each regime."
    )
    rows = trust_by_regime(scores)
    fit = max(1, (console.width - NAME_WIDTH) // CELL_WIDTH)
    methods = list(rows["all"])
    for first in range(0, len(methods), fit):  # as many tables as the terminal is too narrow for
        console.print(_counts(rows, methods[first : first + fit]))
    console.print(
        "[dim]Each cell: mean ICC; bad maps (ICC < 0.7) without a flag that tells to distrust, of "
        "all bad ones; good maps with one, of all good ones.[/]\n"
    )
    method = IN_WORDS if IN_WORDS in methods else methods[0]
    console.print(_doings(method, [one for one in scores if one.method == method]))


def _counts(rows: dict[str, dict[str, Trust]], methods: Sequence[str]) -> Table:
    made = table("", *methods)
    for regime, by_method in rows.items():
        if regime == "all":
            made.add_section()
        made.add_row(regime, *(_cell(by_method[method]) for method in methods))
    return made


def _cell(counts: Trust) -> str:
    if not counts.maps:  # the method does not serve this regime's sensor
        return "-"
    silent = f"{counts.bad_unwarned}/{counts.bad}"
    if counts.bad_unwarned:
        silent = f"[red]{silent}[/]"
    return f"{counts.icc:.2f} {silent} {counts.good_warned}/{counts.maps - counts.bad}"


def _doings(method: str, scores: Sequence[CaseScore]) -> Table:
    """What one method did in each regime: tiers that made the maps, and flags."""
    from tactomo_lab.evaluation.regimes import REGIMES

    columns = ("", "what goes wrong", "made by", "flags")
    made = table(*columns, left=columns, title=f"what {method} did")
    for regime in dict.fromkeys(one.regime for one in scores):
        own = [one for one in scores if one.regime == regime]
        tiers = Counter(one.tier for one in own)
        flags = Counter(flag for one in own for flag in one.flags)
        made.add_row(regime, REGIMES[regime].what, _tally(tiers), _tally(flags))
    return made


def _tally(counts: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.most_common()) or "none"

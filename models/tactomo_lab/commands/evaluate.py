"""`tactomo evaluate`: how right the reconstruction is, where the truth is known."""

from __future__ import annotations

from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from tactomo.cli import options
from tactomo.cli.commands import Group
from tactomo.cli.output import say
from tactomo.cli.plot.plot import picture_option

from tactomo_lab.commands.report import Seeds, chosen_names, print_suite, shown, tell

if TYPE_CHECKING:
    from tactomo_lab.evaluation.play import Outcome
    from tactomo_lab.scenes.measures import Score

app = options.typer_app(
    name="evaluate",
    cls=Group,
    help="Measure the accuracy of reconstructions on data with known truth.",
    no_args_is_help=True,
)


@app.callback()
def _group() -> None:
    """Keep `field` a command of its own: a Typer of a single command is that command."""


@app.command(
    epilog=options.examples(
        "tactomo evaluate field",
        "tactomo evaluate field --rows soft,graded --method fit --count 30",
        "tactomo evaluate field --seeds reporting --count 50 --json > field.json",
        "tactomo evaluate field --rows ordinary --picture scenes.png",
        "tactomo evaluate field --rows graded,mixed --companion 0.05",
        "tactomo evaluate field --rows regimes --method auto,fit --picture flags.png",
    )
)
def field(
    seeds: Seeds = "tuning",
    count: Annotated[int, typer.Option(min=1, max=10_000, help="Scenes of each line.")] = 10,
    rows: Annotated[
        str | None, typer.Option(help="Which rows, with commas; or regimes. [all below]")
    ] = None,
    method: Annotated[list[str] | None, options.methods_option(" [auto]")] = None,
    sensor: options.Description = options.DEFAULT_DESCRIPTION,
    companion: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            max=1.0,
            help="Put a load cell under the sheet that is wrong by such a share: 0.05. Still rows.",
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        picture_option(
            "Draw truth and outcome of the first row's worst and middle scenes; of several "
            "methods, an overview of all rows"
        ),
    ] = None,
    as_json: options.JsonOutput = False,
) -> None:
    """Reconstruct soft presses, crowds, one graded sheet and more, and compare with the truth.

    *ordinary*: one to four contacts in turns, at 40, 20 and 10 dB of the change; the other rows at
    40 dB unless stated. *rectangles-rings*: these shapes alone. *hand-made*: electrodes displaced
    by 1 mm, contact impedances by 30 %, sheets uneven by 10 %. *soft*: balls of 180 to 300 kPa, at
    60 dB of the voltages. *graded*: one sheet alone, without an onset. *crowded*: five or six small
    contacts. *many*: eight to ten contacts. *crowded-soft*, *crowded-mixed*: five or six small
    balls, and flat ones among them. *mixed*: flat ellipses, rectangles, rings and balls
    side by side, on hand-made skins, at 60 dB of the voltages. *moving*: a sequence for every ten
    scenes, at 20 frames a second: contacts slide, land, lift, jump, merge and split, with lost
    scans, whose frames are left out, and a tare. *mixed-moving*: such a sequence of mixed presses
    that land, glide, change pressure and lift, with noise 40 dB below each frame's change or 60 dB
    below the voltages. *palm*: one contact at least 60 mm across, of 2
    to 200 kPa, which comes in a second to ten minutes while the reference follows. *overload*: one
    to three presses, the first or all beyond the end of the response table. *day*, only where it is
    asked for: for every ten scenes a day of the twin's skin after one tare, with and without a
    reference that follows drift; the temperature swings by 10 K and steps by 2 K, pressed places
    creep, contact impedances wander, presses last from seconds to two hours. *regimes*: a row for
    each regime where methods fail: noise, small contacts, bad leads, drift, a stretched sheet,
    jumps and more; the last frame of a case counts. A map is bad where its correlation is below
    0.7, and flagged if it has one of the flags misfit_high, not_converged, low_confidence,
    reference_mismatch, noise_high and channels_swapped, or if there is no map.

    Every scene has its own sheets, uneven by 5 %, uneven electrodes, a contrast of 10 to 100 that
    the reconstruction does not know, and equal noise in volts on every voltage. A finer mesh than
    the reconstruction's simulates the voltages. Still scenes are reconstructed from a cold
    start. The first run simulates (a second a scene, a minute a sequence, 10 s a palm) and keeps
    the voltages in the cache; days take some minutes each time. The sensor may have two sheets or
    one, of any outline. Rows that the sensor cannot have, such as *overload* without a magnitude
    channel, are left out; without one the pressed shape counts as the map.
    """
    from tactomo_models import ArtifactError, MethodError, load_description

    from tactomo_lab.commands.pictures import draw_outcomes, draw_overview
    from tactomo_lab.evaluation.field import DAYS, ROWS, STILL_ROWS, frames_of_row
    from tactomo_lab.evaluation.regimes import REGIMES, can_happen
    from tactomo_lab.scenes.measures import summarise

    description, methods = load_description(sensor), method or ["auto"]
    usual = ROWS if companion is None else STILL_ROWS
    if rows in (None, "regimes"):
        all_rows = usual if rows is None else REGIMES
        chosen = [row for row in all_rows if can_happen(row, description)]
    else:
        known = [*usual, *((DAYS, *REGIMES) if companion is None else ())]
        chosen = chosen_names(rows, dict.fromkeys(known), "--rows")
    by_line: dict[str, dict[str, list[Score]]] = {}
    drawn: list[Outcome] = []  # of the first line
    for row, one in product(chosen, methods):
        total = count if row in STILL_ROWS else None
        lines_of = frames_of_row(description, row, one, seeds, count, companion)
        for line, frames in lines_of.items():
            try:
                outcomes = list(shown(frames, total, line))
            except (ArtifactError, MethodError) as error:
                # Of a row's own sensor, for which a method may not serve.
                say(f"left out: {line}: {error}", err=True)
                continue
            by_line.setdefault(line, {})[one] = [outcome.score for outcome in outcomes]
            drawn = drawn or outcomes
    scores = {
        line if len(methods) == 1 else f"{line}, {one}": own
        for line, by_method in by_line.items()
        for one, own in by_method.items()
    }
    found = {line: summarise(own) for line, own in scores.items()}
    told = {
        **{"simulated": True, "sensor": description.name, "seeds": seeds, "snr_of": "change"},
        **{"method": ", ".join(methods), "companion": companion, "scenes_each": count},
        "lines": {
            line: {**asdict(found[line]), "scores": [one.as_json() for one in own]}
            for line, own in scores.items()
        },
    }

    def draw(output: Path) -> None:
        if len(methods) > 1:
            draw_overview(by_line, methods, output)
        elif drawn:
            draw_outcomes(drawn, output)

    what = f"{description.name}, {seeds} seeds, method {told['method']}"
    tell(told, as_json, lambda console: print_suite(console, what, found), picture, draw)

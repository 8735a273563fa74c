"""`tactomo evaluate field`: the scenes that a pressure field has to explain, row by row."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from tactomo.cli import options
from tactomo.cli.output import print_json
from tactomo.cli.plot.plot import picture_option

from tactomo_lab.commands import evaluate

if TYPE_CHECKING:
    from tactomo_lab.scenes.measures import FrameScore

MAPS = (
    "frames",
    "ICC",
    "RIE",
    "worst",
    "shape",
    "flagged",
    "silent",
    "wrong",
    "alarms",
    "ms",
    "p99",
)
CONTACTS = (
    *("counted", "right to 10 %", "peak in σ", "surely wrong"),
    *("mm", "in σ", "place in σ", "area in σ", "overload right", "overload wrong"),
)

app = options.typer_app()


@app.command(
    epilog=options.examples(
        "tactomo evaluate field",
        "tactomo evaluate field --rows soft,graded --method fit --count 30",
        "tactomo evaluate field --seeds reporting --count 50 --json > field.json",
        "tactomo evaluate field --rows soft --picture soft_press.png",
    )
)
def field(
    seeds: evaluate.Seeds = "tuning",
    count: Annotated[int, typer.Option(min=1, help="Scenes of each line.")] = 10,
    rows: Annotated[str | None, typer.Option(help="Which rows, with commas. [all of them]")] = None,
    method: options.Method = "auto",
    sensor: options.Description = options.DEFAULT_DESCRIPTION,
    picture: Annotated[
        Path | None,
        picture_option("Draw one soft contact, the middle one by correlation: truth and method"),
    ] = None,
    as_json: options.JsonOutput = False,
) -> None:
    """Reconstruct what one pressure field has to explain: soft presses, one graded sheet, crowds.

    *ordinary*: one to four contacts, at 40, 20 and 10 dB of the change; the others at 40.
    *rectangles-rings*: of those shapes alone. *hand-made*: electrodes 1 mm off, contact impedances
    by 30 %, sheets uneven by 10 %. *soft*: balls of 180 to 300 kPa, at 60 dB of the voltages.
    *graded*: one sheet alone that answers from 0 kPa on. *crowded*: five or six small contacts;
    *many*: eight to ten. *mixed*: flat ellipses, rectangles, rings and balls side by side, on
    skins made by hand, at 60 dB of the voltages. *moving*: a sequence of `tactomo evaluate moving`
    for every ten scenes, without the frames whose scans are lost. *mixed-moving*: such a sequence
    of mixed presses that land, glide, change pressure and lift, with noise 40 dB under each
    frame's change and with noise 60 dB under the voltages. *palm*: one contact of 60 mm or more
    across and 2 to 200 kPa, which comes in a second to ten minutes while the reference follows.
    *overload*: one to three presses, the first or all beyond the response table's end. All are
    simulated as in `tactomo evaluate scenes`, still ones reconstructed from a cold start. The
    first run simulates (a second a scene, a minute a sequence, 10 s a palm) and keeps the voltages
    in the cache.
    """
    from tactomo_models import ModelError, load_description

    from tactomo_lab.evaluation.field import ROWS, STILL_ROWS, middle_press, scores_of_row
    from tactomo_lab.scenes.measures import summarise

    description = load_description(sensor)
    scores: dict[str, list[FrameScore]] = {}
    for row in evaluate.chosen_names(rows, ROWS, "--rows"):
        total = count if row in STILL_ROWS else None
        for line, frames in scores_of_row(description, row, method, seeds, count).items():
            try:
                scores[line] = list(evaluate.shown(frames, total, line))
            except ModelError as error:  # of a row's own sensor, for which a method may not serve
                typer.echo(f"left out: {line}: {error}", err=True)
    settings = evaluate.settings_of(description.name, seeds, "change", method)
    if as_json:
        lines = {
            line: {**asdict(summarise(own)), "scores": [asdict(one) for one in own]}
            for line, own in scores.items()
        }
        print_json({**settings, "scenes_each": count, "lines": lines})
    else:
        evaluate.print_tables(
            settings,
            {line: summarise(own) for line, own in scores.items()},
            {"maps": MAPS, "contacts": CONTACTS},
            "worst: ICC that 95 % exceed; silent: maps with an ICC below 0.7 and no flag that "
            "tells to distrust, of all; shape: ICC of the pressed shape; wrong: ICC below 0.8 or "
            "another count, and no flag; alarms: good maps with one, of the good ones. counted: "
            "frames with the right number of contacts; right to 10 %: peaks, of the true contacts; "
            "surely wrong: peaks more than 3 reported sigmas and 10 % off, or told above a range "
            "that they lie in, of those told with a sigma or as above; mm: centre error, median; "
            "overload: of the contacts beyond the response table, those told without a bound, and "
            "those whose 95 % interval ends below them; "
            "in σ: peaks, magnitudes, places and areas within one reported sigma, 68 % where that "
            "is right.",
        )
    if picture is not None:
        from tactomo_lab.commands.pictures import draw_press

        draw_press(middle_press(description, method, seeds, count), picture)
        typer.echo(f"wrote {picture}", err=True)

"""`tactomo evaluate`: how right the reconstruction is, where the truth is known."""

from __future__ import annotations

import math
from dataclasses import asdict
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from tactomo.cli import options
from tactomo.cli.commands import Group
from tactomo.cli.output import say
from tactomo.cli.plot.plot import picture_option

from tactomo_lab.commands.report import (
    Picture,
    Seeds,
    chosen_names,
    print_suite,
    shown,
    tell,
)

if TYPE_CHECKING:
    from tactomo.cli.console import Console

    from tactomo_lab.scenes.measures import Score, Summary

MAPS = ("frames", "ICC", "worst", "shape", "RIE", "flagged", "wrong", "ms", "p99")
CONTACTS = (*("counted", "missed", "false", "mm", "p95", "area"), *("Δσ", "spread", "kPa", "in σ"))
FIELD_MAPS = (
    *("frames", "ICC", "RIE", "worst", "shape", "flagged", "silent", "wrong", "alarms"),
    *("ms", "p99"),
)
FIELD_CONTACTS = (
    *("counted", "right to 10 %", "force", "forces", "peak in σ", "surely wrong"),
    *("mm", "in σ", "place in σ", "area in σ", "overload right", "overload wrong"),
)
DAYS = (
    *("frames", "ghosts/h", "ghosts", "presses", "unseen", "erased", "hidden"),
    *("distrusted", "refused", "firm Δσ"),
)
FEWER = 10  # frames without tracking are slow, for all that they show

SnrOf = Annotated[
    Literal["change", "voltage"],
    typer.Option(
        help="What noise is measured by: the rms of a channel's voltage changes, or of its "
        "voltages at rest, of which changes are a few percent or less."
    ),
]

app = options.typer_app(
    name="evaluate",
    cls=Group,
    help="Measure the accuracy of reconstructions on data with known truth.",
    no_args_is_help=True,
)


def _settings(sensor: str, seeds: str, **more: Any) -> dict[str, Any]:
    return {"simulated": True, "sensor": sensor, "seeds": seeds, **more}


def _in_words(settings: dict[str, Any]) -> str:
    of = "{sensor}, {seeds} seeds, method {method}, SNR of the {snr_of}"
    return of.format(**settings)


# ------------------------------------------------------------------ still scenes


@app.command(
    epilog=options.examples(
        "tactomo evaluate scenes",
        "tactomo evaluate scenes --count 50 --contacts 1-4 --snr 60,40,20,10",
        "tactomo evaluate scenes --method tikhonov --picture tikhonov.png",
        "tactomo evaluate scenes --seeds reporting --json > report.json",
    )
)
def scenes(
    seeds: Seeds = "tuning",
    count: Annotated[int, typer.Option(min=1, help="Scenes of each number of contacts.")] = 10,
    contacts: Annotated[str, typer.Option(help="How many contacts: 3, or 1-4.")] = "1-6",
    snr: Annotated[str, typer.Option(help="Signal-to-noise ratios in dB, with commas.")] = "40",
    snr_of: SnrOf = "change",
    method: options.Method = "auto",
    sensor: options.Description = options.DEFAULT_DESCRIPTION,
    picture: Picture = None,
    as_json: options.JsonOutput = False,
) -> None:
    """Reconstruct simulated still scenes, each from a cold start, and compare with the truth.

    Every scene has its own sheets, uneven by 5 %, uneven electrodes, a contrast of 10 to 100 that
    the reconstruction does not know, and equal noise in volts on every voltage. A finer mesh than
    the reconstruction's simulates the voltages. The first run simulates (half a second a scene) and
    keeps the voltages in the cache.

    The sensor may have two sheets or one, of any outline. Without a magnitude channel the pressed
    shape counts as the map.

    A frame whose *misfit*, in units of the scans' noise, exceeds 2 has the flag misfit_high (1.5
    over both channels, where a network with low confidence made the map); about 1 is good.
    """
    from tactomo_models import load_description

    from tactomo_lab.commands.pictures import draw_outcomes
    from tactomo_lab.evaluation.play import play
    from tactomo_lab.scenes.measures import summaries, summarise
    from tactomo_lab.scenes.still_scenes import scenes as draw_scenes

    numbers, ratios = _range(contacts), _decibels(snr)
    description = load_description(sensor)
    drawn = chain.from_iterable(
        draw_scenes(description, seeds, count, contacts=numbers, snr_db=ratio, snr_of=snr_of)
        for ratio in ratios
    )
    total = count * len(numbers) * len(ratios)
    outcomes = list(shown(play(drawn, method), total, f"{seeds} scenes"))
    scores = [outcome.score for outcome in outcomes]
    of_all, by = summarise(scores), summaries(scores)
    settings = _settings(description.name, seeds, snr_of=snr_of, method=method)

    def show(console: Console) -> None:
        groups = {"all": of_all}
        for name, rows in by.items():
            if len(rows) > 1:
                groups |= {f"{name} {value}": summary for value, summary in rows.items()}
        tables = {"maps, cold start": MAPS, "contacts": CONTACTS}
        print_suite(console, _in_words(settings), tables, groups)

    told = {
        **settings,
        "scenes_each": count,
        "all": asdict(of_all),
        "by": {
            name: {value: asdict(summary) for value, summary in rows.items()}
            for name, rows in by.items()
        },
        "scenes": [one.as_json() for one in scores],
    }
    tell(told, as_json, show, picture, partial(draw_outcomes, outcomes))


def _range(text: str) -> range:
    """The numbers from "3" or "1-4"."""
    first, _, last = text.partition("-")
    try:
        numbers = range(int(first), int(last or first) + 1)
    except ValueError:
        numbers = range(0)
    if not numbers or numbers[0] < 1:
        raise typer.BadParameter(
            f"--contacts {text!r}: give a number such as 3, or a range such as 1-4"
        )
    return numbers


def _decibels(text: str) -> list[float]:
    """The numbers from "60,40,20"."""
    try:
        ratios = [float(part) for part in text.split(",")]
    except ValueError:
        ratios = []
    if not ratios or any(math.isnan(ratio) for ratio in ratios):
        raise typer.BadParameter(f"--snr {text!r}: give numbers, such as 60,40,20,10")
    return ratios


# ------------------------------------------------------------------ the field's rows


@app.command(
    epilog=options.examples(
        "tactomo evaluate field",
        "tactomo evaluate field --rows soft,graded --method fit --count 30",
        "tactomo evaluate field --seeds reporting --count 50 --json > field.json",
        "tactomo evaluate field --rows soft --picture soft_press.png",
        "tactomo evaluate field --rows graded,mixed --companion 0.05",
        "tactomo evaluate field --rows regimes --method auto,fit --picture flags.png",
    )
)
def field(
    seeds: Seeds = "tuning",
    count: Annotated[int, typer.Option(min=1, help="Scenes of each line.")] = 10,
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
            "Draw one soft contact, the middle one by correlation: truth and method; of several "
            "methods, an overview of all rows"
        ),
    ] = None,
    as_json: options.JsonOutput = False,
) -> None:
    """Reconstruct soft presses, crowds, one graded sheet and more, and compare with the truth.

    *ordinary*: one to four contacts, at 40, 20 and 10 dB of the change; the other rows at 40 dB
    unless stated. *rectangles-rings*: these shapes alone. *hand-made*: electrodes displaced by 1
    mm, contact impedances by 30 %, sheets uneven by 10 %. *soft*: balls of 180 to 300 kPa, at 60 dB
    of the voltages. *graded*: one sheet alone, without an onset. *crowded*: five or six small
    contacts. *many*: eight to ten contacts. *crowded-soft*, *crowded-mixed*: five or six small
    balls, and flat ones among them. *mixed*: flat ellipses, rectangles, rings and balls
    side by side, on hand-made skins, at 60 dB of the voltages. *moving*: a sequence for every ten
    scenes, at 20 frames a second: contacts slide, land, lift, jump, merge and split, with lost
    scans, whose frames are left out, and a tare. *mixed-moving*: such a sequence of mixed presses
    that land, glide, change pressure and lift, with noise 40 dB below each frame's change or 60 dB
    below the voltages. *palm*: one contact at least 60 mm across, of 2
    to 200 kPa, which comes in a second to ten minutes while the reference follows. *overload*: one
    to three presses, the first or all beyond the end of the response table. *regimes*: a row for
    each regime where methods fail: noise, small contacts, bad leads, drift, a stretched sheet,
    jumps and more; the last frame of a case counts. A map is bad where its correlation is below
    0.7, and flagged if it has one of the flags misfit_high, not_converged, low_confidence,
    reference_mismatch, noise_high and channels_swapped, or if there is no map.

    Scenes are simulated as in `tactomo evaluate scenes`; still scenes are reconstructed from a cold
    start. The first run simulates (a second a scene, a minute a sequence, 10 s a palm) and keeps
    the voltages in the cache. Rows that the sensor cannot have, such as *overload* without a
    magnitude channel, are left out.
    """
    from tactomo_models import ArtifactError, MethodError, load_description

    from tactomo_lab.commands.pictures import draw_overview, draw_press
    from tactomo_lab.evaluation.field import ROWS, STILL_ROWS, middle_press, scores_of_row
    from tactomo_lab.evaluation.regimes import REGIMES, can_happen
    from tactomo_lab.scenes.measures import summarise

    description, methods = load_description(sensor), method or ["auto"]
    usual = ROWS if companion is None else STILL_ROWS
    if rows in (None, "regimes"):
        all_rows = usual if rows is None else REGIMES
        chosen = [row for row in all_rows if can_happen(row, description)]
    else:
        known = [*usual, *(REGIMES if companion is None else ())]
        chosen = chosen_names(rows, dict.fromkeys(known), "--rows")
    by_line: dict[str, dict[str, list[Score]]] = {}
    for row, one in product(chosen, methods):
        total = count if row in STILL_ROWS else None
        lines_of = scores_of_row(description, row, one, seeds, count, companion)
        for line, frames in lines_of.items():
            try:
                by_line.setdefault(line, {})[one] = list(shown(frames, total, line))
            except (ArtifactError, MethodError) as error:
                # Of a row's own sensor, for which a method may not serve.
                say(f"left out: {line}: {error}", err=True)
    scores = {
        line if len(methods) == 1 else f"{line}, {one}": own
        for line, by_method in by_line.items()
        for one, own in by_method.items()
    }
    settings = _settings(
        description.name, seeds, snr_of="change", method=", ".join(methods), companion=companion
    )
    found: dict[str, Summary] = {line: summarise(own) for line, own in scores.items()}
    lines = {
        line: {**asdict(found[line]), "scores": [one.as_json() for one in own]}
        for line, own in scores.items()
    }

    def draw(output: Path) -> None:
        if len(methods) > 1:
            draw_overview(by_line, methods, output)
        else:
            draw_press(middle_press(description, methods[0], seeds, count), output)

    tables = {"maps": FIELD_MAPS, "contacts": FIELD_CONTACTS}
    tell(
        {**settings, "scenes_each": count, "lines": lines},
        as_json,
        lambda console: print_suite(console, _in_words(settings), tables, found),
        picture,
        draw,
    )


# ------------------------------------------------------------------ days that drift


@app.command(
    epilog=options.examples(
        "tactomo evaluate drift",
        "tactomo evaluate drift --hours 3 --json",
        "tactomo evaluate drift --seeds reporting --count 2 --picture drift.png",
    )
)
def drift(
    seeds: Seeds = "tuning",
    count: Annotated[int, typer.Option(min=1, help="Days.")] = 1,
    hours: Annotated[float, typer.Option(min=0.5, max=48.0, help="How long a day is.")] = 24.0,
    sensor: options.Description = options.DEFAULT_DESCRIPTION,
    picture: Picture = None,
    as_json: options.JsonOutput = False,
) -> None:
    """Simulate days of a drifting skin, with and without a reference that follows drift.

    The temperature swings by 10 K over a day and steps by 2 K once; conductivity changes by 2 % per
    kelvin, a tenth of it unevenly. Pressed places creep by 1 % per decade of time and recover as
    slowly; contact impedances wander by 10 %. Presses last from seconds to two hours; a third of
    them are too light for the magnitude channel. There are two frames a second while a press
    changes, else one every 20 s (without tracking, every tenth of these). The skin is the twin's. A
    day takes some minutes.
    """
    from tactomo_models import load_description

    from tactomo_lab.commands.pictures import draw_day as draw_picture
    from tactomo_lab.evaluation.drifting import draw_day, live, summarise_day

    description = load_description(sensor)
    days, found, rows = [], {}, []
    for number in range(count):
        day = draw_day(description, seeds, number, hours)
        name = f"{seeds} {number}"
        seen = {}
        for way, every in (("tracked", 1), ("untracked", FEWER)):
            frames = live(day, track=way == "tracked", every=every)
            total = len(day.times_s(every))
            seen[way] = list(shown(frames, total, f"{name}, {way}"))
            found[f"{name}, {way}"] = summarise_day(seen[way], hours)
        days.append((day, seen))
        rows.append({"day": name, **{way: asdict(found[f"{name}, {way}"]) for way in seen}})
    what = f"{description.name}, {seeds} seeds, {hours:g} hours after one tare"
    tell(
        {**_settings(description.name, seeds, hours=hours), "days": rows},
        as_json,
        lambda console: print_suite(console, what, {"days": DAYS}, found),
        picture,
        lambda output: draw_picture(days[0][0], days[0][1], output),
    )

"""`tactomo evaluate field` and `paper`: how right the reconstruction is, where the truth is known.

`paper` repeats the paper's evaluation on simulated skins, its numbers beside ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from itertools import chain, product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from tactomo.cli import options
from tactomo.cli.commands import Group
from tactomo.cli.output import say, table
from tactomo.cli.plot.plot import picture_option

from tactomo_lab.commands.report import (
    Finding,
    Seeds,
    chosen_names,
    print_suite,
    shown,
    tell,
    usable,
)

if TYPE_CHECKING:
    from tactomo.cli.console import Console
    from tactomo_models import Press, SensorDescription

    from tactomo_lab.evaluation.play import Outcome
    from tactomo_lab.scenes.measures import Score


app = options.typer_app(
    name="evaluate",
    cls=Group,
    help="Measure the accuracy of reconstructions on data with known truth.",
    no_args_is_help=True,
)


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


class _Study(NamedTuple):
    """What was asked for."""

    description: SensorDescription
    seeds: Any
    scenes: int  # of each number of contacts
    sheets: int
    methods: Sequence[str]


@app.command(
    epilog=options.examples(
        "tactomo evaluate paper",
        "tactomo evaluate paper --figure 9,10 --method tikhonov,auto",
        "tactomo evaluate paper --figure 5 --count 10",
        "tactomo evaluate paper --seeds reporting --json > paper.json",
    )
)
def paper(
    figure: Annotated[str, typer.Option(help="The paper's figures, with commas.")] = "5,9,10",
    count: Annotated[
        int, typer.Option(min=1, max=10_000, help="Fig. 5: scenes of each number of contacts.")
    ] = 100,
    sheets: Annotated[
        int, typer.Option(min=1, max=1000, help="Figs. 9 and 10: sensors to press.")
    ] = 3,
    method: Annotated[
        list[str] | None,
        options.methods_option(" [tikhonov, cnn-single, cnn-multimodal; network, auto]"),
    ] = None,
    seeds: Seeds = "tuning",
    sensor: options.Description = options.DEFAULT_DESCRIPTION,
    as_json: options.JsonOutput = False,
) -> None:
    """Repeat the paper's evaluation on simulated skins, beside the paper's printed numbers.

    The paper's Figs. 9 (with 8) and 10 were measured on hardware; tactomo's figures are simulated,
    on sheets uneven by 5 % with noise on every voltage, 60 dB below those at rest. Fig. 5 is
    simulated in both: even sheets, ellipses that conduct worse than the sheet, white noise relative
    to the rms of the voltage changes. The first run simulates (half a second a scene) and keeps the
    voltages in the cache.
    """
    from tactomo_models import load_description

    from tactomo_lab.evaluation.paper import DEFAULT_METHODS

    figures = chosen_names(figure, EXPERIMENTS, "--figure")
    description = load_description(sensor)
    methods = usable(description, method or DEFAULT_METHODS)
    study = _Study(description, seeds, count, sheets, methods)
    parts = {name: EXPERIMENTS[name](study) for name in EXPERIMENTS if name in figures}

    def show(console: Console) -> None:
        console.print(
            f"Ours are simulated, not measured: {description.name}, {seeds} seeds; Figs. 9 and 10 "
            f"on {sheets} uneven sheet(s), one scan a press."
        )
        for part in parts.values():
            console.print(f"\n{part.words}", style="italic")
            console.print(part.table)
            console.print(part.caption, style="dim")

    told = {
        **{"simulated": True, "sensor": description.name, "seeds": seeds},
        **{"scenes_each": count, "sheets": sheets, "methods": methods},
        "figures": {name: part.facts for name, part in parts.items()},
    }
    tell(told, as_json, show)


def _simulation_study(study: _Study) -> Finding:
    from tactomo_lab.evaluation.paper import COUNTS, SNR_DB, paper_scenes, points_of
    from tactomo_lab.evaluation.play import play

    drawn = chain.from_iterable(
        paper_scenes(study.description, study.seeds, study.scenes, snr_db) for snr_db in SNR_DB
    )
    total = study.scenes * len(COUNTS) * len(SNR_DB) * len(study.methods)
    points = points_of(shown(play(drawn, *study.methods), total, "Fig. 5"))
    measures = (f"{measure} {n}" for measure in ("RIE", "ICC") for n in COUNTS)
    made = table("noise", "method", *measures, left=("method",))
    for snr_db in SNR_DB:
        for method in study.methods:
            of = [points[method, snr_db, n] for n in COUNTS]
            values = (*(f"{s.rie:.2f}" for s in of), *(f"{s.icc:.3f}" for s in of))
            noise = f"{snr_db:g} dB" if math.isfinite(snr_db) else "none"
            made.add_row(noise if method == study.methods[0] else "", method, *values)
        made.add_section()
    return Finding(
        "Fig. 5: error and correlation of the map by number of contacts, simulated",
        made,
        "noise: of the voltages' changes",
        [
            {"method": method, "snr_db": snr_db, "contacts": n, "summary": asdict(summary)}
            for (method, snr_db, n), summary in points.items()
        ],
    )


def _magnitudes(study: _Study) -> Finding:
    from tactomo_lab.evaluation.paper import PAPER_MAGNITUDE_ERROR, magnitude_errors, single_areas

    outcomes = _pressed(study, single_areas(study.description), "Figs. 8 and 9")
    errors = magnitude_errors(outcomes, study.description)
    made = table("method", "paper, hardware", "ours, simulated", "of range", "of contacts")
    for method in study.methods:
        of = [error for error in errors if error.method == method]
        theirs = PAPER_MAGNITUDE_ERROR.get(method)
        worst = max(of, key=lambda error: error.error)
        ours = _mean_and_deviation([e.error for e in of], "{:.0%}")
        made.add_row(
            method,
            "{error:.0%} (at {pressure_kpa:g} kPa)".format(**theirs) if theirs else "",
            f"{ours} (at {worst.pressure_kpa:g} kPa)",
            _mean_and_deviation([e.of_range for e in of], "{:.0%}"),
            _mean_and_deviation([e.of_contacts for e in of], "{:.0%}"),
        )
    return Finding(
        "Figs. 8 and 9: magnitude error over cases 1 to 4, at its worst pressure",
        made,
        "ours: of the method's own largest estimate, the paper's 0-1 normalisation; of range: of "
        "the change at 200 kPa; of contacts: likewise, of the magnitudes that contacts have",
        {
            "errors": [asdict(error) for error in errors],
            "paper_hardware": PAPER_MAGNITUDE_ERROR,
        },
    )


def _places(study: _Study) -> Finding:
    from tactomo_lab.evaluation.paper import PAPER_LOCALISATION_MM, locate, places

    found = [locate(each) for each in _pressed(study, places(study.description), "Fig. 10")]
    made = table("method", "paper, hardware", "ours, simulated", "contact", "one contact")
    for method in study.methods:
        of = [place for place in found if place.method == method]
        theirs = PAPER_LOCALISATION_MM.get(method)
        made.add_row(
            method,
            "{mean_mm:.1f} ± {std_mm:.1f}".format(**theirs) if theirs else "",
            _mean_and_deviation([place.mass_error_mm for place in of], "{:.1f}"),
            _mean_and_deviation([place.contact_error_mm for place in of], "{:.1f}"),
            f"{sum(place.contacts == 1 for place in of) / len(of):.0%}",
        )
    return Finding(
        "Fig. 10: localisation error in 25 places, mm, mean ± standard deviation",
        made,
        "ours: of the image's mass, as the paper's; contact: of the contact that is reported; "
        "one contact: share of presses in which one is",
        {
            "places": [asdict(place) for place in found],
            "paper_hardware": PAPER_LOCALISATION_MM,
        },
    )


EXPERIMENTS: dict[str, Callable[[_Study], Finding]] = {
    "5": _simulation_study,
    "9": _magnitudes,
    "10": _places,
}


def _pressed(study: _Study, presses: Sequence[Press], what: str) -> Iterable[Outcome]:
    """Press each sensor in turn, and reconstruct each press from a cold start by each method."""
    from tactomo_lab.evaluation.paper import pressed_in_turn
    from tactomo_lab.evaluation.play import play

    cases = chain.from_iterable(
        pressed_in_turn(study.description, study.seeds, sheet, presses)
        for sheet in range(study.sheets)
    )
    total = len(presses) * study.sheets * len(study.methods)
    return shown(play(cases, *study.methods), total, what)


def _mean_and_deviation(values: Iterable[float], form: str) -> str:
    """Mean and standard deviation of the numbers among some values, as the paper prints them."""
    import numpy as np

    known = [value for value in values if math.isfinite(value)]
    if not known:
        return "-"
    mean = form.format(np.mean(known))
    return f"{mean} ± {form.format(np.std(known))}" if len(known) > 1 else mean

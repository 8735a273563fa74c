"""`tactomo evaluate paper`: the paper's evaluation on simulated skins, its numbers beside ours."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from itertools import chain
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from tactomo.cli import options
from tactomo.cli.output import table

from tactomo_lab.commands.report import Seeds, chosen_names, shown, tell, usable

if TYPE_CHECKING:
    from rich.table import Table
    from tactomo.cli.console import Console
    from tactomo_models import SensorDescription

    from tactomo_lab.evaluation.paper import Arrangement, Frame, Rig

FIGURES = (5, 8, 9, 10, 11, 12)


class _Part(NamedTuple):
    """What came out of one experiment."""

    title: str
    table: Table
    caption: str
    facts: dict[int, Any]


class _Study(NamedTuple):
    """What was asked for."""

    description: SensorDescription
    seeds: Any
    scenes: int  # of each number of contacts
    rigs: Sequence[Rig]
    methods: Sequence[str]


app = options.typer_app()


@app.command(
    epilog=options.examples(
        "tactomo evaluate paper",
        "tactomo evaluate paper --figure 9,10 --method tikhonov,auto",
        "tactomo evaluate paper --figure 5 --count 10",
        "tactomo evaluate paper --seeds reporting --json > paper.json",
    )
)
def paper(
    figure: Annotated[
        str, typer.Option(help="The paper's figures, with commas.")
    ] = "5,8,9,10,11,12",
    count: Annotated[
        int, typer.Option(min=1, help="Fig. 5: scenes of each number of contacts.")
    ] = 100,
    sheets: Annotated[int, typer.Option(min=1, help="Figs. 8 to 12: sensors to press.")] = 3,
    snr: Annotated[
        float, typer.Option(help="Figs. 8 to 12: SNR of the voltages at rest, in dB.")
    ] = 60.0,
    method: Annotated[
        list[str] | None,
        options.methods_option(" [tikhonov, cnn-single, cnn-multimodal; network, auto]"),
    ] = None,
    seeds: Seeds = "tuning",
    sensor: options.Description = options.DEFAULT_DESCRIPTION,
    as_json: options.JsonOutput = False,
) -> None:
    """Repeat the paper's evaluation on simulated skins, beside the paper's printed numbers.

    The paper's Figs. 8 to 12 were measured on hardware; tactomo's figures are simulated, on sheets
    uneven by 5 % with noise on every voltage. Fig. 5 is simulated in both: even sheets, ellipses
    that conduct worse than the sheet, white noise relative to the rms of the voltage changes. The
    first run simulates (half a second a scene) and keeps the voltages in the cache.
    """
    from tactomo_models import load_description

    from tactomo_lab.evaluation.paper import DEFAULT_METHODS, Rig

    figures = {int(name) for name in chosen_names(figure, map(str, FIGURES), "--figure")}
    description = load_description(sensor)
    methods = usable(description, method or DEFAULT_METHODS)
    numbers = shown(range(sheets), sheets, "simulating sheets at rest")
    rigs = [Rig(description, seeds, number, snr_db=snr) for number in numbers]
    study = _Study(description, seeds, count, rigs, methods)
    parts = [
        experiment(study, asked)
        for of_figures, experiment in EXPERIMENTS.items()
        if (asked := figures.intersection(of_figures))
    ]

    def show(console: Console) -> None:
        console.print(
            f"Ours are simulated, not measured: {description.name}, {seeds} seeds; Figs. 8 to 12 "
            f"on {sheets} uneven sheet(s), {snr:g} dB of the voltages at rest, one scan a press."
        )
        for part in parts:
            console.print(f"\n{part.title}", style="italic")
            console.print(part.table)
            console.print(part.caption, style="dim")

    told = {
        "simulated": True,
        "sensor": description.name,
        "seeds": seeds,
        "scenes_each": count,
        "sheets": sheets,
        "snr_of_voltages_db": snr,
        "methods": methods,
        "figures": {str(n): found for part in parts for n, found in part.facts.items()},
    }
    tell(told, as_json, show)


def _simulation_study(study: _Study, asked: set[int]) -> _Part:
    from tactomo_lab.evaluation.paper import COUNTS, SNR_DB, cells, paper_scenes
    from tactomo_lab.evaluation.play import play

    drawn = chain.from_iterable(
        paper_scenes(study.description, study.seeds, study.scenes, snr_db=snr_db)
        for snr_db in SNR_DB
    )
    total = study.scenes * len(COUNTS) * len(SNR_DB) * len(study.methods)
    points = cells(shown(play(drawn, *study.methods), total, "Fig. 5"))
    measures = (f"{measure} {n}" for measure in ("RIE", "ICC") for n in COUNTS)
    made = table("noise", "method", *measures, left=("method",))
    summary = {(p.snr_db, p.method, p.contacts): p.summary for p in points}
    for snr_db in SNR_DB:
        for method in study.methods:
            of = [summary[snr_db, method, n] for n in COUNTS]
            values = (*(f"{s.rie:.2f}" for s in of), *(f"{s.icc:.3f}" for s in of))
            noise = f"{snr_db:g} dB" if math.isfinite(snr_db) else "none"
            made.add_row(noise if method == study.methods[0] else "", method, *values)
        made.add_section()
    return _Part(
        "Fig. 5: error and correlation of the map by number of contacts, simulated",
        made,
        "noise: of the voltages' changes",
        {5: [asdict(point) for point in points]},
    )


def _single_areas(study: _Study, asked: set[int]) -> _Part:
    from tactomo_lab.evaluation.paper import PAPER_MAGNITUDE_ERROR, SINGLE, magnitude_errors

    frames = _image(study, SINGLE, "Figs. 8 and 9")
    errors = magnitude_errors(frames, study.description)
    made = table("method", "paper, hardware", "ours, simulated", "of range", "of contacts")
    for method in study.methods:
        of = [error for error in errors if error.method == method]
        theirs = PAPER_MAGNITUDE_ERROR.get(method)
        worst = max(of, key=lambda error: error.error)
        ours = _mean_and_deviation([e.error for e in of], "{:.0%}")
        made.add_row(
            method,
            f"{theirs[0]:.0%} (at {theirs[1]:g} kPa)" if theirs else "",
            f"{ours} (at {worst.pressure_kpa:g} kPa)",
            _mean_and_deviation([e.of_range for e in of], "{:.0%}"),
            _mean_and_deviation([e.of_contacts for e in of], "{:.0%}"),
        )
    facts = {
        "errors": [asdict(error) for error in errors],
        "estimates": [
            {
                "method": frame.method,
                "sheet": frame.sheet,
                "case": frame.case.number,
                "pressure_kpa": frame.pressures_kpa[0],
                "value": frame.estimate,
            }
            for frame in frames
        ],
        "paper_hardware": {
            method: {"error": error, "pressure_kpa": kpa}
            for method, (error, kpa) in PAPER_MAGNITUDE_ERROR.items()
        },
    }
    return _Part(
        "Figs. 8 and 9: magnitude error over cases 1 to 4, at its worst pressure",
        made,
        "ours: of the method's own largest estimate, the paper's 0-1 normalisation; of range: of "
        "the change at 200 kPa; of contacts: likewise, of the magnitudes that contacts have",
        {9: facts},
    )


def _localisation(study: _Study, asked: set[int]) -> _Part:
    from tactomo_lab.evaluation.paper import LOCALISATION, PAPER_LOCALISATION_MM, locate

    places = [locate(frame, study.description) for frame in _image(study, LOCALISATION, "Fig. 10")]
    made = table("method", "paper, hardware", "ours, simulated", "contact", "one contact")
    for method in study.methods:
        of = [place for place in places if place.method == method]
        theirs = PAPER_LOCALISATION_MM.get(method)
        made.add_row(
            method,
            f"{theirs[0]:.1f} ± {theirs[1]:.1f}" if theirs else "",
            _mean_and_deviation([place.mass_error_mm for place in of], "{:.1f}"),
            _mean_and_deviation([place.contact_error_mm for place in of], "{:.1f}"),
            f"{sum(place.contacts == 1 for place in of) / len(of):.0%}",
        )
    facts = {
        "places": [asdict(place) for place in places],
        "paper_hardware": {
            method: {"mean_mm": mean, "std_mm": deviation}
            for method, (mean, deviation) in PAPER_LOCALISATION_MM.items()
        },
    }
    return _Part(
        "Fig. 10: localisation error in 25 places, mm, mean ± standard deviation",
        made,
        "ours: of the image's mass, as the paper's; contact: of the contact that is reported; "
        "one contact: share of presses in which one is",
        {10: facts},
    )


def _several_areas(study: _Study, asked: set[int]) -> _Part:
    from tactomo_lab.evaluation.paper import MORE, TWO, read_areas
    from tactomo_lab.scenes.measures import mean

    cases = {number: {11: TWO, 12: MORE}[number] for number in sorted(asked)}
    chosen = list(chain.from_iterable(cases.values()))
    frames = _image(study, chosen, " and ".join(f"Fig. {number}" for number in cases))
    read = [read_areas(frame, study.description) for frame in frames]
    columns = ("ICC", "told apart", "in order", "alike", "counted")
    made = table("case", "method", *columns, left=("method",))
    for case in chosen:
        for method in study.methods:
            of = [one for one in read if (one.case, one.method) == (case.number, method)]
            made.add_row(
                (f"{case.number}{'*' * case.ours}" if method == study.methods[0] else ""),
                method,
                f"{mean(one.icc for one in of):.3f}",
                f"{mean(one.told_apart for one in of):.0%}",
                f"{mean(right for one in of for right in one.ordered):.0%}",
                f"{mean(share for one in of for share in one.alike):.0%}",
                f"{mean(one.counted for one in of):.0%}",
            )
        made.add_section()
    facts = {
        number: [
            asdict(one) | {"ordered": one.ordered, "alike": one.alike}
            for one in read
            if one.case in {case.number for case in of_figure}
        ]
        for number, of_figure in cases.items()
    }
    return _Part(
        "Figs. 11 and 12: two to four areas, simulated; the paper prints no numbers",
        made,
        "told apart: the image falls below half between any two areas; in order: pairs of which "
        "the harder pressed one reads higher; alike: of pairs under one pressure, the lower "
        "reading over the other; counted: right number of contacts; *: places and sizes are ours",
        facts,
    )


EXPERIMENTS: dict[tuple[int, ...], Callable[[_Study, set[int]], _Part]] = {
    (5,): _simulation_study,
    (8, 9): _single_areas,
    (10,): _localisation,
    (11, 12): _several_areas,
}


def _image(study: _Study, cases: Sequence[Arrangement], what: str) -> list[Frame]:
    from tactomo_lab.evaluation.paper import image_cases

    presses = sum(len(case.pressures_kpa) for case in cases)
    total = presses * len(study.rigs) * len(study.methods)
    return list(shown(image_cases(study.rigs, cases, study.methods), total, what))


def _mean_and_deviation(values: Iterable[float], form: str) -> str:
    """Mean and standard deviation of the numbers among some values, as the paper prints them."""
    import numpy as np

    known = [value for value in values if math.isfinite(value)]
    if not known:
        return "-"
    mean = form.format(np.mean(known))
    return f"{mean} ± {form.format(np.std(known))}" if len(known) > 1 else mean

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

from tactomo_lab.commands.report import Finding, Seeds, chosen_names, shown, tell, usable

if TYPE_CHECKING:
    from tactomo.cli.console import Console
    from tactomo_models import Press, SensorDescription

    from tactomo_lab.evaluation.play import Outcome


class _Study(NamedTuple):
    """What was asked for."""

    description: SensorDescription
    seeds: Any
    scenes: int  # of each number of contacts
    sheets: int
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

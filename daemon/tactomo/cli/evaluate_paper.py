"""`tactomo evaluate paper`: the paper's evaluation on simulated skins, its numbers beside ours."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tactomo.cli.app import DEFAULT_DESCRIPTION, JsonOutput, examples
from tactomo.cli.evaluate import Seeds, evaluate_app, shown
from tactomo.cli.files import DescriptionOption
from tactomo.cli.plot import prepare_folder
from tactomo.errors import TactomoError

if TYPE_CHECKING:
    from rich.table import Table
    from tactomo_models import SensorDescription
    from tactomo_models.evaluation.paper import Case, Frame, Rig
    from tactomo_models.evaluation.paper_claims import Claim

FIGURES = (5, 7, 8, 9, 10, 11, 12)


@dataclass(frozen=True)
class _Part:
    """What came out of one experiment.

    Attributes:
        title, table, caption: to print.
        facts: the same for programs, by figure.
        claims: what the paper says, and whether it holds here.
        pictures: draws each figure.
    """

    title: str
    table: Table
    caption: str
    facts: dict[int, Any]
    claims: list[Claim]
    pictures: dict[int, Callable[[Path], None]]


@dataclass(frozen=True)
class _Study:
    """What was asked for.

    Attributes:
        description: the sensor.
        seeds: set of seeds.
        count: scenes of each number of contacts.
        rigs: sensors to press.
        methods: of reconstruction.
        left_out: methods that cannot be had, and why.
    """

    description: SensorDescription
    seeds: Any
    count: int
    rigs: Sequence[Rig]
    methods: Sequence[str]
    left_out: dict[str, str] = field(default_factory=dict)


@evaluate_app.command(
    epilog=examples(
        "tactomo evaluate paper",
        "tactomo evaluate paper --figure 9,10 --methods tikhonov,auto --picture figures",
        "tactomo evaluate paper --figure 5 --count 10",
        "tactomo evaluate paper --seeds reporting --json > paper.json",
    ),
)
def paper(
    figure: Annotated[
        str, typer.Option(help="The paper's figures, with commas.")
    ] = "5,7,8,9,10,11,12",
    count: Annotated[
        int, typer.Option(min=1, help="Fig. 5: scenes of each number of contacts.")
    ] = 100,
    sheets: Annotated[int, typer.Option(min=1, help="Figs. 7 to 12: sensors to press.")] = 3,
    snr: Annotated[
        float, typer.Option(help="Figs. 7 to 12: SNR of the voltages at rest, in dB.")
    ] = 60.0,
    methods: Annotated[
        str | None,
        typer.Option(
            help="How to reconstruct, with commas. [the paper's: tikhonov, cnn-single, "
            "cnn-multimodal; ours: network, hybrid, auto]"
        ),
    ] = None,
    seeds: Seeds = "tuning",
    sensor: DescriptionOption = DEFAULT_DESCRIPTION,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Draw each figure into it. Needs matplotlib."),
    ] = None,
    as_json: JsonOutput = False,
) -> None:
    """Repeat the paper's evaluation on simulated skins, and set its printed numbers beside ours.

    Theirs of Figs. 7 to 12 were measured on hardware; ours are simulated, on sheets uneven by 5 %
    with noise on every voltage. Fig. 5 is simulated there and here: even sheets, ellipses that
    conduct worse than the sheet, white noise by the rms of the voltage changes. The first run
    simulates (half a second a scene) and keeps the voltages in the cache.
    """
    from tactomo_models import load_description
    from tactomo_models.evaluation.paper import DEFAULT_METHODS, Rig, usable_methods

    figures = _figures(figure)
    wanted = _methods(methods) if methods else DEFAULT_METHODS
    if picture is not None:
        prepare_folder(picture)
    description = load_description(sensor)
    numbers = shown(range(sheets), sheets, "simulating sheets at rest")
    rigs = [Rig(description, seeds, number, snr_db=snr) for number in numbers]
    usable, left_out = usable_methods(rigs[0], wanted)
    if not usable:
        raise TactomoError(
            "none of the methods can be had: " + _because(left_out),
            "choose others with --methods",
        )
    study = _Study(description, seeds, count, rigs, usable, left_out)
    settings = {
        "simulated": True,
        "sensor": description.name,
        "seeds": seeds,
        "scenes_each": count,
        "sheets": sheets,
        "snr_of_voltages_db": snr,
        "methods": usable,
        "left_out": left_out,
    }
    if not as_json:
        _print_settings(settings)
    parts = []
    for numbers_of, experiment in EXPERIMENTS.items():
        asked = figures.intersection(numbers_of)
        if asked:
            part = experiment(study, asked)
            parts.append(part)
            if not as_json:
                _print(part)
            if picture is not None:
                for number, draw in part.pictures.items():
                    draw(picture / f"figure_{number}.png")
    if as_json:
        typer.echo(json.dumps(_as_json(settings, parts), indent=2))
    if picture is not None:
        typer.echo(
            f"wrote {sum(len(part.pictures) for part in parts)} pictures to {picture}", err=True
        )


def _figures(text: str) -> set[int]:
    """The numbers from "5,7"."""
    try:
        numbers = {int(part) for part in text.split(",")}
    except ValueError:
        numbers = set()
    if not numbers or not numbers.issubset(FIGURES):
        known = ", ".join(map(str, FIGURES))
        raise typer.BadParameter(f"--figure {text!r}: give numbers out of {known}, with commas")
    return numbers


def _methods(text: str) -> tuple[str, ...]:
    from tactomo_models.tier import METHODS

    names = tuple(part.strip() for part in text.split(","))
    unknown = [name for name in names if name not in METHODS]
    if unknown:
        raise typer.BadParameter(
            f"--methods {unknown[0]!r}: give names out of {', '.join(METHODS)}, with commas"
        )
    return names


def _because(left_out: dict[str, str]) -> str:
    return "; ".join(f"{method}: {why}" for method, why in left_out.items())


# ------------------------------------------------------------------ the experiments


def _simulation_study(study: _Study, asked: set[int]) -> _Part:
    from itertools import chain

    from tactomo_models.evaluation.paper import COUNTS, SNR_DB, cells, paper_scenes
    from tactomo_models.evaluation.paper_claims import simulation_claims
    from tactomo_models.evaluation.still import reconstruct_scenes

    drawn = chain.from_iterable(
        paper_scenes(study.description, study.seeds, study.count, snr_db=snr_db)
        for snr_db in SNR_DB
    )
    total = study.count * len(COUNTS) * len(SNR_DB) * len(study.methods)
    points = cells(shown(reconstruct_scenes(drawn, *study.methods), total, "Fig. 5"))

    def draw(path: Path) -> None:
        from tactomo.cli.evaluate_paper_pictures import draw_simulation

        draw_simulation(points, path)

    title = "Fig. 5: error and correlation of the map by number of contacts, simulated"
    table = _table()
    for name in ("noise", "method", *(f"RIE {n}" for n in COUNTS), *(f"ICC {n}" for n in COUNTS)):
        left = name in ("noise", "method")
        table.add_column(name, justify="left" if left else "right", no_wrap=True)
    summary = {(p.snr_db, p.method, p.contacts): p.summary for p in points}
    for snr_db in SNR_DB:
        for method in study.methods:
            of = [summary[snr_db, method, n] for n in COUNTS]
            values = (*(f"{s.rie:.2f}" for s in of), *(f"{s.icc:.3f}" for s in of))
            first = method == study.methods[0]
            table.add_row(_decibels(snr_db) if first else "", method, *values)
        table.add_section()
    return _Part(
        title,
        table,
        "",
        {5: [asdict(point) for point in points]},
        simulation_claims(points),
        {5: draw},
    )


def _response_test(study: _Study, asked: set[int]) -> _Part:
    from tactomo_models.evaluation.paper import RESPONSE_KPA, measure_response
    from tactomo_models.evaluation.paper_claims import response_claims

    total = len(RESPONSE_KPA) * len(study.rigs)
    points = list(shown(measure_response(study.rigs), total, "Fig. 7"))

    def draw(path: Path) -> None:
        from tactomo.cli.evaluate_paper_pictures import draw_response

        draw_response(points, path)

    title = "Fig. 7: largest value of the Tikhonov image at (36, 36) mm, simulated"
    table = _table()
    for name in ("pressure, kPa", "magnitude channel", "structure channel"):
        table.add_column(name, justify="right")
    for kpa in RESPONSE_KPA:
        at = [point for point in points if point.pressure_kpa == kpa]
        values = [[point.peak[name] for point in at] for name in study.description.modalities]
        table.add_row(f"{kpa:g}", *(_mean_and_spread(of, "{:.4f}") for of in values))
    return _Part(
        title,
        table,
        "",
        {7: [asdict(point) for point in points]},
        response_claims(points),
        {7: draw},
    )


def _single_areas(study: _Study, asked: set[int]) -> _Part:
    from tactomo_models.evaluation.paper import SINGLE, magnitude_errors, magnitude_estimates
    from tactomo_models.evaluation.paper_claims import MAGNITUDE_ERROR, magnitude_claims

    frames = _image(study, SINGLE, "Figs. 8 and 9")
    errors = magnitude_errors(frames, study.description)
    estimates = magnitude_estimates(frames)

    def draw_8(path: Path) -> None:
        from tactomo.cli.evaluate_paper_pictures import draw_images

        draw_images(frames, study.description, path)

    def draw_9(path: Path) -> None:
        from tactomo.cli.evaluate_paper_pictures import draw_traces

        draw_traces(frames, errors, path)

    title = "Figs. 8 and 9: magnitude error over cases 1 to 4, at its worst pressure"
    table = _table()
    for name in ("method", "paper, hardware", "ours, simulated", "of range", "of contacts"):
        table.add_column(name, justify="left" if name == "method" else "right")
    for method in study.methods:
        of = [error for error in errors if error.method == method]
        theirs = MAGNITUDE_ERROR.get(method)
        worst = max(of, key=lambda error: error.error)
        table.add_row(
            method,
            f"{theirs[0]:.0%} (at {theirs[1]:g} kPa)" if theirs else "",
            f"{_mean_and_spread([e.error for e in of], '{:.0%}')} (at {worst.pressure_kpa:g} kPa)",
            _mean_and_spread([e.of_range for e in of], "{:.0%}"),
            _mean_and_spread([e.of_contacts for e in of], "{:.0%}"),
        )
    caption = (
        "ours: of the method's own largest estimate, the paper's 0-1 normalisation; of range: of "
        "the change at 200 kPa; of contacts: likewise, of the magnitudes that contacts have"
    )
    facts = {
        "errors": [asdict(error) for error in errors],
        "estimates": [
            {"method": method, "sheet": sheet, "case": case, "pressure_kpa": kpa, "value": value}
            for (method, sheet, case, kpa), value in estimates.items()
        ],
        "paper_hardware": {
            method: {"error": error, "pressure_kpa": kpa}
            for method, (error, kpa) in MAGNITUDE_ERROR.items()
        },
    }
    pictures = {8: draw_8, 9: draw_9}
    return _Part(
        title,
        table,
        caption,
        {9: facts},
        magnitude_claims(estimates, errors),
        {number: pictures[number] for number in sorted(asked)},
    )


def _localisation(study: _Study, asked: set[int]) -> _Part:
    from tactomo_models.evaluation.paper import LOCALISATION, locate
    from tactomo_models.evaluation.paper_claims import LOCALISATION_MM, localisation_claims

    places = [locate(frame, study.description) for frame in _image(study, LOCALISATION, "Fig. 10")]

    def draw(path: Path) -> None:
        from tactomo.cli.evaluate_paper_pictures import draw_places

        draw_places(places, study.description, path)

    title = "Fig. 10: localisation error in 25 places, mm, mean ± standard deviation"
    table = _table()
    for name in ("method", "paper, hardware", "ours, simulated", "contact", "one contact"):
        table.add_column(name, justify="left" if name == "method" else "right")
    for method in study.methods:
        of = [place for place in places if place.method == method]
        theirs = LOCALISATION_MM.get(method)
        table.add_row(
            method,
            f"{theirs[0]:.1f} ± {theirs[1]:.1f}" if theirs else "",
            _mean_and_spread([place.mass_error_mm for place in of], "{:.1f}"),
            _mean_and_spread([place.contact_error_mm for place in of], "{:.1f}"),
            f"{sum(place.contacts == 1 for place in of) / len(of):.0%}",
        )
    caption = (
        "ours: of the image's mass, as the paper's; contact: of the contact that is reported; "
        "one contact: share of presses in which one is"
    )
    facts = {
        "places": [
            asdict(p) | {"mass_error_mm": p.mass_error_mm, "contact_error_mm": p.contact_error_mm}
            for p in places
        ],
        "paper_hardware": {
            method: {"mean_mm": middle, "std_mm": spread}
            for method, (middle, spread) in LOCALISATION_MM.items()
        },
    }
    return _Part(title, table, caption, {10: facts}, localisation_claims(places), {10: draw})


def _several_areas(study: _Study, asked: set[int]) -> _Part:
    from tactomo_models.evaluation.measures import mean
    from tactomo_models.evaluation.paper import MORE, TWO, read_areas
    from tactomo_models.evaluation.paper_claims import several_areas_claims

    cases = {11: TWO, 12: MORE}
    chosen = [case for number in sorted(asked) for case in cases[number]]
    frames = _image(study, chosen, " and ".join(f"Fig. {number}" for number in sorted(asked)))
    read = [read_areas(frame, study.description) for frame in frames]

    def draws(number: int) -> Callable[[Path], None]:
        def draw(path: Path) -> None:
            from tactomo.cli.evaluate_paper_pictures import draw_images

            own = [frame for frame in frames if frame.case in cases[number]]
            draw_images(own, study.description, path, traces=number == 11)

        return draw

    title = "Figs. 11 and 12: two to four areas, simulated; the paper prints no numbers"
    table = _table()
    for name in ("case", "method", "ICC", "told apart", "in order", "alike", "counted"):
        table.add_column(name, justify="left" if name in ("case", "method") else "right")
    for case in chosen:
        for method in study.methods:
            of = [one for one in read if (one.case, one.method) == (case.number, method)]
            table.add_row(
                (f"{case.number}{'*' * case.ours}" if method == study.methods[0] else ""),
                method,
                f"{mean(one.icc for one in of):.3f}",
                f"{mean(one.told_apart for one in of):.0%}",
                f"{mean(right for one in of for right in one.ordered):.0%}",
                f"{mean(share for one in of for share in one.alike):.0%}",
                f"{mean(one.counted for one in of):.0%}",
            )
        table.add_section()
    caption = (
        "told apart: the image falls below half between any two areas; in order: pairs of which "
        "the harder pressed one reads higher; alike: of pairs under one pressure, the lower "
        "reading over the other; counted: right number of contacts; *: places and sizes are ours"
    )
    facts = {
        number: [
            asdict(one) | {"ordered": one.ordered, "alike": one.alike}
            for one in read
            if one.case in {case.number for case in cases[number]}
        ]
        for number in sorted(asked)
    }
    return _Part(
        title,
        table,
        caption,
        facts,
        several_areas_claims(read),
        {number: draws(number) for number in sorted(asked)},
    )


EXPERIMENTS: dict[tuple[int, ...], Callable[[_Study, set[int]], _Part]] = {
    (5,): _simulation_study,
    (7,): _response_test,
    (8, 9): _single_areas,
    (10,): _localisation,
    (11, 12): _several_areas,
}


def _image(study: _Study, cases: Sequence[Case], what: str) -> list[Frame]:
    from tactomo_models.evaluation.paper import frames_of, image_cases

    total = frames_of(cases) * len(study.rigs) * len(study.methods)
    return list(shown(image_cases(study.rigs, cases, study.methods), total, what))


# ------------------------------------------------------------------ how it is told


def _decibels(snr_db: float) -> str:
    return f"{snr_db:g} dB" if math.isfinite(snr_db) else "none"


def _mean_and_spread(values: Iterable[float], form: str) -> str:
    """Mean and standard deviation of the numbers among some values, as the paper prints them."""
    import numpy as np

    known = [value for value in values if math.isfinite(value)]
    if not known:
        return "-"
    middle = form.format(np.mean(known))
    return f"{middle} ± {form.format(np.std(known))}" if len(known) > 1 else middle


def _table() -> Table:
    from rich import box
    from rich.table import Table

    return Table(box=box.SIMPLE_HEAD, padding=0)


def _print_settings(settings: dict[str, Any]) -> None:
    from rich.console import Console

    console = Console()
    console.print(
        f"Ours are simulated, not measured: {settings['sensor']}, {settings['seeds']} seeds; "
        f"Figs. 7 to 12 on {settings['sheets']} uneven sheet(s), "
        f"{settings['snr_of_voltages_db']:g} dB of the voltages at rest, one scan a press."
    )
    for method, why in settings["left_out"].items():
        console.print(f"[yellow]{method} is left out[/]: {why}")


def _print(part: _Part) -> None:
    from rich.console import Console

    console = Console()
    console.print(f"\n[italic]{part.title}[/]")
    console.print(part.table)
    if part.caption:
        console.print(f"[dim]{part.caption}[/]")
    console.print("\n[italic]what the paper says of it, and whether that holds here[/]")
    told = _table()
    for name in ("the paper", "seen on", "ours, simulated", "holds"):
        told.add_column(name)
    for claim in part.claims:
        holds = {True: "yes", False: "no", None: "-"}[claim.holds]
        told.add_row(
            claim.says, claim.source, claim.ours or "needs methods that were not run", holds
        )
    console.print(told)


def _as_json(settings: dict[str, Any], parts: Sequence[_Part]) -> dict[str, Any]:
    figures = {str(number): facts for part in parts for number, facts in part.facts.items()}
    claims = [asdict(claim) for part in parts for claim in part.claims]
    told: dict[str, Any] = _finite({**settings, "figures": figures, "claims": claims})
    return told


def _finite(value: Any) -> Any:
    """The same with None for what JSON cannot hold: an infinite ratio, a measure of nothing."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value

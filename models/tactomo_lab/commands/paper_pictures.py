"""Pictures of `tactomo evaluate paper`: the paper's figures, drawn of simulated skins."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tactomo.cli.plot.plot import save_figure

if TYPE_CHECKING:
    from tactomo_models import SensorDescription

    from tactomo_lab.evaluation.paper import Cell, Frame, Localisation, MagnitudeError, Response

# The paper's own colours for its three methods.
COLOURS = {
    "tikhonov": "black",
    "cnn-single": "tab:red",
    "cnn-multimodal": "tab:blue",
    "network": "tab:green",
    "auto": "tab:purple",
}
PRESSURE_COLOURS = ("black", "tab:blue", "tab:green", "tab:red")  # of Figs. 9 and 11 (b)
TRUE = "truth"
COLUMNS = 8  # of images side by side
# What stands for what in Fig. 10; no colour is the method's own.
MARKS: tuple[tuple[dict[str, Any], str], ...] = (
    ({"marker": ".", "linestyle": "", "color": "black", "markersize": 4}, "pressed here"),
    ({"marker": "o", "linestyle": "", "color": "", "fillstyle": "none"}, "mass of the image"),
    ({"marker": "+", "linestyle": "", "color": "tab:gray", "markersize": 6}, "contact reported"),
)


def draw_simulation(points: Sequence[Cell], output: Path) -> None:
    """Fig. 5: RIE above ICC by number of contacts, a column for each signal-to-noise ratio.

    Raises TactomoError where the picture cannot be written; so of all that follow.
    """
    from matplotlib.figure import Figure

    ratios = list(dict.fromkeys(point.snr_db for point in points))
    figure = Figure(figsize=(3.1 * len(ratios), 6), layout="constrained")
    figure.suptitle("Fig. 5 repeated, simulated: test scenes like the paper's", fontsize=11)
    rows = figure.subplots(2, len(ratios), sharex=True, sharey="row", squeeze=False)
    for column, snr_db in enumerate(ratios):
        for method in _methods(points):
            of = [p for p in points if (p.method, p.snr_db) == (method, snr_db)]
            contacts = [point.contacts for point in of]
            style = {"marker": "o", "markersize": 4, "color": COLOURS.get(method), "label": method}
            style["linestyle"] = "--" if method == "auto" else "-"  # it often is another one's
            rows[0, column].plot(contacts, [point.summary.rie for point in of], **style)
            rows[1, column].plot(contacts, [point.summary.icc for point in of], **style)
        rows[0, column].set_title("no noise" if np.isinf(snr_db) else f"SNR {snr_db:g} dB")
        rows[1, column].set(xlabel="contacts", xticks=contacts)
    rows[0, 0].set(ylabel="relative image error", ylim=(0, None))
    rows[1, 0].set(ylabel="image correlation coefficient", ylim=(None, 1))
    for axes in rows.flat:
        axes.grid(visible=True, alpha=0.3)
    handles, labels = rows[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    save_figure(figure, output)


def draw_response(points: Sequence[Response], output: Path) -> None:
    """Fig. 7: what each channel shows of a growing pressure, each over its last reading."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.5, 4), layout="constrained")
    axes = figure.subplots()
    pressures = np.array(sorted({point.pressure_kpa for point in points}))
    sheets = len({point.sheet for point in points})
    styles = {"structure": ("tab:blue", "o"), "magnitude": ("tab:red", "s")}
    for name, (colour, marker) in styles.items():
        peaks = np.array(
            [[p.peak[name] for p in points if p.pressure_kpa == kpa] for kpa in pressures]  # type: ignore[index]
        )
        peaks /= peaks[-1].mean()
        middle = peaks.mean(axis=1)
        axes.fill_between(pressures, peaks.min(axis=1), peaks.max(axis=1), color=colour, alpha=0.2)
        axes.plot(pressures, middle, marker=marker, color=colour, label=f"{name} channel")
    axes.set(
        xlabel="pressure (kPa)",
        ylabel="maximum of the Tikhonov image,\nover its mean at the last pressure",
        title=f"Fig. 7 repeated, simulated: mean and range over uneven sheets ({sheets})",
        ylim=(0, None),
    )
    axes.title.set_fontsize(10)
    axes.grid(visible=True, alpha=0.3)
    axes.legend()
    save_figure(figure, output)


def draw_images(
    frames: Sequence[Frame], description: SensorDescription, output: Path, *, traces: bool = False
) -> None:
    """Figs. 8, 11 and 12: the truth above each method's images, a column for each press.

    With `traces` the images' values row by row below, as Fig. 11 (b) has them.
    """
    from matplotlib.figure import Figure

    shown = _of_first_sheet(frames)
    methods, presses = _methods(shown), _presses(shown)
    parts = [presses[at : at + COLUMNS] for at in range(0, len(presses), COLUMNS)]
    height = 1.25 * (1 + len(methods)) + 0.45  # inches
    heights = [height] * len(parts) + [1.6 * len(methods) + 0.8] * traces
    figure = Figure(figsize=(1.25 * len(parts[0]) + 1.6, sum(heights) + 0.4), layout="constrained")
    figure.suptitle("Simulated, one uneven sheet; red: what presses, in kPa", fontsize=11)
    subfigures = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    for part, columns in zip(subfigures, parts, strict=False):
        _fill_images(part, shown, columns, description)
    if traces:
        _fill_traces(subfigures[-1], shown)
    save_figure(figure, output)


def _fill_images(
    figure: Any,
    shown: Sequence[Frame],
    columns: Sequence[tuple[int, tuple[float, ...]]],
    description: SensorDescription,
) -> None:
    rows = _image_rows(shown)
    panels = figure.subplots(len(rows), len(columns), squeeze=False)
    x, y = description.map_x_m * 1e3, description.map_y_m * 1e3
    for row, (name, images) in enumerate(rows.items()):
        largest = max(float(image.max()) for image, _ in images.values()) or 1.0
        for axes, press in zip(panels[row], columns, strict=True):
            image, frame = images[press]
            drawn = axes.imshow(
                image / largest, origin="lower", extent=(x[0], x[-1], y[0], y[-1]), vmin=0, vmax=1
            )
            axes.set(xticks=[], yticks=[])
            for contact in frame.truth.contacts:
                axes.add_patch(_outline(contact.x_m, contact.y_m, contact.area_m2))
        panels[row, 0].set_ylabel(name, fontsize=9)
    for axes, (case, pressures_kpa) in zip(panels[0], columns, strict=True):
        axes.set_title(f"case {case}\n{_kpa(pressures_kpa)}", fontsize=8)
    bar = figure.colorbar(drawn, ax=panels, shrink=0.6, pad=0.01)
    bar.set_label("|Δσ| over the method's largest", fontsize=8)


def draw_traces(frames: Sequence[Frame], errors: Sequence[MagnitudeError], output: Path) -> None:
    """Fig. 9: the images of the first sensor row by row, a colour for each pressure."""
    from matplotlib.figure import Figure

    from tactomo_lab.evaluation.paper import PAPER_MAGNITUDE_ERROR

    shown = _of_first_sheet(frames)
    figure = Figure(figsize=(13, 1.7 * len(_methods(shown)) + 1), layout="constrained")
    figure.suptitle("Fig. 9 repeated, simulated, one uneven sheet: images row by row", fontsize=11)
    for method, row in zip(_methods(shown), _fill_traces(figure, shown), strict=True):
        own = np.mean([error.error for error in errors if error.method == method])
        told = f"magnitude error, simulated: {own:.0%}"
        if method in PAPER_MAGNITUDE_ERROR:
            told += f"; paper, hardware: {PAPER_MAGNITUDE_ERROR[method][0]:.0%}"
        row[0].text(0.02, 0.97, told, transform=row[0].transAxes, fontsize=6.5, va="top")
    save_figure(figure, output)


def _fill_traces(figure: Any, shown: Sequence[Frame]) -> Any:
    """Draw, and return the panels: a row for each method, a column for each case."""
    methods, cases = _methods(shown), list(dict.fromkeys(frame.case.number for frame in shown))
    panels = figure.subplots(len(methods), len(cases), sharex=True, sharey="row", squeeze=False)
    for row, method in enumerate(methods):
        own = [frame for frame in shown if frame.method == method]
        largest = max(float(frame.image.max()) for frame in own) or 1.0
        for column, case in enumerate(cases):
            axes = panels[row, column]
            of_case = [frame for frame in own if frame.case.number == case]
            for start, (frame, colour) in enumerate(zip(of_case, PRESSURE_COLOURS, strict=False)):
                values = frame.image.ravel() / largest
                places = start * len(values) + np.arange(len(values))
                axes.plot(places, values, color=colour, linewidth=0.6)
                middle = (start + 0.5) * len(values)
                if row == 0:
                    axes.text(
                        middle,
                        1.25,
                        _kpa(frame.pressures_kpa),
                        color=colour,
                        ha="center",
                        va="bottom",
                        fontsize=7,
                    )
            axes.set(xticks=[], ylim=(0, 1.25))
        panels[row, 0].set_ylabel(f"{method}\n(0 to 1)", fontsize=8)
    for axes, case in zip(panels[-1], cases, strict=True):
        axes.set_xlabel(f"case {case}: map nodes, row by row", fontsize=8)
    return panels


def draw_places(
    places: Sequence[Localisation], description: SensorDescription, output: Path
) -> None:
    """Fig. 10: from where the first sensor was pressed to where each method's image has it."""
    from matplotlib.figure import Figure

    from tactomo_lab.evaluation.paper import PAPER_LOCALISATION_MM

    methods = _methods(places)
    columns = min(3, len(methods))
    rows = -(-len(methods) // columns)
    figure = Figure(figsize=(4.0 * columns, 4.4 * rows + 0.9), layout="constrained")
    figure.suptitle("Fig. 10 repeated, simulated, one uneven sheet", fontsize=11)
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    half = description.width_m * 500, description.height_m * 500
    for axes, method in zip(panels.flat, methods, strict=False):
        own = [place for place in places if place.method == method]
        errors = [place.mass_error_mm for place in own]
        colour = COLOURS.get(method, "tab:gray")
        for place in _of_first_sheet(own):
            x, y = zip((place.x_m, place.y_m), place.mass_m, strict=True)
            axes.plot(1e3 * np.array(x), 1e3 * np.array(y), color=colour, linewidth=0.8)
            for spot, (marker, _) in zip(
                ((place.x_m, place.y_m), place.mass_m, place.contact_m), MARKS, strict=True
            ):
                axes.plot(
                    *(1e3 * np.array(spot)), **(marker | {"color": marker["color"] or colour})
                )
        axes.set(xlim=(-half[0], half[0]), ylim=(-half[1], half[1]), aspect="equal")
        title = f"{method}: {np.nanmean(errors):.1f} ± {np.nanstd(errors):.1f} mm"
        if theirs := PAPER_LOCALISATION_MM.get(method):
            title += f"\npaper, hardware: {theirs[0]:.1f} ± {theirs[1]:.1f} mm"
        axes.set_title(title, fontsize=10)
        axes.tick_params(labelbottom=True)
        axes.set_xlabel("x (mm)")
        axes.grid(visible=True, alpha=0.3)
    for axes in list(panels.flat)[len(methods) :]:
        axes.set_axis_off()
    for marker, label in MARKS:
        panels[0, 0].plot([], [], label=label, **(marker | {"color": marker["color"] or "gray"}))
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    for axes in panels[:, 0]:
        axes.set_ylabel("y (mm)")
    save_figure(figure, output)


def _methods(items: Sequence[Any]) -> list[str]:
    return list(dict.fromkeys(item.method for item in items))


def _of_first_sheet(items: Sequence[Any]) -> list[Any]:
    return [item for item in items if item.sheet == items[0].sheet]


def _presses(frames: Sequence[Frame]) -> list[tuple[int, tuple[float, ...]]]:
    return list(dict.fromkeys((frame.case.number, frame.pressures_kpa) for frame in frames))


def _image_rows(
    frames: Sequence[Frame],
) -> dict[str, dict[tuple[int, tuple[float, ...]], tuple[Any, Frame]]]:
    """Images by row, the truth's first, and by press: each with the frame that it is of."""
    rows: dict[str, dict[tuple[int, tuple[float, ...]], tuple[Any, Frame]]] = {TRUE: {}}
    for frame in frames:
        press = frame.case.number, frame.pressures_kpa
        rows[TRUE][press] = frame.truth.map, frame
        rows.setdefault(frame.method, {})[press] = frame.image, frame
    return rows


def _outline(x_m: float, y_m: float, area_m2: float) -> Any:
    from matplotlib.patches import Circle

    radius_mm = 1e3 * float(np.sqrt(area_m2 / np.pi))
    return Circle((1e3 * x_m, 1e3 * y_m), radius_mm, fill=False, color="red", linewidth=0.6)


def _kpa(pressures_kpa: Sequence[float]) -> str:
    return ", ".join(f"{kpa:g}" for kpa in pressures_kpa)

"""The page that `tactomo plot` draws."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator
from tactomo_client import Contact, Frame
from tactomo_client.appearance import COLOURS, map_pixels, shown_image

from tactomo.cli.files.recorded_frames import TimedFrame
from tactomo.cli.plot.course import Course, Track
from tactomo.cli.plot.electrodes import draw_electrodes, outline_path
from tactomo.imaging.frames import description_fields
from tactomo.plain import counted, plain

if TYPE_CHECKING:
    from tactomo_models import SensorDescription

WIDTH_IN: Final = 12.0
STRIP_IN: Final = 2.75
PATH_IN: Final = 6.4
HEIGHTS_IN: Final = {"pressure": 2.0, "force": 1.5, "misfit": 1.2, "flags": 1.1, "timing": 1.3}
SIGMAS: Final = 2.0
GAP_S: Final = 0.5  # without a frame for so long, a line is broken
INK: Final = "0.25"
NUMBER_GAP: Final = 0.03  # of electrodes' numbers from them, of the sheet's longer side
LETTERS: Final = "abcdefghijkl"


def draw_page(
    course: Course,
    maps: Sequence[TimedFrame],
    description: SensorDescription | None,
    title: str,
) -> Figure:
    """Return the page with the panels that have data."""
    rows = [panel for panel in HEIGHTS_IN if _has_data(panel, course)]
    body_in = max(sum(HEIGHTS_IN[row] for row in rows), PATH_IN if course.tracks else 0.0)
    figure = Figure(figsize=(WIDTH_IN, STRIP_IN + body_in + 0.7), layout="constrained")
    named = f"{plain(title)}\n"
    figure.suptitle(named, fontsize=14, x=0.01, ha="left", fontweight="bold", parse_math=False)
    figure.text(0.01, 1 - 0.42 / figure.get_figheight(), _subtitle(course), color="0.4")
    column: Any = figure.subfigures(2, 1, height_ratios=(STRIP_IN, body_in))
    strip, body = column
    colours = _contact_colours(course)
    times = zip(LETTERS, (moment.time_s for moment in maps), strict=False)
    titles = [f"{letter}   {time_s:.2f} s" for letter, time_s in times]
    draw_strip(strip, [moment.frame for moment in maps], description, titles)
    if course.tracks:
        left, body = body.subfigures(1, 2, width_ratios=(1.0, 1.35))
        _draw_path(left, course, description, colours)
    _draw_rows(body, rows, course, maps, colours)
    return figure


def _subtitle(course: Course) -> str:
    began = datetime.fromtimestamp(course.start_ns * 1e-9).isoformat(" ", "seconds")
    length_s = course.times_s[-1] - course.times_s[0]
    words = (
        f"{course.sensor}, {began}",
        f"{length_s:.1f} s, {counted(len(course.times_s), 'frame')}, "
        f"{counted(len(course.tracks), 'contact')}",
    )
    return "   |   ".join(words)


def _has_data(panel: str, course: Course) -> bool:
    if panel == "force":
        return any(contact.force_n is not None for contact in course.contacts)
    return bool(course.tracks) or panel != "pressure"


def _contact_colours(course: Course) -> dict[str, Any]:
    palette = mpl.colormaps["tab10"].colors  # type: ignore[attr-defined]
    return {name: palette[i % len(palette)] for i, name in enumerate(course.tracks)}


def draw_strip(
    figure: Any,
    frames: Sequence[Frame],
    description: SensorDescription | None,
    titles: Sequence[str],
) -> None:
    """Draw the frames' maps side by side, on one scale, with a bar of its colours as tall."""
    about = {} if description is None else description_fields(description)
    axes_row = np.atleast_1d(figure.subplots(1, len(frames), sharey=True))
    for axes, frame, title in zip(axes_row, frames, titles, strict=True):
        _draw_map(axes, frame, about)
        if description is not None:
            _cut_out(axes, description)
        axes.set_title(title, fontsize=10)
    axes_row[0].set_ylabel("y (mm)")
    known = [s for frame in frames if (s := shown_image(frame, about))]
    if known:
        colours = LinearSegmentedColormap.from_list("map", np.array(COLOURS) / 255)
        scale = ScalarMappable(Normalize(0, known[0][1]), colours)
        left, right, bottom, top = axes_row[-1].axis()
        narrow = max(1.0, (top - bottom) / (right - left))  # a bar is as wide beside any map
        beside_last = axes_row[-1].inset_axes((1 + 0.05 * narrow, 0.0, 0.06 * narrow, 1.0))
        figure.colorbar(scale, cax=beside_last, label=_scale_label(frames[0]))


def _cut_out(axes: Any, description: SensorDescription) -> None:
    """Show a map within the sheet's outline alone."""
    shape = PathPatch(outline_path(description), transform=axes.transData)
    for image in axes.images:
        image.set_clip_path(shape)


def _scale_label(frame: Frame) -> str:
    if frame.pressure_kpa is not None:
        return "pressure (kPa)"
    return "|Δσ|/σ₀" if frame.map is not None else "pressed"


def _draw_map(axes: Any, frame: Frame, about: dict[str, Any]) -> None:
    pixels = map_pixels(frame, about)
    axes.tick_params(labelsize=7)
    axes.set_xlabel("x (mm)")
    if pixels is None or frame.x_mm is None or frame.y_mm is None:
        axes.text(0.5, 0.5, "no map", ha="center", transform=axes.transAxes)
        return
    (left, right), (bottom, top) = frame.x_mm, frame.y_mm
    dx, dy = ((right - left) / (pixels.shape[1] - 1), (top - bottom) / (pixels.shape[0] - 1))
    extent = (left - dx / 2, right + dx / 2, bottom - dy / 2, top + dy / 2)
    axes.imshow(pixels, origin="lower", extent=extent, interpolation="bilinear")
    for contact in frame.contacts:
        radius = math.sqrt(contact.area_mm2 / math.pi)
        axes.annotate(
            _short_words(contact),
            (contact.x_mm, contact.y_mm + radius),
            (0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=7,
            color="white",
            path_effects=[withStroke(linewidth=2, foreground="0.15")],
        )


def _short_words(contact: Contact) -> str:
    if contact.pressure_kpa is None and contact.max_kpa is not None:
        return f"{contact.id}: ≤ {contact.max_kpa:.0f} kPa"
    if contact.pressure_range == "below":
        return f"{contact.id}: light"
    if contact.pressure_kpa is None:
        return f"{contact.id}"
    least = "≥ " if contact.pressure_range == "above" else ""
    return f"{contact.id}: {least}{contact.pressure_kpa:.0f} kPa"


def _draw_path(
    figure: Any, course: Course, description: SensorDescription | None, colours: dict[str, Any]
) -> None:
    axes = figure.subplots()
    if description is not None:
        _draw_sheet(axes, description)
    for index, (name, track) in enumerate(course.tracks.items()):
        _, last = track[-1]
        aside = 7 + 10 * (index % 4), 5  # of tracks that end at one place each name is read
        at = last.x_mm, last.y_mm
        axes.annotate(name, at, aside, textcoords="offset points", color=colours[name])
        _draw_track(axes, track, colours[name])
    axes.set(aspect="equal", xlabel="x (mm)", ylabel="y (mm)")
    axes.set_title("path, from ○ to ●; dots by area", fontsize=10)


def _draw_sheet(axes: Any, description: SensorDescription) -> None:
    width, height = description.width_m * 1e3, description.height_m * 1e3
    for ring in description.sheet.outline.drawn():
        axes.fill(*(1e3 * ring.T), fill=False, edgecolor="0.4", linewidth=1.5)
    gap = NUMBER_GAP * max(width, height)
    draw_electrodes(axes, description, gap, fontsize=7, color="0.4")
    half_x, half_y = (side / 2 + 1.8 * gap for side in (width, height))
    axes.set(xlim=(-half_x, half_x), ylim=(-half_y, half_y))


def _draw_track(axes: Any, track: Track, colour: Any) -> None:
    x = [contact.x_mm for _, contact in track]
    y = [contact.y_mm for _, contact in track]
    sizes = [max(4.0, contact.area_mm2 / 25) for _, contact in track]
    axes.scatter(x, y, s=sizes, color=colour, alpha=0.12, linewidths=0, rasterized=True)
    axes.plot(x, y, color=colour, linewidth=1.2)
    axes.plot(x[0], y[0], "o", color=colour, markerfacecolor="white", markersize=7)
    axes.plot(x[-1], y[-1], "o", color=colour, markersize=7)


def _draw_rows(
    figure: Any,
    rows: Sequence[str],
    course: Course,
    maps: Sequence[TimedFrame],
    colours: dict[str, Any],
) -> None:
    heights = [HEIGHTS_IN[row] for row in rows]
    column = figure.subplots(len(rows), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    for row, axes in zip(rows, column, strict=True):
        _DRAW[row](axes, course, colours)
        axes.grid(visible=True, alpha=0.25)
        axes.tick_params(labelsize=8)
        for moment in maps:
            axes.axvline(moment.time_s, color="0.6", linewidth=0.7, linestyle=":", zorder=0)
    for letter, moment in zip(LETTERS, maps, strict=False):
        column[0].annotate(
            letter,
            (moment.time_s, 1.0),
            (0, 3),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            ha="center",
            fontsize=9,
            color=INK,
        )
    column[-1].set_xlabel("time (s)")
    column[0].set_xlim(course.times_s[0], max(course.times_s[-1], course.times_s[0] + 1e-3))


def _draw_pressure(axes: Any, course: Course, colours: dict[str, Any]) -> None:
    contacts = course.contacts
    if any(c.pressure_kpa is not None or c.pressure_range == "below" for c in contacts):
        _draw_quantity(axes, course, colours, "pressure_kpa", "pressure_sigma_kpa")
        _draw_light(axes, course, colours)
        axes.set_ylabel("pressure (kPa)")
    elif any(contact.magnitude is not None for contact in contacts):
        _draw_quantity(axes, course, colours, "magnitude", "magnitude_sigma")
        axes.set_ylabel("|Δσ|/σ₀")
    else:
        _draw_quantity(axes, course, colours, "area_mm2", "area_sigma_mm2")
        axes.set_ylabel("area (mm²)")
    axes.set_ylim(bottom=0)


def _draw_light(axes: Any, course: Course, colours: dict[str, Any]) -> None:
    """Mark along the bottom when a contact is too light to be measured; explain all marks."""
    across = axes.get_xaxis_transform()
    lights = 0
    for name, track in course.tracks.items():
        light = [t for t, c in track if c.pressure_range == "below"]
        if light:
            height = 0.05 + 0.06 * (lights % 4)
            lights += 1
            axes.plot(
                *_broken(light, [height] * len(light)),
                color=colours[name],
                linewidth=3,
                alpha=0.5,
                transform=across,
                label="touched, pressure unknown",
            )
    told = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    if told:
        axes.legend(told.values(), told, fontsize=7, loc="center left", handlelength=1.2)


def _draw_force(axes: Any, course: Course, colours: dict[str, Any]) -> None:
    _draw_quantity(axes, course, colours, "force_n", "force_sigma_n")
    axes.set_ylabel("force (N)")
    axes.set_ylim(bottom=0)


def _draw_quantity(
    axes: Any, course: Course, colours: dict[str, Any], name: str, sigma_name: str
) -> None:
    """Draw one number of each contact over time, with its uncertainty as a band.

    Lower bounds of pressures and forces are marks without a line.
    """
    for identity, track in course.tracks.items():
        known = [(t, c) for t, c in track if getattr(c, name) is not None]
        times = [t for t, _ in known]
        values = [None if _is_bound(c, name) else getattr(c, name) for _, c in known]
        bounds = [(t, getattr(c, name)) for t, c in known if _is_bound(c, name)]
        spread = SIGMAS * np.array([getattr(c, sigma_name) for _, c in known], float)
        xs, ys = _broken(times, values)
        _, bands = _broken(times, spread)
        style = {"color": colours[identity]}
        axes.plot(xs, ys, linewidth=1.1, **style)
        axes.plot(*_alone(xs, ys), ".", markersize=3, **style)
        axes.fill_between(xs, ys - bands, ys + bands, alpha=0.22, linewidth=0, **style)
        if bounds:
            axes.plot(*zip(*bounds, strict=True), "^", markersize=3, label="at least", **style)


def _is_bound(contact: Contact, name: str) -> bool:
    """Whether a pressure or force is a lower bound."""
    return name in ("pressure_kpa", "force_n") and contact.pressure_range == "above"


def _broken(times: Sequence[float], values: Iterable[Any]) -> tuple[Any, Any]:
    """Return the two as arrays, with a gap wherever nothing came for a while."""
    xs = np.asarray(times, dtype=float)
    ys = np.asarray(list(values), dtype=float)  # None becomes NaN
    gaps = np.flatnonzero(np.diff(xs) > GAP_S) + 1
    return np.insert(xs, gaps, np.nan), np.insert(ys, gaps, np.nan)


def _alone(xs: Any, ys: Any) -> tuple[Any, Any]:
    """Return the points between two gaps, which no line shows."""
    known = np.concatenate([[False], ~np.isnan(ys), [False]])
    alone = known[1:-1] & ~known[:-2] & ~known[2:]
    return xs[alone], ys[alone]


def _draw_misfit(axes: Any, course: Course, _: dict[str, Any]) -> None:
    axes.axhline(1.0, color="tab:green", linewidth=0.8, alpha=0.7)
    axes.plot(*_broken(course.times_s, course.misfits), color=INK, linewidth=0.8)
    known = [misfit for misfit in course.misfits if misfit is not None]
    if max(known, default=0.0) > 10 * max(1.0, float(np.median(known or [1.0]))):
        axes.set_yscale("log")
    else:
        axes.set_ylim(0, max(1.2, axes.get_ylim()[1]))
    axes.set_ylabel("misfit")


def _draw_flags(axes: Any, course: Course, _: dict[str, Any]) -> None:
    """Draw when each tier was at work, and when each flag was up, as bars."""
    tiers = [(tier, [t == tier for t in course.tiers]) for tier in dict.fromkeys(course.tiers)]
    names = sorted(set().union(*course.flags))
    flags = [(name, [name in up for up in course.flags]) for name in names]
    rows = [(*row, "0.6") for row in tiers] + [(*row, "tab:red") for row in flags]
    for height, (_name, present, colour) in enumerate(rows):
        axes.broken_barh(
            _bars(course.times_s, present), (height - 0.35, 0.7), color=colour, linewidth=0
        )
    axes.set_yticks(range(len(rows)), [plain(name) for name, _, _ in rows], parse_math=False)
    axes.tick_params(axis="y", labelsize=7)
    axes.set_ylim(len(rows) - 0.5, -0.5)


def _bars(times_s: Sequence[float], present: Sequence[bool]) -> list[tuple[float, float]]:
    """Return the stretches in which it was present, as (begin, length)."""
    step_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.05
    edges = np.flatnonzero(np.diff([False, *present, False]))
    return [
        (times_s[begin], times_s[end - 1] - times_s[begin] + step_s)
        for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    ]


def _draw_timing(axes: Any, course: Course, _: dict[str, Any]) -> None:
    known_ms = [age_s * 1e3 for age_s in course.ages_s if age_s is not None]
    periods_ms = np.diff(course.times_s) * 1e3
    axes.plot(course.times_s[1:], periods_ms, ".", color="0.65", markersize=2, label="period")
    if known_ms:
        times_s, ages_s = _broken(course.times_s, course.ages_s)
        axes.plot(times_s, ages_s * 1e3, color=INK, linewidth=0.8, label="age")
    lost_at = [t for t, lost in zip(course.times_s, course.lost, strict=True) if lost]
    for time_s in lost_at:
        axes.axvline(time_s, color="tab:red", linewidth=0.8, alpha=0.6)
    whole_ms = float(periods_ms.sum())  # a clock may stand still, or have been set back
    rate_hz = 1e3 * len(periods_ms) / whole_ms if whole_ms > 0 else math.nan
    ages = "age unknown: made of the recording"
    if known_ms:
        ages = f"age {np.median(known_ms):.1f} ms (99 %: {np.percentile(known_ms, 99):.1f})"
    words = f"{rate_hz:.1f} frames/s; {ages}; "
    words += f"{counted(sum(course.lost), 'frame')} lost, "
    words += f"{counted(sum(course.left_out), 'dual scan')} left out"
    axes.set_title(words, fontsize=8, loc="right", pad=2, color=INK)
    if known_ms:
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("")
        axes.set_ylim(top=4.0 * axes.get_ylim()[1])  # for the legend
    else:
        axes.set_ylim(0.0, 2.0 * float(np.median(periods_ms)) if len(periods_ms) else None)
    axes.set_ylabel("ms")
    axes.legend(fontsize=7, loc="upper right", ncols=2, handlelength=1.0)


_DRAW: Final[dict[str, Callable[[Any, Course, dict[str, Any]], None]]] = {
    "pressure": _draw_pressure,
    "force": _draw_force,
    "misfit": _draw_misfit,
    "flags": _draw_flags,
    "timing": _draw_timing,
}

"""A pressure calibration as a picture, and as text in a terminal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactomo.cli.plot import save_figure

if TYPE_CHECKING:
    from tactomo_models.calibration import Reading
    from tactomo_models.calibration_file import PressureCalibration
    from tactomo_models.pressure import PressureCurve

MARKERS = {"up": "^", "down": "v", "unknown": "o"}
TEXT_MARKS = {"up": "▲", "down": "▽", "unknown": "o"}
LABELS = {"up": "load rising", "down": "load falling", "unknown": "reading"}


def draw_calibration(made: PressureCalibration, output: Path) -> None:
    """Draw readings and curve, and where it says nothing.

    Raises:
        TactomoError: the picture cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    axes: Any = figure.subplots()
    curve = made.curve
    low, high = curve.range_kpa
    right = 1.08 * max(reading.pressure_kpa for reading in made.readings)
    axes.axvspan(0, low, color="0.92", label="below: touched, pressure unknown")
    axes.axvspan(high, right, color="0.82", label=f"above: at least {high:.0f} kPa")
    axes.plot(curve.pressure_kpa, curve.magnitude, color="tab:blue", label="curve")
    axes.fill_betweenx(
        curve.magnitude,
        curve.pressure_kpa - curve.sigma_kpa,
        curve.pressure_kpa + curve.sigma_kpa,
        color="tab:blue",
        alpha=0.25,
        label="± its standard uncertainty",
    )
    for direction, marker in MARKERS.items():
        of = [reading for reading in made.readings if reading.direction == direction]
        if of:
            axes.errorbar(
                [reading.pressure_kpa for reading in of],
                [reading.magnitude for reading in of],
                yerr=[reading.magnitude_sigma for reading in of],
                fmt=marker,
                color="black",
                markerfacecolor="none",
                capsize=2,
                linewidth=0.8,
                label=LABELS[direction],
            )
    axes.set(xlim=(0, right), xlabel="pressure (kPa)", ylabel="|Δσ|/σ₀")
    axes.set_ylim(bottom=0)
    axes.set_title(f"{made.subject.sensor}: {made.words}", fontsize=10)
    axes.legend(fontsize=8, loc="upper left")
    axes.grid(alpha=0.3)
    save_figure(figure, output)


def curve_text(
    readings: Sequence[Reading], curve: PressureCurve | None, columns: int = 60, rows: int = 14
) -> str:
    """Readings, and the curve through them, as lines of text: magnitude over pressure."""
    kpa = np.array([reading.pressure_kpa for reading in readings])
    top_kpa = 1.05 * max(kpa.max(initial=0.0), 1.0)
    top = 1.05 * max(0.01, *(reading.magnitude for reading in readings))
    cells = np.full((rows, columns), " ")

    def put(at_kpa: float, magnitude: float, mark: str) -> None:
        column = min(columns - 1, int(at_kpa / top_kpa * columns))
        row = min(rows - 1, int(magnitude / top * rows))
        cells[rows - 1 - row, column] = mark

    if curve is not None:
        for at_kpa in np.linspace(*curve.range_kpa, 2 * columns):
            put(at_kpa, float(np.interp(at_kpa, curve.pressure_kpa, curve.magnitude)), "·")
    for reading in readings:
        put(reading.pressure_kpa, reading.magnitude, TEXT_MARKS[reading.direction])
    lines = ["".join(row).rstrip() for row in cells]
    axis = f"0{'kPa':>{columns // 2}}{top_kpa:>{columns - columns // 2 - 1}.0f}"
    return "\n".join([f"|Δσ|/σ₀ up to {top:.2f}", *(f"│{line}" for line in lines), f"└{axis}"])

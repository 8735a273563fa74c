"""A pressure calibration as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactomo.cli.plot.plot import save_figure
from tactomo.plain import plain

if TYPE_CHECKING:
    from tactomo_models.calibration.calibration_file import PressureCalibration

MARKERS = {"up": "^", "down": "v", "unknown": "o"}
LABELS = {"up": "load rising", "down": "load falling", "unknown": "reading"}


def draw_calibration(made: PressureCalibration, output: Path) -> None:
    """Draw readings and curve; raise TactomoError where the picture cannot be written."""
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
    title = plain(f"{made.subject.sensor}: {made.words}")
    axes.set_title(title, fontsize=10, parse_math=False)
    axes.legend(fontsize=8, loc="upper left")
    axes.grid(alpha=0.3)
    save_figure(figure, output)

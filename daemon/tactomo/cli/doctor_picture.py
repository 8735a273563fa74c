"""The picture of `tactomo doctor`: electrodes on the sheet by health, and reciprocal voltages."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from tactomo_models import SensorDescription

from tactomo.cli.plot import save_figure

if TYPE_CHECKING:
    from tactomo_models.diagnosis import Diagnosis

    from tactomo.cli.doctor_evidence import Evidence

COLOURS = {
    "good": "tab:green",
    "doubtful": "0.6",  # good by itself, in a channel that is broken as a whole
    "dead": "black",
    "loose": "tab:orange",
    "misread": "tab:red",
    "swapped": "tab:purple",
}


def draw(evidence: Evidence, channels: dict[str, Diagnosis], output: Path) -> None:
    """Write the picture: a row a channel."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4.2 * len(channels)), layout="constrained")
    figure.suptitle(evidence.title)
    rows: Any = figure.subplots(len(channels), 3, squeeze=False)
    for axes, (name, diagnosis) in zip(rows, channels.items(), strict=True):
        _draw_electrodes(axes[0], evidence, diagnosis)
        _draw_reciprocity(axes[1], diagnosis)
        _draw_noise(axes[2], diagnosis)
        axes[0].set_title(f"{name}: {diagnosis.level}")
    save_figure(figure, output)


def _draw_electrodes(axes: Any, evidence: Evidence, diagnosis: Diagnosis) -> None:
    centres = _centres(evidence, len(diagnosis.electrodes))
    good = "doubtful" if diagnosis.level == "broken" else "good"
    states = [good if state == "good" else state for state in diagnosis.electrodes]
    for state in sorted(set(states), key=list(COLOURS).index):
        members = [n for n, has in enumerate(states) if has == state]
        axes.scatter(*centres[members].T, s=220, color=COLOURS[state], label=state)
    for number, (x, y) in enumerate(centres):
        axes.text(x, y, str(number), ha="center", va="center", color="white", fontsize=8)
    axes.set(aspect="equal", xlabel="x (mm)", ylabel="y (mm)")
    axes.margins(0.15)
    axes.legend(loc="center")


def _centres(evidence: Evidence, count: int) -> NDArray[np.float64]:
    """Electrodes' centres in mm; of an unknown sheet on a circle, counter-clockwise."""
    if isinstance(evidence.layout, SensorDescription):
        return evidence.layout.electrode_centres_m * 1e3
    angle = np.radians(-90) + 2 * np.pi * np.arange(count) / count
    return 50 * np.column_stack([np.cos(angle), np.sin(angle)])


def _draw_reciprocity(axes: Any, diagnosis: Diagnosis) -> None:
    i, j = diagnosis.reciprocal.T
    one, other = np.abs(diagnosis.volts[i]), np.abs(diagnosis.volts[j])
    known = (one > 0) & (other > 0)
    if not known.any():
        axes.text(0.5, 0.5, "no reciprocal pairs", ha="center", transform=axes.transAxes)
        return
    axes.loglog(one[known], other[known], ".", markersize=4)
    ends = [min(one[known].min(), other[known].min()), max(one.max(), other.max())]
    axes.loglog(ends, ends, color="0.6", linewidth=0.8)
    axes.set(xlabel="|V(drive; measure)| (V)", ylabel="|V(measure; drive)| (V)", aspect="equal")
    axes.set_title("reciprocity: on the line is good")


def _draw_noise(axes: Any, diagnosis: Diagnosis) -> None:
    if not np.isfinite(diagnosis.snr_db).any():
        axes.text(0.5, 0.5, "noise not known", ha="center", transform=axes.transAxes)
        return
    size = np.abs(diagnosis.volts)
    axes.semilogx(size[size > 0], diagnosis.snr_db[size > 0], ".", markersize=4)
    axes.set(xlabel="|V| (V)", ylabel="SNR (dB)", title="signal to noise of each voltage")
    axes.grid(visible=True, alpha=0.3)

"""A skin made by hand, simulated: electrodes a millimetre off, uneven contacts, an uneven sheet.

It is glued on with folds, too, which no voltage tells: a place on the robot is another one on it.
A cover takes part of the load: a third more force presses than the sheet feels.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from tactomo_models import Press, SensorDescription, SkinSimulator, load_description
from tactomo_models.arrays import FloatArray
from tactomo_models.sensor.description_file import shipped_text
from variants import variant

COARSE = {"nodes_x": 25, "nodes_y": 25}
FOLD_MM, FOLD_LENGTH_MM = 1.5, 25.0
RADIUS_M = 0.010  # of the indenter
LOAD = 4 / 3  # force on the cover over that on the sheet
SNR = 100.0  # of a voltage's change: 40 dB


def described() -> SensorDescription:
    """What the skin was to be; coarse, so that a press takes a tenth of a second."""
    return variant(load_description("paper_square"), map=COARSE)


def write_description(path: Path) -> Path:
    """The same as a file."""
    path.write_text(shipped_text("paper_square") + "\n[map]\nnodes_x = 25\nnodes_y = 25\n")
    return path


def on_robot(sheet_mm: FloatArray) -> FloatArray:
    """Where places (..., 2) on the sheet are on the robot that it was glued on: up to 2 mm off."""
    return np.asarray(sheet_mm + FOLD_MM * np.sin(sheet_mm[..., ::-1] / FOLD_LENGTH_MM))


def on_sheet(robot_mm: FloatArray) -> FloatArray:
    """The other way round."""
    sheet_mm = robot_mm
    for _ in range(8):  # each leaves a tenth of the error
        sheet_mm = sheet_mm + robot_mm - on_robot(sheet_mm)
    return sheet_mm


def presses(count: int, *, seed: int, skin: int = 0) -> dict[str, Any]:
    """The arrays of a file of presses on one of several such skins."""
    made = variant(described(), electrodes={"pitch_m": 0.037})
    simulator = SkinSimulator(made, unevenness=0.10, impedance_spread=0.30, seed=skin)
    rng = np.random.default_rng(seed)
    rest = simulator.voltages([])
    xy_mm = rng.uniform(-50, 50, (count, 2))
    pressures_kpa = rng.uniform(160, 220, count)
    pressed = [
        simulator.voltages([Press(1e-3 * x, 1e-3 * y, kpa, RADIUS_M)])
        for (x, y), kpa in zip(xy_mm, pressures_kpa, strict=True)
    ]
    force_n = LOAD * np.pi * RADIUS_M**2 * 1e3 * pressures_kpa
    arrays: dict[str, Any] = {"xy_mm": on_robot(xy_mm), "force_n": force_n}
    for name, volts in rest.items():
        scans = np.array([each[name] for each in pressed])
        noise = np.sqrt(np.mean((scans - volts) ** 2)) / SNR
        arrays[f"{name}_reference"] = volts + 0.2 * noise * rng.standard_normal(volts.shape)
        arrays[str(name)] = scans + noise * rng.standard_normal(scans.shape)
    return arrays

"""What training scenes are like, as hard as a real skin; and the paper's test scenes.

A scene is drawn from a seed and its number. No seed of a training scene is one of the
evaluation's: the set's name is part of both.

Lengths and pressures are those of a sheet of 150 mm whose response table ends at 300 kPa, the
paper's; on another sensor they scale with its shorter side and with its own table.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.scene.press import Press, Shape
from tactomo_models.scene.pressure import PressureCurve
from tactomo_models.sensor.description import SensorDescription

from tactomo_lab.scenes.drawing import (
    can_be_opposite,
    draw_contrast,
    draw_indenter,
    placed_apart,
    scale_of,
    seed_of,
)
from tactomo_lab.scenes.simulation import UnevenSheet

END_KPA = 300.0  # of the response table that the pressures below are for

PAPER_CONTACTS = 4
PAPER_CHANGE = (0.05, 0.25)  # 0.95 to 0.75 S/m in a sheet of 1 S/m
PAPER_CONTRAST = 100.0

# Shares of scenes with none to ten contacts.
ROBUST_CONTACTS = (0.03, 0.20, 0.20, 0.18, 0.16, 0.06, 0.06, 0.03, 0.03, 0.03, 0.02)
ROBUST_HALF_AXIS_M = (0.005, 0.023)
CROWD = 5  # contacts, from which on they are small, for there is no room for others
CROWDED_HALF_AXIS_M = (0.005, 0.012)
MAX_ASPECT = 2.2
RING_HALF_AXIS_M = 0.010  # least of a ring
ROBUST_SHAPES: Final[dict[Shape, float]] = {"ellipse": 0.40, "rectangle": 0.35, "ring": 0.25}
# Shares of contacts by pressure: measurable, too light to be measured, beyond the range.
ROBUST_PRESSURE_KPA = ((0.70, 140.0, 210.0), (0.15, 20.0, 140.0), (0.15, 200.0, 300.0))
SOFT = 0.2  # share of scenes in which all contacts are soft ellipses: pressure falls to their rim
DOMES = 0.15  # share of soft contacts in the other scenes, likewise ellipses
DOME_PEAK = 1.3  # of a dome's pressure, over that of a punch
ROBUST_GAP_M = 0.004
MAX_UNEVEN = 0.12  # standard deviation of a sheet's smooth conductivity error
IMPEDANCE_DEVIATION = 0.3  # standard deviation of the logarithm of contact impedances
SAME_SKIN = 4  # scenes in a row that have the same sheets, which saves a third of the time
WEAK_ELECTRODES = 0.03  # share of scenes with one whose contact impedance is
WEAK_FACTOR = (5.0, 50.0)  # so many times the others'
MAX_DISPLACED_M = 0.0014  # standard deviation of the electrodes' places along the rim, at most


@dataclass(frozen=True)
class TrainingScene:
    """A scene to simulate."""

    presses: tuple[Press, ...]  #: what presses
    contrast: float  #: of the structure channel when saturated
    opposite: bool  #: whether the magnitude channel changes against the description's sign
    sheets: tuple[UnevenSheet, UnevenSheet]  #: the magnitude and the structure sheet
    #: (2, L) by how much each electrode of theirs sits off along the rim, counter-clockwise
    displaced_m: FloatArray


def paper_presses(
    description: SensorDescription, rng: np.random.Generator, count: int
) -> tuple[Press, ...]:
    """Draw ellipses that do not overlap, as the paper trains and tests on (section III-C-2).

    Raises DataError where there is no room for so many.
    """
    assert description.magnitude is not None
    curve = PressureCurve.of_response(description.magnitude.response)
    scale = scale_of(description)

    def one() -> Press:
        change = draw_indenter(description, rng, "ellipse", pressure_kpa=PAPER_CHANGE, scale=scale)
        return replace(change, pressure_kpa=float(curve.pressure(np.array(change.pressure_kpa))))

    return placed_apart(description, count, 0.0, one)


def draw_scene(description: SensorDescription, seed: int, number: int) -> TrainingScene:
    """Draw none to ten contacts of any form and pressure, on sheets as uneven as real ones.

    Raises DataError where there is no room for so many contacts.
    """
    rng = np.random.default_rng(seed_of("training", "robust", seed, number))
    skin = np.random.default_rng(seed_of("training", "robust skin", seed, number // SAME_SKIN))
    opposite = bool(skin.integers(2)) and can_be_opposite(description)
    (one, one_off), (other, other_off) = (_draw_sheet(description, skin) for _ in range(2))
    count = int(rng.choice(len(ROBUST_CONTACTS), p=ROBUST_CONTACTS))
    gap = scale_of(description) * ROBUST_GAP_M
    half_axis_m = ROBUST_HALF_AXIS_M if count < CROWD else CROWDED_HALF_AXIS_M
    soft = bool(rng.random() < SOFT)

    press = partial(_any_press, description, rng, half_axis_m, soft=soft)
    presses = placed_apart(description, count, gap, press)
    off_m = np.stack([one_off, other_off])
    return TrainingScene(presses, draw_contrast(rng), opposite, (one, other), off_m)


def _any_press(
    description: SensorDescription,
    rng: np.random.Generator,
    half_axis_m: tuple[float, float],
    *,
    soft: bool,
) -> Press:
    shape = tuple(ROBUST_SHAPES)[rng.choice(len(ROBUST_SHAPES), p=tuple(ROBUST_SHAPES.values()))]
    shape = "ellipse" if soft else shape
    shares = [share for share, _, _ in ROBUST_PRESSURE_KPA]
    _, *pressures = ROBUST_PRESSURE_KPA[rng.choice(len(shares), p=shares)]
    domed = soft or (shape == "ellipse" and rng.random() < DOMES / ROBUST_SHAPES["ellipse"])
    assert description.magnitude is not None
    scale = description.magnitude.response.pressure_kpa[-1] / END_KPA
    low, high = (scale * kpa * (DOME_PEAK if domed else 1.0) for kpa in pressures)
    return draw_indenter(
        description,
        rng,
        shape,
        profile="dome" if domed else "flat",
        pressure_kpa=(low, high),
        half_axis_m=half_axis_m,
        ring_half_axis_m=RING_HALF_AXIS_M,
        aspect=MAX_ASPECT,
        scale=scale_of(description),
    )


def _draw_sheet(
    description: SensorDescription, rng: np.random.Generator
) -> tuple[UnevenSheet, FloatArray]:
    """A sheet, and by how much (L,) its electrodes sit off their places, metres."""
    electrodes = description.electrode_count
    impedance = np.exp(IMPEDANCE_DEVIATION * rng.standard_normal(electrodes))
    if rng.random() < WEAK_ELECTRODES:
        impedance[rng.integers(electrodes)] *= np.exp(rng.uniform(*np.log(WEAK_FACTOR)))
    sheet = UnevenSheet(int(rng.integers(2**63)), rng.uniform(0, MAX_UNEVEN), impedance)
    deviation_m = rng.uniform(0, scale_of(description) * MAX_DISPLACED_M)
    return sheet, deviation_m * rng.standard_normal(electrodes)

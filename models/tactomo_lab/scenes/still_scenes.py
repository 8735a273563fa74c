"""Random still scenes, to tune on and to report.

A scene is drawn from its seed: how many contacts, where, of what shape, size and pressure; the
true contrast of the structure channel; which way the magnitude channel changes; two uneven
sheets.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from tactomo_models.scene.press import Press
from tactomo_models.sensor.description import SensorDescription

from tactomo_lab.scenes.case import Case, Plan, measure, simulate
from tactomo_lab.scenes.drawing import (
    GAP_M,
    SHAPES,
    SeedSet,
    can_be_opposite,
    draw_contrast,
    draw_indenter,
    placed_apart,
    seed_of,
)

SceneShape = Literal["ellipse", "rectangle", "ring", "mixed"]

SCENE_SHAPES: tuple[SceneShape, ...] = ("ellipse", "rectangle", "ring", "mixed")
TRIES = 30  # of a contact, before all are drawn anew


def still_case(
    description: SensorDescription,
    plan: Plan,
    seed_set: SeedSet,
    number: int,
    snr_db: float,
) -> Case:
    """Simulate a plan of one frame and measure it with noise of this ratio of the change."""
    numbers = len(plan.frames[-1]), number
    simulated = simulate(description, plan, seed_of(seed_set, "sheet", *numbers))
    noise = seed_of(seed_set, "noise", *numbers)
    return measure(simulated, seed_set, number, noise, snr_db, is_tare_drawn_first=False)


def draw_still(
    description: SensorDescription, seed_set: SeedSet, contacts: int, number: int
) -> Plan:
    """Draw what presses and on what.

    Outlines lie inside the sensing area, up to its edge, and at least `GAP_M` apart: an indenter
    that finds no room is drawn anew, so that many contacts are smaller ones on average.

    Raises DataError where there is no room for so many.
    """
    rng = np.random.default_rng(seed_of(seed_set, "layout", contacts, number))
    shape = SCENE_SHAPES[rng.integers(4 if contacts > 1 else 3)]
    contrast, opposite = draw_contrast(rng), bool(rng.integers(2))
    opposite = opposite and can_be_opposite(description)

    def one() -> Press:
        return draw_indenter(
            description, rng, SHAPES[rng.integers(3)] if shape == "mixed" else shape
        )

    presses = placed_apart(description, contacts, GAP_M, one, tries=TRIES)
    return Plan((presses,), contrast, opposite, shape)

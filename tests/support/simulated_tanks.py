"""Tanks with objects in them, simulated on a finer mesh than the one that inverts."""

from __future__ import annotations

import hashlib

import numpy as np
from tactomo_lab.evaluation.tanks import Tanks
from tactomo_lab.scenes.drawing import SeedSet
from tactomo_lab.scenes.simulation import SHARP_M, UnevenSheet, centroids, fine_mesh, fitted_mesh
from tactomo_lab.tanks.model import pixel_grid
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.mesh import SheetMesh
from tactomo_models.scene.press import Press
from tactomo_models.sensor.description import SensorDescription

SIMULATED_ROWS = 128
# As uneven and noisy as the measured ones are by their reciprocity.
UNEVENNESS = 0.03
IMPEDANCE_SPREAD = 0.3
NOISE_SHARE = 0.035  # of a tank's typical voltage change
HALF_AXIS = (0.1, 0.28)  # of an object, over the tank's radius
THIN = (0.2, 0.4), (0.2, 0.45)  # that of a thin one, and its other one over that
GAP = 0.07  # least distance of two objects and from the wall, likewise


def simulated_tanks(
    description: SensorDescription, seed_set: SeedSet, count: int, thin: bool = False
) -> Tanks:
    """Draw and solve tanks of one to three objects of either kind, on a finer mesh than ours.

    Args:
        description: the tank.
        seed_set: "tuning" for whoever chooses a constant, "reporting" for published figures.
        count: of tanks.
        thin: whether objects are two to five times as long as wide.
    """
    mesh = fine_mesh(description)
    name = int.from_bytes(hashlib.sha256(f"{seed_set} tanks".encode()).digest()[:8])
    seeds = [np.random.default_rng([name, i]) for i in range(count)]
    drawn = [_simulated(description, mesh, rng, thin) for rng in seeds]
    return Tanks(
        tuple(f"{seed_set} {i}" for i in range(count)),
        np.array([changes for changes, _ in drawn]),
        np.array([truth for _, truth in drawn]),
    )


def _simulated(
    description: SensorDescription, mesh: SheetMesh, rng: np.random.Generator, thin: bool
) -> tuple[FloatArray, FloatArray]:
    radius_m = description.width_m / 2
    objects = _drawn_objects(radius_m, rng, thin)
    mesh = fitted_mesh(mesh, [outline for outline, _ in objects], description)
    points, (x, y, _) = centroids(mesh), pixel_grid(SIMULATED_ROWS)
    kind, truth = np.zeros(points.shape[1]), np.zeros(x.shape)
    for outline, sign in objects:
        kind[outline.coverage(points[0], points[1], SHARP_M) > 0.5] = sign
        truth[outline.coverage(radius_m * x, radius_m * y, SHARP_M) > 0.5] = sign
    assert description.structure is not None
    seed = int(rng.integers(2**63))
    impedance = np.exp(IMPEDANCE_SPREAD * rng.standard_normal(description.electrode_count))
    saline = UnevenSheet(seed, UNEVENNESS, impedance)
    ratio = description.structure.saturated_ratio**kind
    full = np.abs(saline.voltages(description, mesh, ratio))
    changes = full - np.abs(saline.voltages(description, mesh))
    noise = NOISE_SHARE * np.sqrt(np.mean(changes**2))
    return changes + noise * rng.standard_normal(len(changes)), truth


def _drawn_objects(
    radius_m: float, rng: np.random.Generator, thin: bool
) -> list[tuple[Press, int]]:
    """Outlines, and 1 or -1 for what conducts better or worse than the saline."""
    placed: list[tuple[Press, int]] = []
    wanted = int(rng.integers(1, 4))
    while len(placed) < wanted:
        long = radius_m * rng.uniform(*(THIN[0] if thin else HALF_AXIS))
        short = max(long * rng.uniform(0.5, 1), radius_m * HALF_AXIS[0])
        if thin:
            short = long * rng.uniform(*THIN[1])
        rectangle = bool(rng.integers(2))
        reach = float(np.hypot(long, short)) if rectangle else long
        away = np.sqrt(rng.uniform()) * radius_m
        angle = rng.uniform(0, 2 * np.pi)
        outline = Press(
            away * np.cos(angle),
            away * np.sin(angle),
            1.0,
            long,
            short,
            rng.uniform(0, np.pi),
            "rectangle" if rectangle else "ellipse",
        )
        free = away + reach < radius_m * (1 - GAP) and all(
            np.hypot(outline.x_m - other.x_m, outline.y_m - other.y_m)
            > reach + max(other.radius_m, other.radius_y_m or 0) + GAP * radius_m
            for other, _ in placed
        )
        if free:
            placed.append((outline, int(rng.choice([-1, 1]))))
    return placed

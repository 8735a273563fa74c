"""Simulated tanks to learn from: objects of many outlines, solved on a finer mesh than inverts."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt
from tactomo_models.arrays import FloatArray
from tactomo_models.sensor.description_file import load_description

from tactomo_lab.tanks.images import PIXELS, pixel_grid
from tactomo_lab.tanks.model import TankModel

SHARD = 250  # tanks in a file: a minute's work on a slow core
TANKS = ("tank_ktc2023", "tank_uef2017")
FINE_RINGS = 37  # of nodes: the mesh that inverts has 22
FINE = 4 * PIXELS  # pixels in which outlines are drawn
OBJECTS = (0.27, 0.36, 0.25, 0.12)  # shares of tanks with one to four
SIZE = (0.13, 0.4)  # of an object, centre to outline, over the radius
GAP = 0.06  # between two objects, and to the wall
CONTRAST = (1.0, 4.0)  # powers of ten, either way: metal and plastic, neither perfect
KINDS = ("circle", "ellipse", "box", "polygon", "blob", "cross", "arc")
SHARES = (0.20, 0.12, 0.18, 0.25, 0.10, 0.08, 0.07)


def simulate(models: list[TankModel], seed: int) -> Iterator[tuple[FloatArray, list[FloatArray]]]:
    """Draw and solve tanks without end.

    Args:
        models: the same tank with other electrodes, `FINE_RINGS` each.
        seed: of the scenes.

    Yields:
        (PIXELS, PIXELS) shares of the pixels that conduct better minus worse, no pixel is both;
        for each model the changes (P,) of the transfer resistances.
    """
    rng = np.random.default_rng([23, seed])
    corners = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4], [2, 2, 2]]) / 6
    # A triangle's conductivity is the geometric mean of four parts.
    parts = [np.einsum("ki,tid->tkd", corners, m.points[m.triangles]) for m in models]
    while True:
        kind = draw(rng)
        better, worse = np.log(10) * rng.uniform(*CONTRAST, 2)
        change = np.where(kind > 0, better, -worse) * np.abs(kind)
        solved = []
        for model, part in zip(models, parts, strict=True):
            column = np.clip(((part[..., 0] + 1) / 2 * FINE).astype(int), 0, FINE - 1)
            row = np.clip(((1 - part[..., 1]) / 2 * FINE).astype(int), 0, FINE - 1)
            conductivity = np.exp(change[row, column].mean(axis=1))
            solved.append(model.solve(conductivity)[0] - model.empty)
        cells = kind.reshape(PIXELS, FINE // PIXELS, PIXELS, FINE // PIXELS)
        yield cells.mean(axis=(1, 3)), solved


def draw(rng: np.random.Generator) -> FloatArray:
    """Objects (FINE, FINE): 1 in what conducts better, -1 worse."""
    x, y, _ = pixel_grid(FINE)
    kind = np.zeros(x.shape)
    wanted = 1 + rng.choice(len(OBJECTS), p=OBJECTS)
    while wanted:
        away, angle = 0.85 * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
        inside = _outline(rng, x - away * np.cos(angle), y - away * np.sin(angle))
        apart = distance_transform_edt(kind == 0) > GAP * FINE / 2
        if np.hypot(x, y)[inside].max(initial=2 * ~inside.any()) < 1 - GAP and apart[inside].all():
            kind[inside] = rng.choice([-1, 1])
            wanted -= 1
        elif rng.uniform() < 0.02:  # no room is left
            break
    return kind if kind.any() else draw(rng)


def _outline(rng: np.random.Generator, x: FloatArray, y: FloatArray) -> FloatArray:
    """Whether points about an object's centre are in it."""
    size, turn = rng.uniform(*SIZE), rng.uniform(0, 2 * np.pi)
    u, v = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
    r, angle = np.hypot(u, v), np.arctan2(v, u)
    thin = rng.uniform(0.25, 1)
    match rng.choice(KINDS, p=SHARES):
        case "circle":
            return r < size
        case "ellipse":
            return np.hypot(u, v / thin) < size
        case "box":
            return (np.abs(u) < size) & (np.abs(v) < size * thin)
        case "polygon":
            count = int(rng.integers(3, 7))
            at = 2 * np.pi * (np.arange(count) + rng.uniform(-0.35, 0.35, count)) / count
            far = size * rng.uniform(0.75, 1.25, count)
            px, py = far * np.cos(at), far * np.sin(at)
            cross = (np.roll(px, -1) - px) * (v[..., None] - py)
            return (cross > (np.roll(py, -1) - py) * (u[..., None] - px)).all(axis=-1)
        case "blob":
            wave = rng.normal(0, 0.15, (2, 3, 1, 1))
            order = np.arange(2, 5)[:, None, None] * angle
            return r < size * (1 + (wave[0] * np.cos(order) + wave[1] * np.sin(order)).sum(axis=0))
        case "cross":
            thin = 0.2 + 0.25 * thin
            return (np.hypot(u, v / thin) < size) | (np.hypot(v, u / thin) < size)
        case _:  # an arc
            inner = 1 - 0.25 - 0.2 * thin
            return (r < size) & (r > inner * size) & (np.abs(angle) < rng.uniform(0.8, 2.6))


def simulate_shard(first: int, size: int) -> dict[str, Any]:
    """Simulate the `size` tanks of a shard that begins with tank `first`, as both that ship.

    `change` (size, PIXELS, PIXELS) as `simulate` yields it; `tank_ktc2023` and `tank_uef2017`
    (size, P) the changes of their transfer resistances.
    """
    models = [TankModel(load_description(name), FINE_RINGS) for name in TANKS]
    kinds, solved = zip(*islice(simulate(models, first // SHARD), size), strict=True)
    by_tank = zip(TANKS, zip(*solved, strict=True), strict=True)
    changes = {name: np.array(change, np.float32) for name, change in by_tank}
    return {"change": np.array(kinds, np.float16), **changes}

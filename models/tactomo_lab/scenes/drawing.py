"""Drawing what presses: seeds, indenters, their outlines, and places apart from each other.

Tuning seeds and reporting seeds are two sets: the set's name is part of every seed, so that no
scene is in both, whatever its number.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from typing import Literal, TypeVar

import numpy as np
from scipy.spatial.distance import cdist
from tactomo_models.arrays import FloatArray
from tactomo_models.errors import DataError
from tactomo_models.scene.press import Press, Profile, Shape
from tactomo_models.sensor.description import SensorDescription
from tactomo_protocol import Channel

SeedSet = Literal["tuning", "reporting"]
Placed = TypeVar("Placed", bound=Press)

SIDE_M = 0.150  # of the paper's sheet, which lengths are given for
GAP_M = 0.009  # least distance of two outlines, where contacts are to be counted
HALF_AXIS_M = (0.007, 0.020)  # of every indenter, both axes
RING_HALF_AXIS_M = 0.012  # least of a ring: its hole is half as wide
MAX_ASPECT = 2.0
PRESSURE_KPA = (145.0, 200.0)
CONTRAST = (10.0, 100.0)
SHAPES: tuple[Shape, ...] = ("ellipse", "rectangle", "ring")
BOTH_CHANNELS: tuple[Channel, ...] = (Channel.MAGNITUDE, Channel.STRUCTURE)


def seed_of(seed_set: str, purpose: str, *numbers: int) -> np.random.SeedSequence:
    """Seed of one random draw; no number in one set leads to what another set or purpose has."""
    name = hashlib.sha256(f"{seed_set} {purpose}".encode()).digest()
    return np.random.SeedSequence([int.from_bytes(name), *numbers])


def require_channels(description: SensorDescription, *channels: Channel) -> None:
    """Refuse a sensor that lacks one of these channels, by a DataError."""
    for channel in channels:
        if channel not in description.channels:
            raise DataError(
                f"sensor {description.name!r} has no {channel} channel, which is needed here: "
                "choose another description"
            )


def can_be_opposite(description: SensorDescription) -> bool:
    """Whether the magnitude channel could change by as much the other way: by less than all."""
    if description.magnitude is None:
        return False
    return max(map(abs, description.magnitude.response.relative_change)) < 1


def scale_of(description: SensorDescription) -> float:
    """How large a sensor is, in sheets of 150 mm."""
    return min(description.width_m, description.height_m) / SIDE_M


def draw_contrast(rng: np.random.Generator) -> float:
    """True ratio of the structure channel's conductivities."""
    return float(np.exp(rng.uniform(*np.log(CONTRAST))))


def draw_indenter(
    description: SensorDescription,
    rng: np.random.Generator,
    shape: Shape,
    *,
    profile: Profile = "flat",
    pressure_kpa: tuple[float, float] = PRESSURE_KPA,  # of its peak
    half_axis_m: tuple[float, float] = HALF_AXIS_M,  # least and most of its longer one
    ring_half_axis_m: float = RING_HALF_AXIS_M,  # the least of a ring
    aspect: float = MAX_ASPECT,  # at most
    scale: float = 1.0,  # on lengths
) -> Press:
    """Draw an indenter of a shape anywhere on the sheet, turned any way."""
    least, most = half_axis_m
    least = ring_half_axis_m if shape == "ring" else least
    long = rng.uniform(least, most)
    return Press(
        x_m=rng.uniform(-0.5, 0.5) * description.width_m,
        y_m=rng.uniform(-0.5, 0.5) * description.height_m,
        pressure_kpa=rng.uniform(*pressure_kpa),
        radius_m=scale * long,
        radius_y_m=scale * rng.uniform(max(least, long / aspect), long),
        angle_rad=rng.uniform(0, np.pi),
        shape=shape,
        profile=profile,
    )


def placed_apart(
    description: SensorDescription,  # the sensor
    count: int,  # of contacts
    least_gap_m: float,  # between two outlines
    draw: Callable[[], Placed],  # draws a contact anywhere
    *,
    # of each contact before all are drawn anew; 40 a contact, for all together, if None
    tries: int | None = None,
) -> tuple[Placed, ...]:
    """Draw contacts inside the sensing area that lie apart; anew from the first if one has no room.

    Those that have no room for long are drawn smaller.

    Raises DataError where there is no room.
    """
    for trial in range(300):
        shrink = min(1.0, 60 / (trial + 1))
        placed: list[Placed] = []
        left = tries or 40 * count
        while len(placed) < count and left:
            left -= 1
            press = draw()
            press = replace(
                press,
                radius_m=press.radius_m * shrink,
                radius_y_m=(press.radius_y_m or press.radius_m) * shrink,
            )
            if is_inside(description, press) and all(
                gap_m(press, other) > least_gap_m for other in placed
            ):
                placed.append(press)
                left = tries or left
        if len(placed) == count:
            return tuple(placed)
    raise DataError(
        f"no room for {count} contacts on {description.name!r}: its sensing area is too small"
    )


def is_inside(description: SensorDescription, press: Press) -> bool:
    """Whether an indenter lies inside the sensing area."""
    x, y = outline_of(press)
    return bool(description.on_sheet(x, y, description.sheet.frame_width_m).all())


def outline_of(press: Press) -> FloatArray:
    """Points (2, n) along an indenter's outer outline, metres."""
    a, b = press.radius_m, press.radius_y_m or press.radius_m
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    u, v = np.cos(angle), np.sin(angle)
    if press.shape == "rectangle":
        longest = np.maximum(np.abs(u), np.abs(v))
        u, v = u / longest, v / longest
    cos, sin = np.cos(press.angle_rad), np.sin(press.angle_rad)
    x, y = cos * a * u - sin * b * v, sin * a * u + cos * b * v
    return np.stack([press.x_m + x, press.y_m + y])


def gap_m(one: Press, other: Press) -> float:
    """Distance of two indenters' outer outlines; 0 where they meet or one lies in the other."""
    first, second = outline_of(one), outline_of(other)
    if _covers(one, second) or _covers(other, first):
        return 0.0
    return float(cdist(first.T, second.T).min())


def _covers(press: Press, points: FloatArray) -> bool:
    filled = replace(press, shape="ellipse") if press.shape == "ring" else press
    return bool((filled.coverage(points[0], points[1], edge_m=1e-6) > 0.5).any())

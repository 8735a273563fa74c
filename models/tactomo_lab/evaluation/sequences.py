"""Moving scenes beside the choreography: presses of mixed kinds that move, a palm that comes.

Mixed presses are on skins made by hand, frame by frame at 20 a second. Each indenter has a lane of
its own, clear of the others: it lands, glides along it, changes its pressure, and lifts. A palm
comes in one second to ten minutes, while the daemon's reference follows the skin.
`moving.play` reconstructs and scores the frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.scene.press import Press
from tactomo_models.sensor.description import SensorDescription
from tactomo_protocol import Channel

from tactomo_lab.evaluation.moving import INDENTERS, Sequence, Step
from tactomo_lab.evaluation.regimes import (
    CONVERTER_DB,
    PALM_FRAMES,
    PALM_KPA,
    Draw,
    by_hand_as_told,
    draw_plan,
)
from tactomo_lab.evaluation.stability import simulate_plan
from tactomo_lab.scenes.still_scenes import (
    BOTH_CHANNELS,
    SeedSet,
    SimulatedVolts,
    noise_std,
    require_both_channels,
    seed_of,
)

COMING: Final = "coming"  # phase in which a palm is lighter than any
PALM_S = (1.0, 600.0)  # in which a palm comes
NoiseOf = Literal["each change", "voltage"]

NOISE_DB: Final[dict[NoiseOf, float]] = {"each change": 40.0, "voltage": CONVERTER_DB}
FRAMES = (60, 120)  # of a sequence
MAX_CONTACTS = 4  # of the first sequence, one fewer of each that follows
REST_FRAMES = 4  # before anything lands
LANDING_FRAMES = 3  # from the touch to the full pressure, and back
GLIDE_MM = (5.0, 30.0)  # way of a press, in at least `GLIDE_FRAMES`: 120 mm/s at most
GLIDE_FRAMES = 5


@dataclass(frozen=True, kw_only=True)
class Lane(Press):
    """The rectangle that an indenter glides in, along its x axis."""

    radius_y_m: float
    indenter: Press


def mixed_sequence(
    description: SensorDescription, seed_set: SeedSet, number: int, noise_of: NoiseOf
) -> Sequence:
    """Draw and simulate presses of mixed kinds that move: about 40 s, or read from the cache.

    Args:
        description: the sensor; needs both channels.
        seed_set: which of the two sets of seeds.
        number: of the sequence; the presses are the same whatever the noise.
        noise_of: "each change": 40 dB under the change of each frame, and none at rest, of which
            there is one scan; "voltage": 60 dB under the voltages at rest.

    Raises:
        DataError: the sensor has a single channel, or no room for what presses.
    """
    require_both_channels(description)
    rng = np.random.default_rng(seed_of(seed_set, "mixed-moving", number))
    draw = Draw(description, rng, number)
    steps = mixed_steps(draw)
    plan = by_hand_as_told(draw, *(tuple(step.presses.values()) for step in steps))
    planned = simulate_plan(description, plan, "mixed-moving", seed_set, number)
    at_rest = dict.fromkeys(BOTH_CHANNELS, 0.0)
    if noise_of == "voltage":
        at_rest = {n: noise_std(planned.volts, n, CONVERTER_DB, "voltage") for n in BOTH_CHANNELS}
    noise = {name: np.full(len(steps), std) for name, std in at_rest.items()}
    if noise_of == "each change":
        noise = {name: _noise_of_each(planned.volts, name) for name in BOTH_CHANNELS}
    return Sequence(
        name=f"{seed_set} {number}",
        description=planned.told,
        true_description=planned.true,
        steps=steps,
        volts=planned.volts,
        snr_db=NOISE_DB[noise_of],
        noise=noise,
        rest_noise=at_rest,
        seed=seed_of(seed_set, f"mixed-moving noise {noise_of}", number),
    )


def palm_sequence(description: SensorDescription, seed_set: SeedSet, number: int) -> Sequence:
    """Draw and simulate a palm that comes, a case of that regime: 7 s, or read from the cache.

    Raises:
        DataError: the sensor has a single channel.
    """
    require_both_channels(description)
    plan = draw_plan(description, "palm", seed_set, number)
    planned = simulate_plan(description, plan, "palm", seed_set, number)
    steps = tuple(_palm_step(presses) for presses in plan.frames)
    rng = np.random.default_rng(seed_of(seed_set, "palm seconds", number))
    period_s = float(np.exp(rng.uniform(*np.log(PALM_S)))) / PALM_FRAMES
    at_rest = {n: noise_std(planned.volts, n, plan.snr_db, plan.snr_of) for n in BOTH_CHANNELS}
    return Sequence(
        name=f"{seed_set} {number}",
        description=planned.told,
        true_description=planned.true,
        steps=steps,
        volts=planned.volts,
        snr_db=plan.snr_db,
        noise={name: np.full(len(steps), std) for name, std in at_rest.items()},
        rest_noise=at_rest,
        seed=seed_of(seed_set, "palm noise", number),
        period_s=period_s,
    )


def _palm_step(presses: tuple[Press, ...]) -> Step:
    is_there = any(press.pressure_kpa >= PALM_KPA[0] for press in presses)
    return Step("palm" if is_there else COMING, dict(zip(INDENTERS, presses, strict=False)))


def _noise_of_each(volts: SimulatedVolts, name: Channel) -> FloatArray:
    change = volts.pressed[name] - volts.rest[name]
    return np.asarray(np.sqrt(np.mean(change**2, axis=1)) * 10 ** (-NOISE_DB["each change"] / 20))


def mixed_steps(draw: Draw) -> tuple[Step, ...]:
    """Draw the frames of a sequence: presses of mixed kinds, each in a lane of its own."""
    lanes = draw.apart(MAX_CONTACTS - draw.number % MAX_CONTACTS, lambda: _draw_lane(draw))
    frames = int(draw.rng.integers(FRAMES[0], FRAMES[1] + 1))
    courses = dict(zip(INDENTERS, (_course(draw, lane, frames) for lane in lanes), strict=False))
    steps = []
    for frame in range(frames):
        here = {name: course[frame] for name, course in courses.items()}
        pressed = {name: press for name, press in here.items() if press.pressure_kpa > 0}
        steps.append(Step(f"{len(pressed)} pressed", pressed))
    return tuple(steps)


def _draw_lane(draw: Draw) -> Lane:
    """A lane anywhere, as wide as its indenter is however it is turned."""
    indenter = draw.any_kind()
    reach_m = _reach_m(indenter)
    return Lane(
        x_m=indenter.x_m,
        y_m=indenter.y_m,
        pressure_kpa=indenter.pressure_kpa,
        radius_m=reach_m + draw.rng.uniform(*GLIDE_MM) / 2 * draw.mm,
        radius_y_m=reach_m,
        angle_rad=draw.rng.uniform(0, np.pi),
        shape="rectangle",
        indenter=indenter,
    )


def _reach_m(press: Press) -> float:
    """Distance of its farthest point from its centre."""
    a, b = press.radius_m, press.radius_y_m or press.radius_m
    return float(np.hypot(a, b)) if press.shape == "rectangle" else max(a, b)


def _course(draw: Draw, lane: Lane, frames: int) -> list[Press]:
    """An indenter in every frame; of no pressure while it does not touch."""
    integers, frame = draw.rng.integers, np.arange(frames)
    third = frames // 3
    landed = int(integers(REST_FRAMES + LANDING_FRAMES, third))
    lifts = int(integers(2 * third, frames + third))  # every other one stays to the end
    starts, changes = integers(landed, lifts - GLIDE_FRAMES, 2)
    arrives, changed = integers((starts + GLIDE_FRAMES, changes + 1), lifts + 1)
    second_kpa = draw.rng.uniform(*draw.kpa_of(lane.indenter.profile))
    kpa = np.interp(
        frame,
        [landed - LANDING_FRAMES, landed, changes, changed, lifts, lifts + LANDING_FRAMES],
        [0, lane.indenter.pressure_kpa, lane.indenter.pressure_kpa, second_kpa, second_kpa, 0],
    )
    end_m = draw.rng.choice((-1, 1)) * (lane.radius_m - lane.radius_y_m)
    way_m = np.interp(frame, [starts, arrives], [-end_m, end_m])
    shrink = lane.radius_y_m / _reach_m(lane.indenter)  # of a lane that found no room
    indenter = replace(
        lane.indenter,
        radius_m=shrink * lane.indenter.radius_m,
        radius_y_m=shrink * (lane.indenter.radius_y_m or lane.indenter.radius_m),
    )
    return [
        replace(
            indenter,
            x_m=lane.x_m + along * np.cos(lane.angle_rad),
            y_m=lane.y_m + along * np.sin(lane.angle_rad),
            pressure_kpa=pressure,
        )
        for along, pressure in zip(way_m.tolist(), kpa.tolist(), strict=True)
    ]

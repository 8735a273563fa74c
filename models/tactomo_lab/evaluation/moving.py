"""Moving scenes, at 20 frames a second: a choreography, presses of mixed kinds, a palm that comes.

*The choreography*: contacts that slide, land, lift, jump, merge and split, lost scans and a tare,
in eleven phases, played on a sheet of its own with indenters, place, contrast and sign drawn from
its seed. What is asked: how well each phase is followed, whether contacts keep their identity, and
whether a wrong frame says so.

*Mixed presses* are on skins made by hand. Each indenter has a lane of its own, clear of the others:
it lands, glides along it, changes its pressure, and lifts. *A palm* comes in one second to ten
minutes, while the daemon's reference follows the skin.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import chain, combinations
from typing import Final, Literal

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.errors import DataError
from tactomo_models.scans.reference import Reference
from tactomo_models.scene.press import Press
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.simulation.simulator import noisy
from tactomo_protocol import Channel

from tactomo_lab.evaluation.regimes import (
    CONVERTER_DB,
    PALM_FRAMES,
    PALM_KPA,
    Draw,
    by_hand_as_told,
    draw_plan,
)
from tactomo_lab.scenes.case import (
    CONTACT_NAMES,
    REFERENCE_SCANS,
    Case,
    Frame,
    Plan,
    Simulated,
    noise_stds,
    simulate,
)
from tactomo_lab.scenes.drawing import (
    BOTH_CHANNELS,
    GAP_M,
    SeedSet,
    can_be_opposite,
    draw_contrast,
    gap_m,
    is_inside,
    seed_of,
)

Presses = Mapping[str, Press]
NoiseOf = Literal["each change", "voltage"]

TOUCHDOWN_KPA = 100.0  # of the first frame of a landing: the magnitude channel sees nothing yet
INDENTERS = CONTACT_NAMES[:8]
COMING: Final = "coming"  # phase in which a palm is lighter than any
PALM_S = (1.0, 600.0)  # in which a palm comes
NOISE_DB: Final[dict[NoiseOf, float]] = {"each change": 40.0, "voltage": CONVERTER_DB}
FRAMES = (60, 120)  # of a sequence of mixed presses
MAX_CONTACTS = 4  # of the first one, one fewer of each that follows
REST_FRAMES = 4  # before anything lands
LANDING_FRAMES = 3  # from the touch to the full pressure, and back
GLIDE_MM = (5.0, 30.0)  # way of a press, in at least `GLIDE_FRAMES`: 120 mm/s at most
GLIDE_FRAMES = 5


@dataclass(frozen=True)
class Step:
    """One frame of a moving scene, before it is measured."""

    phase: str  # its name
    presses: Presses  # what presses, by the name of each contact
    lost: tuple[Channel, ...] = ()  # channels whose scan is lost
    tare: bool = False  # whether the reference is taken anew before it

    @property
    def countable(self) -> bool:
        """Whether each contact touches another one, or is clear of it."""
        gaps = [gap_m(one, other) for one, other in combinations(self.presses.values(), 2)]
        return all(gap == 0 or gap >= GAP_M for gap in gaps)


# ------------------------------------------------------------------ the choreography


def choreography(
    # one of `INDENTERS`, radii up to 12 mm, at x and y in millimetres of the paper's sensor
    at: Callable[[str, float, float], Press],
) -> list[Step]:
    """All frames."""

    def path(
        name: str, start: tuple[float, float], end: tuple[float, float], frames: int
    ) -> list[Press]:
        share = np.arange(1, frames + 1)[:, None] / frames
        places = (1 - share) * np.array(start) + share * np.array(end)
        return [at(name, x_mm, y_mm) for x_mm, y_mm in places.tolist()]

    def lands(phase: str, name: str, press: Press, frames: int, **others: Press) -> list[Step]:
        light = replace(press, pressure_kpa=TOUCHDOWN_KPA)
        return [
            Step(phase, {**others, name: light}),
            *[Step(phase, {**others, name: press})] * (frames - 1),
        ]

    here, jumped, beside = at("B", 40, 30), at("A", 10, -40), at("C", -35, -40)
    towards, away = path("C", (-35, -40), (-2, -40), 12), path("C", (-2, -40), (-35, -40), 12)
    lost: dict[int, tuple[Channel, ...]] = {
        4: BOTH_CHANNELS,
        8: (Channel.STRUCTURE,),
        9: (Channel.STRUCTURE,),
        12: (Channel.MAGNITUDE,),
    }
    crowd = {
        "E": at("E", -35, 35),
        "F": at("F", 35, 32),
        "G": at("G", 33, -35),
        "H": at("H", -32, -30),
    }
    opposite_ways = zip(
        path("A", (35, -4), (-38, -4), 16), path("B", (-25, 30), (40, 30), 16), strict=True
    )
    return [
        *[Step("rest", {})] * 4,
        *lands("land", "A", at("A", -38, -38), 8),
        *[Step("slide", {"A": p}) for p in path("A", (-38, -38), (35, -4), 18)],
        *lands("second lands", "B", at("B", -25, 30), 8, A=at("A", 35, -4)),
        *[Step("pass", {"A": p, "B": q}) for p, q in opposite_ways],
        *[Step("still", {"A": at("A", -38, -4), "B": here})] * 10,
        *[Step("jump", {"A again": jumped, "B": here})] * 8,
        *[Step("lift", {"A again": jumped})] * 6,
        *lands("third lands", "C", beside, 6, **{"A again": jumped}),
        *[Step("merge", {"A again": jumped, "C": p}) for p in [*towards, *[towards[-1]] * 3]],
        *[Step("split", {"A again": jumped, "C": p}) for p in away],
        *[
            Step("lost scans", {"A again": p, "C": beside}, lost.get(index, ()))
            for index, p in enumerate(path("A", (10, -40), (10, 30), 16))
        ],
        *[Step("tare", {})] * 2,
        Step("tare", {}, tare=True),
        *[Step("tare", {"D": at("D", 5, 0)})] * 6,
        *[Step("four land", crowd)] * 10,
    ]


def draw_sequence(description: SensorDescription, seed_set: SeedSet, number: int) -> Case:
    """Draw and simulate the choreography: about a minute, or read from the cache.

    Raises DataError where there is no room on the sensor.
    """
    rng = np.random.default_rng(seed_of(seed_set, "moving", number))
    contrast, opposite = draw_contrast(rng), bool(rng.integers(2))
    steps = _draw_choreography(description, rng)
    opposite = opposite and can_be_opposite(description)
    plan = Plan(_frames(steps), contrast, opposite)
    simulated = simulate(description, plan, seed_of(seed_set, "moving sheet", number))
    under_load = np.array([bool(step.presses) for step in steps])
    pressed = {name: scans[under_load] for name, scans in simulated.volts.pressed.items()}
    loaded = replace(simulated.volts, pressed=pressed)
    noise = noise_stds(loaded, plan.snr_db, plan.snr_of)
    seed = seed_of(seed_set, "moving noise", number)
    return follow(simulated, steps, noise, np.random.default_rng(seed), seed_set, number)


def _draw_choreography(description: SensorDescription, rng: np.random.Generator) -> list[Step]:
    """Draw the choreography across the sheet, or across the largest round room on it."""
    quarters, mirrored = int(rng.integers(4)), bool(rng.integers(2))
    again = deepcopy(rng)  # the same indenters, smaller

    def across(rng: np.random.Generator, width_m: float, x_m: float, y_m: float) -> list[Step]:
        millimetre_m = width_m / 150
        indenters = _draw_indenters(rng, millimetre_m)

        def at(name: str, x_mm: float, y_mm: float) -> Press:
            there = replace(indenters[name], x_m=x_mm * millimetre_m, y_m=y_mm * millimetre_m)
            press = _turned(there, quarters, mirrored)
            return replace(press, x_m=press.x_m + x_m, y_m=press.y_m + y_m)

        return choreography(at)

    steps = across(rng, description.width_m, 0.0, 0.0)
    if not _fits(description, steps):
        steps = across(again, *_roomiest_place(description))
        if not _fits(description, steps):
            raise DataError(f"no room for the choreography on {description.name!r}")
    return steps


def _fits(description: SensorDescription, steps: Iterable[Step]) -> bool:
    return all(is_inside(description, press) for press in set(chain(*_frames(steps))))


def _roomiest_place(description: SensorDescription) -> tuple[float, float, float]:
    """Diameter of the largest circle on the sheet, and its centre (x, y); to a map's node."""
    x_m, y_m = np.meshgrid(description.map_x_m, description.map_y_m)
    depth_m = description.sheet.outline.depth(x_m, y_m)
    deepest = np.unravel_index(depth_m.argmax(), depth_m.shape)
    return 2 * float(depth_m[deepest]), float(x_m[deepest]), float(y_m[deepest])


def _frames(steps: Iterable[Step]) -> tuple[tuple[Press, ...], ...]:
    return tuple(tuple(step.presses.values()) for step in steps)


def _draw_indenters(rng: np.random.Generator, millimetre_m: float) -> Presses:
    return {
        name: Press(
            x_m=0.0,
            y_m=0.0,
            pressure_kpa=rng.uniform(150, 195),
            radius_m=rng.uniform(8, 12) * millimetre_m,
            radius_y_m=rng.uniform(8, 12) * millimetre_m,
            angle_rad=rng.uniform(0, np.pi),
        )
        for name in INDENTERS
    }


def _turned(press: Press, quarters: int, mirrored: bool) -> Press:
    """The same on a sheet turned by quarters of a turn, then mirrored about the y axis."""
    x, y, angle = press.x_m, press.y_m, press.angle_rad + quarters * np.pi / 2
    for _ in range(quarters):
        x, y = -y, x
    if mirrored:
        x, angle = -x, -angle
    return replace(press, x_m=x, y_m=y, angle_rad=angle)


# ------------------------------------------------------------------ measuring


def follow(
    simulated: Simulated,
    steps: Sequence[Step],
    # standard deviation of each channel's noise, volts: of all scans; (T,) of those of the steps,
    # and none at rest, of which there is one scan
    noise: Mapping[Channel, float | FloatArray],
    rng: np.random.Generator,
    seed_set: SeedSet,
    number: int,
    period_s: float | None = None,  # between frames, in which the reference follows the skin
) -> Case:
    """Measure a moving scene."""
    volts = simulated.volts

    def tare() -> Reference:
        if all(isinstance(std, float) for std in noise.values()):
            rest = noisy(volts.rest, noise, rng, REFERENCE_SCANS)
            return Reference.from_scans(*map(rest.get, Channel))
        # One scan at rest, as `batch` takes it, does not tell the noise: the others do.
        each = {name: np.reshape(std, (-1, 1)) for name, std in noise.items()}
        seen = noisy(volts.pressed, each, rng, len(steps))
        one = Reference(volts.rest.get(Channel.MAGNITUDE), volts.rest.get(Channel.STRUCTURE))
        return one.with_noise_of(simulated.told, *map(seen.get, Channel))

    first = tare()
    frames = []
    for index, step in enumerate(steps):
        anew = tare() if step.tare else None
        now = {name: pressed[index] for name, pressed in volts.pressed.items()}
        std = {name: np.broadcast_to(each, len(steps))[index] for name, each in noise.items()}
        scans = noisy(now, std, rng)
        kept = {name: scan for name, scan in scans.items() if name not in step.lost}
        time_s = index * (period_s or 0.0)
        frames.append(Frame(step.presses, kept, step.phase, anew, time_s, step.countable))
    about = simulated.plan, simulated.told, simulated.true
    return Case(seed_set, number, *about, first, frames, is_followed=period_s is not None)


# ------------------------------------------------------------------ mixed presses, and a palm


@dataclass(frozen=True, kw_only=True)
class Lane(Press):
    """The rectangle that an indenter glides in, along its x axis."""

    radius_y_m: float
    indenter: Press


def mixed_sequence(
    description: SensorDescription,  # the sensor
    seed_set: SeedSet,  # which of the two sets of seeds
    number: int,  # of the sequence; the presses are the same whatever the noise
    # "each change": 40 dB under the change of each frame, and none at rest, of which there is one
    # scan; "voltage": 60 dB under the voltages at rest
    noise_of: NoiseOf,
) -> Case:
    """Draw and simulate presses of mixed kinds that move: about 40 s, or read from the cache.

    Raises DataError where the sensor has no room for what presses.
    """
    draw = Draw(
        description, np.random.default_rng(seed_of(seed_set, "mixed-moving", number)), number
    )
    steps = mixed_steps(draw)
    plan = by_hand_as_told(draw, *_frames(steps))
    skin = seed_of(seed_set, "stability mixed-moving sheet", number)
    simulated = simulate(description, plan, skin)
    noise: Mapping[Channel, float | FloatArray] = noise_stds(
        simulated.volts, CONVERTER_DB, "voltage"
    )
    if noise_of == "each change":
        share = 10 ** (-NOISE_DB[noise_of] / 20)
        changes = {n: v - simulated.volts.rest[n] for n, v in simulated.volts.pressed.items()}
        noise = {n: np.sqrt(np.mean(v**2, axis=1)) * share for n, v in changes.items()}
    simulated = replace(simulated, plan=replace(plan, snr_db=NOISE_DB[noise_of]))
    seed = seed_of(seed_set, f"mixed-moving noise {noise_of}", number)
    return follow(simulated, steps, noise, np.random.default_rng(seed), seed_set, number)


def palm_sequence(description: SensorDescription, seed_set: SeedSet, number: int) -> Case:
    """Draw and simulate a palm that comes, a case of that regime: 7 s, or read from the cache.

    Raises DataError where the sensor has no room for a palm.
    """
    plan = draw_plan(description, "palm", seed_set, number)
    simulated = simulate(description, plan, seed_of(seed_set, "stability palm sheet", number))
    steps = []
    for presses in plan.frames:
        is_there = any(press.pressure_kpa >= PALM_KPA[0] for press in presses)
        named = dict(zip(INDENTERS, presses, strict=False))
        steps.append(Step("palm" if is_there else COMING, named))
    rng = np.random.default_rng(seed_of(seed_set, "palm seconds", number))
    period_s = float(np.exp(rng.uniform(*np.log(PALM_S)))) / PALM_FRAMES
    noise = noise_stds(simulated.volts, plan.snr_db, plan.snr_of)
    seed = seed_of(seed_set, "palm noise", number)
    return follow(simulated, steps, noise, np.random.default_rng(seed), seed_set, number, period_s)


def mixed_steps(draw: Draw) -> list[Step]:
    """Draw the frames of a sequence: presses of mixed kinds, each in a lane of its own."""
    lanes = draw.apart(MAX_CONTACTS - draw.number % MAX_CONTACTS, lambda: _draw_lane(draw))
    frames = int(draw.rng.integers(FRAMES[0], FRAMES[1] + 1))
    courses = dict(zip(INDENTERS, (_course(draw, lane, frames) for lane in lanes), strict=False))
    steps = []
    for frame in range(frames):
        here = {name: course[frame] for name, course in courses.items()}
        pressed = {name: press for name, press in here.items() if press.pressure_kpa > 0}
        steps.append(Step(f"{len(pressed)} pressed", pressed))
    return steps


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

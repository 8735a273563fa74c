"""Where methods fail: a named regime for each thing that goes wrong, and cases drawn of it.

A case is a plan: what presses in one frame or a few, on which sheets, through which device, and
what of that the reconstructor is not told. Its last frame is the one that is judged. Everything
else is as in the evaluation's scenes: uneven sheets and electrodes, a contrast of 10 to 100, either
sign of the magnitude channel, noise of 40 dB of the change.

Lengths are the paper's sensor's; on another one they are scaled by its size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.errors import DataError
from tactomo_models.scene.press import Press, Profile, Shape
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.sensor.description_file import load_description
from tactomo_protocol import Channel

from tactomo_lab.scenes.case import BadLead, Case, Plan, as_described, measure, simulate
from tactomo_lab.scenes.drawing import (
    PRESSURE_KPA,
    Placed,
    SeedSet,
    can_be_opposite,
    draw_contrast,
    draw_indenter,
    gap_m,
    is_inside,
    placed_apart,
    scale_of,
    seed_of,
)
from tactomo_lab.scenes.simulation import SheetState

Range = tuple[float, float]

SETTLED_FRAMES = 6  # of a scene that stays, before something happens
SLIDE_FRAMES = 4
CONVERTER_DB = 60.0  # of the voltage: a good converter's, where changes are small or none
SOFT_KPA = (180.0, 300.0)  # peak under a ball: well above where the magnitude channel answers
PALM_M = (0.030, 0.069)  # half axes of a palm: 60 mm across to what fits on the paper's sensor
PALM_KPA = (2.0, 200.0)
PALM_FRAMES = 16  # in which a palm comes
PALM_REST_FRAMES = 2  # before, and after, while it stays
OVERLOAD = (1.0, 2.0)  # pressure over the response table's end
FLAT_KPA = (145.0, 230.0)  # under a flat indenter beside balls
KINDS: Final[tuple[tuple[Shape, Profile], ...]] = (
    *(("ellipse", "flat"), ("rectangle", "flat"), ("ring", "flat")),
    ("ellipse", "dome"),
)


class Draw:
    """Draws what a case is made of."""

    def __init__(
        self, description: SensorDescription, rng: np.random.Generator, number: int
    ) -> None:
        self.description = description
        self.rng = rng
        self.number = number
        self.mm = 1e-3 * scale_of(description)

    def plan(self, *frames: Sequence[Press]) -> Plan:
        """A plan of these frames, on any sheet."""
        return Plan(
            frames=tuple(tuple(presses) for presses in frames),
            contrast=draw_contrast(self.rng),
            opposite=bool(self.rng.integers(2)) and can_be_opposite(self.description),
        )

    def scene(self, pressure_kpa: Range = PRESSURE_KPA) -> tuple[Press, ...]:
        """One to three ordinary contacts."""
        return self.apart(1 + self.number % 3, lambda: self.press(pressure_kpa=pressure_kpa))

    def press(
        self,
        radius_mm: Range = (8, 18),
        *,
        pressure_kpa: Range = PRESSURE_KPA,
        profile: Profile = "flat",
        within_mm: float = 75,
    ) -> Press:
        """An ellipse, at most half as long again as wide, within so much of the centre."""
        width = self.rng.uniform(*radius_mm)
        x, y = self.rng.uniform(-within_mm, within_mm, 2)
        return Press(
            x_m=x * self.mm,
            y_m=y * self.mm,
            pressure_kpa=self.rng.uniform(*pressure_kpa),
            radius_m=width * self.mm,
            radius_y_m=width * self.rng.uniform(2 / 3, 1) * self.mm,
            angle_rad=self.rng.uniform(0, np.pi),
            profile=profile,
        )

    def any_kind(self) -> Press:
        """An indenter of one of `KINDS`, of the evaluation's sizes."""
        shape, profile = KINDS[self.rng.integers(len(KINDS))]
        return draw_indenter(
            self.description,
            self.rng,
            shape,
            profile=profile,
            pressure_kpa=self.kpa_of(profile),
            scale=scale_of(self.description),
        )

    @staticmethod
    def kpa_of(profile: Profile) -> Range:
        """Peak pressures of indenters of `KINDS`."""
        return SOFT_KPA if profile == "dome" else FLAT_KPA

    def apart(
        self, count: int, press: Callable[[], Placed], gap_mm: float = 9
    ) -> tuple[Placed, ...]:
        """So many inside the sensing area, outlines at least so far from each other."""
        return placed_apart(self.description, count, gap_mm * self.mm, press)

    def tried(
        self, draw: Callable[[], Sequence[Press]], *, may_overlap: bool = False
    ) -> tuple[Press, ...]:
        """What is drawn, anew until all of it lies inside the sensing area and nothing overlaps.

        Raises DataError where there is no room.
        """
        for _ in range(1000):
            presses = tuple(draw())
            apart = may_overlap or all(gap_m(a, b) > 0 for a, b in combinations(presses, 2))
            if apart and all(is_inside(self.description, press) for press in presses):
                return presses
        raise DataError(
            f"no room for {len(presses)} contacts on {self.description.name!r}: its sensing area "
            "is too small"
        )

    def pair(self, first_mm: Range, second_mm: Range, gap_mm: Range) -> tuple[Press, ...]:
        """Two round contacts, a gap apart."""

        def two() -> Sequence[Press]:
            one, other = self.press(first_mm), self.press(second_mm)
            angle, gap = self.rng.uniform(0, 2 * np.pi), self.rng.uniform(*gap_mm) * self.mm
            away = one.radius_m + other.radius_m + gap
            return (
                replace(one, radius_y_m=None),
                replace(
                    other,
                    radius_y_m=None,
                    x_m=one.x_m + away * np.cos(angle),
                    y_m=one.y_m + away * np.sin(angle),
                ),
            )

        return self.tried(two)

    def slide(self, step_mm: Range) -> list[tuple[Press, ...]]:
        """A contact that stays, then slides on for some frames."""
        length = self.rng.uniform(*step_mm) * self.mm

        def ends() -> Sequence[Press]:
            start, angle = self.press((8, 14)), self.rng.uniform(0, 2 * np.pi)
            away = SLIDE_FRAMES * length * np.array([np.cos(angle), np.sin(angle)])
            return start, replace(start, x_m=start.x_m + away[0], y_m=start.y_m + away[1])

        start, end = self.tried(ends, may_overlap=True)
        x = np.linspace(start.x_m, end.x_m, SLIDE_FRAMES + 1)[1:].tolist()
        y = np.linspace(start.y_m, end.y_m, SLIDE_FRAMES + 1)[1:].tolist()
        path = [replace(start, x_m=a, y_m=b) for a, b in zip(x, y, strict=True)]
        return [(press,) for press in (*[start] * SETTLED_FRAMES, *path)]

    def electrode(self) -> int:
        """Any of them."""
        return int(self.rng.integers(self.description.electrode_count))

    def sheet(self) -> tuple[Channel, ...]:
        """One of the sensor's."""
        channels = self.description.channels
        return (channels[self.rng.integers(len(channels))],)

    def in_turn(self, *kinds: float) -> float:
        """The kind that is this case's."""
        return kinds[self.number % len(kinds)]


def _ordinary(draw: Draw) -> Plan:
    return draw.plan(draw.scene())


def _weak_centre(draw: Draw) -> Plan:
    def alone() -> tuple[Press, ...]:
        return (draw.press((4, 7), within_mm=10),)

    def among_others() -> tuple[Press, ...]:
        return (*alone(), draw.press((14, 18)), draw.press((14, 18)))

    return draw.plan(draw.tried(among_others if draw.number % 2 else alone))


def _edges(draw: Draw) -> Plan:
    half_x, half_y = np.array([draw.description.width_m, draw.description.height_m]) / 2
    frame_m = draw.description.sheet.frame_width_m

    def at_the_edge() -> Press:
        press = draw.press((6, 14))
        a, b = press.radius_m, press.radius_y_m or press.radius_m
        far = draw.rng.uniform(0, 2) * draw.mm
        side = draw.rng.choice([-1, 1], 2)
        corner = draw.rng.random() < 0.5
        x = side[0] * (half_x - frame_m - a - far)
        y = side[1] * (half_y - frame_m - b - far) if corner else press.y_m
        if not corner and draw.rng.random() < 0.5:
            x, y = press.x_m, side[1] * (half_y - frame_m - b - far)
        return replace(press, x_m=float(x), y_m=float(y), angle_rad=0.0)

    return draw.plan(draw.apart(1 + draw.number % 3, at_the_edge))


def _near_touch(draw: Draw) -> Plan:
    least = draw.in_turn(1, 3, 5)
    return draw.plan(draw.pair((8, 14), (8, 14), (least, least + 1)))


def _small_ones(draw: Draw, count: int, is_ball: Callable[[], bool] = lambda: False) -> Plan:
    def small() -> Press:
        if is_ball():
            return draw.press((6, 10), pressure_kpa=SOFT_KPA, profile="dome")
        return draw.press((6, 10))

    return draw.plan(draw.apart(count, small, gap_mm=6))


def _by_converter(plan: Plan) -> Plan:
    return replace(plan, snr_db=CONVERTER_DB, snr_of="voltage")


def _soft(draw: Draw, profile: Profile = "dome") -> Plan:
    def soft() -> Press:
        return draw.press((10, 20), pressure_kpa=SOFT_KPA, profile=profile)

    return _by_converter(draw.plan(draw.apart(1 + draw.number % 3, soft)))


def _displaced_m(draw: Draw) -> FloatArray:
    return np.asarray(draw.mm * draw.rng.standard_normal(draw.description.electrode_count))


def _by_hand(plan: Plan, displaced_m: FloatArray) -> Plan:
    return replace(
        plan, unevenness=0.10, impedance_deviation=0.30, displaced_m=tuple(displaced_m.tolist())
    )


def by_hand_as_told(draw: Draw, *frames: Sequence[Press]) -> Plan:
    """A plan on a skin made by hand, electrodes off by up to 1 mm, that answers as described."""
    off_m = draw.mm * draw.rng.uniform(-1, 1, draw.description.electrode_count)
    return _by_converter(_by_hand(as_described(draw.description, *frames), off_m))


def _overload(draw: Draw) -> Plan:
    assert draw.description.magnitude is not None
    end_kpa = draw.description.magnitude.response.pressure_kpa[-1]
    first, *others = draw.scene()

    def beyond(press: Press) -> Press:
        return replace(press, pressure_kpa=end_kpa * draw.rng.uniform(*OVERLOAD))

    rest = others if draw.number % 2 else map(beyond, others)
    return _by_converter(draw.plan((beyond(first), *rest)))


def _palm(draw: Draw) -> Plan:
    (palm,) = draw.apart(1, lambda: _draw_palm(draw))
    shares = np.linspace(0, 1, PALM_FRAMES + 1)[1:].tolist()
    comes = [(replace(palm, pressure_kpa=share * palm.pressure_kpa),) for share in shares]
    frames = [*[()] * PALM_REST_FRAMES, *comes, *[comes[-1]] * PALM_REST_FRAMES]
    return _by_converter(draw.plan(*frames))


def _draw_palm(draw: Draw) -> Press:
    least, most = PALM_M
    long = draw.rng.uniform(least, most)
    x, y = draw.rng.uniform(-1, 1, 2) * (most - long)
    shape: Shape = "rectangle" if draw.rng.integers(2) else "ellipse"
    profile: Profile = "dome" if draw.rng.integers(2) else "flat"
    return Press(
        x_m=x * scale_of(draw.description),
        y_m=y * scale_of(draw.description),
        pressure_kpa=draw.rng.uniform(*PALM_KPA),
        radius_m=long * scale_of(draw.description),
        radius_y_m=draw.rng.uniform(least, long) * scale_of(draw.description),
        angle_rad=draw.rng.uniform(0, np.pi),
        shape=shape,
        profile=profile,
    )


def one_graded_sheet(description: SensorDescription) -> SensorDescription:
    """The sensor with the one sheet of `graded_square`, which answers from 0 kPa on."""
    graded = load_description("graded_square")
    taken = {key: getattr(graded, key) for key in ("name", "title", "magnitude", "structure")}
    return description.model_copy(update=taken)


def _graded(draw: Draw) -> Plan:
    def punch_or_ball() -> Press:
        profile: Profile = "dome" if draw.rng.random() < 0.5 else "flat"
        return draw.press(pressure_kpa=(40, 280), profile=profile)

    plan = draw.plan(draw.apart(1 + draw.number % 3, punch_or_ball))
    return replace(plan, opposite=False)  # conductivity cannot fall by more than all of it


def _open_lead(draw: Draw, *levels: float, currents: tuple[float, ...], before: int = 0) -> Plan:
    """A lead that opens after so many good frames, and floats to levels in turn."""
    scene = draw.scene() if before else None
    lead = BadLead(draw.electrode(), draw.in_turn(*levels), draw.in_turn(*currents))
    plan = draw.plan(*[scene or draw.scene()] * (before + 1))
    return replace(plan, lead=lead, at_fault=draw.sheet())


def _loose_electrode(draw: Draw) -> Plan:
    factors = np.ones(draw.description.electrode_count)
    factors[draw.electrode()] = 30.0
    later = SheetState(impedance=tuple(factors.tolist()))
    return replace(draw.plan(draw.scene()), later=later, at_fault=draw.sheet())


def _displaced_electrode(draw: Draw) -> Plan:
    off = np.zeros(draw.description.electrode_count)
    off[draw.electrode()] = draw.rng.choice([-1, 1]) * draw.rng.uniform(2, 4) * draw.mm
    return replace(draw.plan(draw.scene()), displaced_m=tuple(off.tolist()))


def _swapped_electrodes(draw: Draw) -> Plan:
    order = list(range(draw.description.electrode_count))
    first = draw.electrode()
    second = (first + 1 + int(draw.in_turn(0, 1, 2))) % len(order)
    order[first], order[second] = order[second], order[first]
    wired = SheetState(leads=tuple(order))
    return replace(draw.plan(draw.scene()), tared=wired, later=wired, at_fault=draw.sheet())


def _drifted(draw: Draw, plan: Plan) -> Plan:
    drifted = SheetState(
        warming=draw.in_turn(-1, 1) * draw.rng.uniform(0.01, 0.04),
        drift=draw.rng.uniform(0.005, 0.02),
    )
    return _by_converter(replace(plan, later=drifted))


def _jump(draw: Draw) -> Plan:
    places = draw.apart(2 + draw.number % 2, lambda: draw.press((8, 14)))
    here, there, *others = places
    return draw.plan(*[(here, *others)] * SETTLED_FRAMES, (there, *others))


@dataclass(frozen=True)
class Regime:
    """One thing that goes wrong."""

    draw: Callable[[Draw], Plan]
    # whether it can go wrong with a sensor
    can_happen: Callable[[SensorDescription], bool] = lambda _: True
    # makes its cases' sensor of the one evaluated
    sensor_of: Callable[[SensorDescription], SensorDescription] = lambda sensor: sensor


def _has(*channels: Channel) -> Callable[[SensorDescription], bool]:
    return lambda description: set(channels) <= set(description.channels)


REGIMES: Final[dict[str, Regime]] = {
    # nothing goes wrong: what the others compare with
    "ordinary": Regime(_ordinary),
    # of the voltages' change, and of the voltages themselves
    "noise": Regime(lambda d: replace(_ordinary(d), snr_db=d.in_turn(10, 5, 0))),
    "converter-noise": Regime(
        lambda d: replace(_ordinary(d), snr_db=d.in_turn(40, 30, 20), snr_of="voltage")
    ),
    # a small contact where electrodes see least; alone or with two large ones
    "weak-centre": Regime(_weak_centre),
    "edges": Regime(_edges),
    # two contacts, 1 to 6 mm from touching
    "near-touch": Regime(_near_touch),
    # small contacts, small balls, and both
    "crowded": Regime(lambda d: _small_ones(d, 5 + d.number % 2)),
    "many": Regime(lambda d: _small_ones(d, 8 + d.number % 3)),
    "crowded-soft": Regime(lambda d: _small_ones(d, 5 + d.number % 2, lambda: True)),
    "crowded-mixed": Regime(
        lambda d: _small_ones(d, 5 + d.number % 2, lambda: d.rng.random() < 0.5)
    ),
    "small-by-large": Regime(lambda d: d.plan(d.pair((18, 24), (4, 6), (3, 8)))),
    # structure not saturated, nothing in the magnitude channel
    "light": Regime(lambda d: _by_converter(d.plan(d.scene(pressure_kpa=(5, 90))))),
    # balls, under which the pressure falls to the rim
    "soft": Regime(_soft),
    # the same, but that the pressure falls more steeply than that of any kind that is fitted
    "cones": Regime(lambda d: _soft(d, "cone")),
    # electrodes 1 mm off, contact impedances by 30 %, sheets uneven by 10 %
    "hand-made": Regime(lambda d: _by_hand(_ordinary(d), _displaced_m(d))),
    "soft-hand-made": Regime(lambda d: _by_hand(_soft(d), _displaced_m(d))),
    # `KINDS` side by side on a skin made by hand
    "mixed": Regime(lambda d: by_hand_as_told(d, d.apart(1 + d.number % 4, d.any_kind))),
    # the first press, or all, beyond the response table's end
    "overload": Regime(_overload, _has(Channel.MAGNITUDE)),
    # 60 mm across or more, that comes slowly
    "palm": Regime(_palm),
    # one sheet that answers from 0 kPa; punches and balls
    "graded": Regime(_graded, sensor_of=one_graded_sheet),
    # where 100 was told
    "wrong-contrast": Regime(
        lambda d: replace(_ordinary(d), contrast=d.in_turn(3, 1000)), _has(Channel.STRUCTURE)
    ),
    # the magnitude channel changes against the sign told
    "wrong-sign": Regime(lambda d: replace(_ordinary(d), sign_told=False), can_be_opposite),
    # a lead that opens after the tare, and in the last of many good frames
    "dead-lead": Regime(lambda d: _open_lead(d, 0, 3, -3, currents=(1e-3,))),
    "intermittent": Regime(
        lambda d: _open_lead(d, 0, 3, currents=(1e-3, 0.3), before=SETTLED_FRAMES)
    ),
    # an electrode's contact impedance grows 30-fold after the tare
    "loose": Regime(_loose_electrode),
    # an electrode 2 to 4 mm off its place
    "displaced": Regime(_displaced_electrode),
    # two leads of one sheet that were exchanged
    "swapped": Regime(_swapped_electrodes),
    # sheets 1 to 4 % better or worse conductors than at the tare, unevenly so
    "drift": Regime(lambda d: _drifted(d, _ordinary(d))),
    "drift-at-rest": Regime(lambda d: _drifted(d, d.plan(()))),
    # 2 to 5 % longer along x than described
    "stretched": Regime(lambda d: replace(_ordinary(d), stretch=d.rng.uniform(0.02, 0.05))),
    # a sliding contact, the structure scan one behind
    "one-scan-apart": Regime(
        lambda d: replace(d.plan(*d.slide((4, 10))), behind=1), _has(*Channel)
    ),
    # a contact that is elsewhere in the next frame
    "jump": Regime(_jump),
    # a sliding contact, its last 1 to 3 structure scans lost
    "lost-scans": Regime(
        lambda d: replace(d.plan(*d.slide((3, 8))), lost=int(d.in_turn(1, 2, 3))), _has(*Channel)
    ),
}


def can_happen(name: str, description: SensorDescription) -> bool:
    """Whether what goes wrong in a regime can go wrong with a sensor; every other row can."""
    return name not in REGIMES or REGIMES[name].can_happen(description)


def draw_plan(description: SensorDescription, regime: str, seed_set: SeedSet, number: int) -> Plan:
    """Draw a case of a regime; the same one every time.

    Raises DataError where there is no room on the sensor for what presses.
    """
    rng = np.random.default_rng(seed_of(seed_set, f"stability {regime}", number))
    return REGIMES[regime].draw(Draw(description, rng, number))


def make_case(
    description: SensorDescription,
    regime: str,
    seed_set: SeedSet,
    number: int,
    *,
    snr_db: float | None = None,
) -> Case:
    """Draw, simulate and measure a case; the same one every time.

    Its noise is the plan's, or that of a ratio of the change.

    Raises DataError where the regime cannot happen to the sensor, or has no room on it.
    """
    if not can_happen(regime, description):
        raise DataError(
            f"{regime!r} cannot happen to {description.name!r}, whose channels are: "
            f"{', '.join(description.channels)}; choose other regimes"
        )
    description = REGIMES[regime].sensor_of(description)
    plan = draw_plan(description, regime, seed_set, number)
    skin, noise = (
        seed_of(seed_set, f"stability {regime} {what}", number) for what in ("sheet", "noise")
    )
    return measure(simulate(description, plan, skin), seed_set, number, noise, snr_db)

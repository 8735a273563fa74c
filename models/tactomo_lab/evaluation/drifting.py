"""A day of a skin that drifts: temperature, creep, contact impedances, and presses of any length.

What is asked: does a skin that nobody touches show contacts (ghosts), does a contact that lasts
vanish (erased), is one never seen (missed), and what is its magnitude worth, with and without
baseline tracking. One tare at the start has to do for the whole day.

Voltages are solved directly, on a mesh that is finer than the one that inverts, whenever something
is pressed or let go and ever more rarely after that; in between, their logarithms are
interpolated in the logarithm of time, in which creep is a straight line.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.mesh import SheetMesh
from tactomo_models.scans.plausibility import DISTRUST
from tactomo_models.scans.reference import Reference
from tactomo_models.scene.press import Press, strongest
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.simulation.simulator import conductivity_ratio, smooth_noise
from tactomo_models.simulation.skin_drift import SkinDrift, decades_left
from tactomo_protocol import Channel

from tactomo_lab.evaluation.play import Player, Variant
from tactomo_lab.scenes.case import (
    REFERENCE_SCANS,
    SIMULATION,
    Case,
    Frame,
    as_described,
    cached,
)
from tactomo_lab.scenes.drawing import SeedSet, require_channels, seed_of
from tactomo_lab.scenes.simulation import (
    IMPEDANCE_DEVIATION,
    SHARP_M,
    UNEVENNESS,
    SheetState,
    UnevenSheet,
    Volts,
    centroids,
    fine_mesh,
    fitted_mesh,
)

DRIFT: Final = SkinDrift(swing_k=10.0, creep=0.01)
STEP_K: Final = 2.0  # somebody opens a window ...
STEP_S: Final = 600.0  # ... and the skin follows as slowly
IMPEDANCE_WANDER: Final = 0.1  # amplitude, of its logarithm
NOISE_SHARE: Final = 2.5e-4  # of the largest voltage: 60 dB, a good device
PERIOD_S: Final = 20.0  # between frames of a day
BURST_S: Final = (5.0, 20.0)  # before and after something changes, in which there are more
BURST_PERIOD_S: Final = 0.5
SOLVED_AFTER_S: Final = (0.0, 3.0, 10.0, 40.0, 150.0, 600.0, 1800.0, 3600.0)  # a change
SOLVED_EVERY_S: Final = 1800.0
PRESSES_AN_HOUR: Final = 1.0
LIGHTEST_KPA: Final = 5.0
LIGHT_SHARE: Final = 1 / 3  # of presses that the magnitude channel does not answer to
FIRM_KPA: Final = (150.0, 190.0)
LONGEST_S: Final = 7200.0
NEAR_M: Final = 0.015  # a contact farther than this from all that presses is a ghost


@dataclass(frozen=True)
class TimedPress:
    """A press from `start_s` to `end_s`."""

    press: Press
    start_s: float
    end_s: float


def draw_presses(
    description: SensorDescription, hours: float, rng: np.random.Generator
) -> list[TimedPress]:
    """Presses one after another, from seconds to hours; one in the middle lasts an hour or more."""
    count = max(3, round(hours * PRESSES_AN_HOUR))
    longest_s = min(LONGEST_S, hours * 3600 / 4)
    seconds = np.exp(rng.uniform(np.log(2.0), np.log(longest_s), count))
    seconds[count // 2] = longest_s
    free_s = hours * 3600 - seconds.sum() - 600
    while free_s < hours * 900:  # something must be left of the day to rest in
        seconds *= 0.7
        free_s = hours * 3600 - seconds.sum() - 600
    pauses = rng.dirichlet(np.ones(count + 1)) * free_s
    starts = 120 + np.cumsum(pauses[:-1]) + np.concatenate([[0], np.cumsum(seconds)[:-1]])
    starts += 10 * np.arange(count) / count
    return [
        TimedPress(_draw_press(description, rng), float(start), float(start + lasting))
        for start, lasting in zip(starts, seconds, strict=True)
    ]


def _draw_press(description: SensorDescription, rng: np.random.Generator) -> Press:
    light = rng.random() < LIGHT_SHARE
    kpa = np.exp(rng.uniform(*np.log((LIGHTEST_KPA, 100.0)))) if light else rng.uniform(*FIRM_KPA)
    reach_x, reach_y = 0.32 * description.width_m, 0.32 * description.height_m
    scale = description.width_m / 0.150
    return Press(
        float(rng.uniform(-reach_x, reach_x)),
        float(rng.uniform(-reach_y, reach_y)),
        float(kpa),
        radius_m=float(rng.uniform(0.008, 0.018) * scale),
        radius_y_m=float(rng.uniform(0.008, 0.018) * scale),
    )


class DriftingSkin:
    """A skin in time; times are seconds since its tare."""

    def __init__(
        self,
        description: SensorDescription,
        presses: Sequence[TimedPress],
        seed: np.random.SeedSequence,
        step_at_s: float,
    ) -> None:
        self.description = description
        self.presses = tuple(presses)
        self._step_at_s = step_at_s
        rng = np.random.default_rng(seed)
        self._sheets = {
            name: UnevenSheet(description, rng, UNEVENNESS, IMPEDANCE_DEVIATION)
            for name in description.channels
        }
        self._fields = {name: int(rng.integers(2**63)) for name in description.channels}
        electrodes = description.electrode_count
        self._wander_s = rng.uniform(1, 8, electrodes) * 3600
        self._phase = rng.uniform(0, 2 * np.pi, electrodes)
        self._mesh = fine_mesh(description)
        self._meshes: dict[tuple[Press, ...], SheetMesh] = {(): self._mesh}
        self._bare: dict[tuple[Channel, tuple[Press, ...]], FloatArray] = {}

    def solve(self, time_s: float, pressed: TimedPress | None) -> Volts:
        """Noise-free volts (M,) of each channel; `pressed` of two at the same time."""
        shown = tuple(
            each.press
            for each in self.presses
            if each is pressed or (each.end_s <= time_s and self._decades(each, time_s) > 0)
        )
        if shown not in self._meshes:
            self._meshes[shown] = fitted_mesh(self._mesh, shown, self.description)
        mesh = self._meshes[shown]
        return {name: self._solve(name, mesh, shown, time_s, pressed) for name in self._sheets}

    def _solve(
        self,
        name: Channel,
        mesh: SheetMesh,
        shown: tuple[Press, ...],
        time_s: float,
        pressed: TimedPress | None,
    ) -> FloatArray:
        sheet = self._sheets[name]
        for key in ((name, ()), (name, shown)):
            if key not in self._bare:
                self._bare[key] = sheet.voltages(self._meshes[key[1]])
        ratio = self._conductivity(name, mesh, time_s, pressed)
        now = sheet.voltages(mesh, ratio, SheetState(impedance=self._impedance(time_s)))
        # As a factor on one mesh at rest, so that no change is a change of mesh.
        return self._bare[name, ()] * now / self._bare[name, shown]

    def _conductivity(
        self, name: Channel, mesh: SheetMesh, time_s: float, pressed: TimedPress | None
    ) -> FloatArray:
        x, y = centroids(mesh)
        field = smooth_noise(
            x, y, self.description.width_m / 4, np.random.default_rng(self._fields[name])
        )
        factor = np.exp(self.warming(time_s) * (1 + DRIFT.uneven * field))
        for each in self.presses:
            if each.end_s <= time_s and each is not pressed:
                ratio = self._ratio(name, each, x, y)
                factor *= DRIFT.left(ratio, self._decades(each, time_s))
        if pressed is not None:
            ratio = self._ratio(name, pressed, x, y)
            factor *= DRIFT.grown(ratio, max(0.0, time_s - pressed.start_s))
        return np.asarray(factor)

    def _ratio(self, name: Channel, each: TimedPress, x: FloatArray, y: FloatArray) -> FloatArray:
        return conductivity_ratio(
            self.description, name, *strongest([each.press], x, y, edge_m=SHARP_M)
        )

    def _decades(self, each: TimedPress, time_s: float) -> float:
        return float(decades_left(each.end_s - each.start_s, time_s - each.end_s))

    def warming(self, time_s: float) -> float:
        """Logarithm of the common factor on conductivity."""
        after_s = max(0.0, time_s - self._step_at_s)
        step = DRIFT.per_kelvin * STEP_K * -np.expm1(-after_s / STEP_S)
        return DRIFT.warming(time_s) + float(step)

    def _impedance(self, time_s: float) -> tuple[float, ...]:
        angle = 2 * np.pi * time_s / self._wander_s + self._phase
        return tuple(np.exp(IMPEDANCE_WANDER * (np.sin(angle) - np.sin(self._phase))).tolist())

    def magnitude_at(self, each: TimedPress, time_s: float) -> float:
        """True |relative conductivity change| of the magnitude channel under a press."""
        assert self.description.magnitude is not None
        change = self.description.magnitude.response.change(np.array(each.press.pressure_kpa))
        return float(np.abs(DRIFT.grown(1 + change, time_s - each.start_s) - 1))


@dataclass(frozen=True)
class Stretch:
    """A part of the day in which nothing is pressed or let go; its volts at some times."""

    pressed: TimedPress | None
    times_s: FloatArray
    volts: dict[Channel, FloatArray]  # (times, M)

    def at(self, time_s: float) -> Volts:
        """Volts (M,) of each channel, between those times."""
        begin_s = self.times_s[0]
        known, wanted = np.log1p(self.times_s - begin_s), np.log1p(time_s - begin_s)
        after = int(np.clip(np.searchsorted(known, wanted), 1, len(known) - 1))
        share = (wanted - known[after - 1]) / (known[after] - known[after - 1])
        return {
            name: volts[after - 1] * (volts[after] / volts[after - 1]) ** share
            for name, volts in self.volts.items()
        }


@dataclass(frozen=True)
class Day:
    """What a skin said during a day."""

    skin: DriftingSkin
    hours: float
    stretches: tuple[Stretch, ...]
    seed_set: SeedSet
    number: int

    @cached_property
    def changes_s(self) -> FloatArray:
        """When something is pressed or let go."""
        return np.array([stretch.times_s[0] for stretch in self.stretches[1:]])

    def times(self, every: int = 1) -> Iterator[tuple[float, Stretch]]:
        """When there are frames; with `every` > 1, fewer of them, and no bursts."""
        times = [np.arange(0.0, self.hours * 3600, PERIOD_S * every)]
        if every == 1:
            times += [
                np.arange(c - BURST_S[0], c + BURST_S[1], BURST_PERIOD_S) for c in self.changes_s
            ]
        ends = np.append(self.changes_s, np.inf)
        for time_s in np.unique(np.concatenate(times)):
            if 0 <= time_s < self.hours * 3600:
                yield float(time_s), self.stretches[int(np.searchsorted(ends, time_s, "right"))]

    def case(self, track: bool, every: int = 1) -> Case:
        """The day's scans after one tare, of the frames of `times`."""
        rng, description = (
            np.random.default_rng(seed_of(self.seed_set, "drift noise", self.number)),
            self.skin.description,
        )
        start = [self.scans(rng, self.stretches[0].at(0.0)) for _ in range(REFERENCE_SCANS)]
        tare = Reference.from_scans(
            np.array([scan[Channel.MAGNITUDE] for scan in start]),
            np.array([scan[Channel.STRUCTURE] for scan in start]),
        )
        frames = [
            Frame({}, self.scans(rng, stretch.at(time_s)), time_s=time_s)
            for time_s, stretch in self.times(every)
        ]
        return Case(
            *(self.seed_set, self.number, as_described(description), description, description),
            *(tare, frames, track),
        )

    def scans(self, rng: np.random.Generator, volts: Volts) -> Volts:
        """The volts with a converter's noise."""
        rest = self.stretches[0].volts
        return {
            name: values
            + NOISE_SHARE * np.abs(rest[name][0]).max() * rng.standard_normal(len(values))
            for name, values in volts.items()
        }


def simulate_day(
    description: SensorDescription, seed_set: SeedSet, number: int, hours: float = 24.0
) -> Day:
    """Draw a day and solve it; what was solved is kept."""
    require_channels(description, *Channel)
    rng = np.random.default_rng(seed_of(seed_set, "drift", number))
    presses = draw_presses(description, hours, rng)
    step_at_s = float(rng.uniform(0.2, 0.8) * hours * 3600)
    skin = DriftingSkin(description, presses, seed_of(seed_set, "drifting skin", number), step_at_s)
    plan = list(_plan(presses, hours))

    def simulate() -> dict[str, FloatArray]:
        arrays: dict[str, list[FloatArray]] = {name: [] for name in description.channels}
        for pressed, times_s in plan:
            for time_s in times_s:
                for name, volts in skin.solve(float(time_s), pressed).items():
                    arrays[name].append(volts)
        return {name: np.array(volts) for name, volts in arrays.items()}

    what = f"{SIMULATION} drift {seed_set} {number} {hours} {presses!r} {DRIFT!r} {step_at_s} "
    what += f"{STEP_K} {STEP_S} {IMPEDANCE_WANDER} {description.model_dump_json()}"
    arrays = cached(what, simulate)
    stretches, begin = [], 0
    for pressed, times_s in plan:
        end = begin + len(times_s)
        volts = {name: arrays[name][begin:end] for name in description.channels}
        stretches.append(Stretch(pressed, times_s, volts))
        begin = end
    return Day(skin, hours, tuple(stretches), seed_set, number)


def _plan(
    presses: Sequence[TimedPress], hours: float
) -> Iterator[tuple[TimedPress | None, FloatArray]]:
    """What is pressed from when to when, and at which times to solve that."""
    ends: list[tuple[float, TimedPress | None]] = [(0.0, None)]
    for each in presses:
        ends += [(each.start_s, each), (each.end_s, None)]
    ends.append((hours * 3600, None))
    for (begin_s, pressed), (end_s, _) in pairwise(ends):
        late = np.arange(SOLVED_AFTER_S[-1], end_s - begin_s, SOLVED_EVERY_S)
        after = np.concatenate([SOLVED_AFTER_S, late])
        inside = np.unique(after[after < 0.8 * (end_s - begin_s)])
        yield pressed, np.append(begin_s + inside, end_s)


@dataclass(frozen=True)
class Seen:
    """One frame of a day."""

    time_s: float  # when
    pressed: TimedPress | None  # what presses; None where nothing does
    shown: bool  # whether it is shown
    ghosts: int  # contacts where nothing presses
    magnitude: float  # of the contact shown; NaN if unknown
    truth: float  # what it should be; NaN where nothing presses
    distrusted: bool  # whether a flag says so
    gain: float  # relative change of the structure channel's baseline since the tare
    state: str  # the tracker's; "off" without one


def live(day: Day, *, track: bool = True, every: int = 1) -> Iterator[Seen]:
    """Reconstruct a day after one tare: all frames, or one of `every` and no bursts."""
    player = Player(day.skin.description)
    played = player.play(day.case(track, every), Variant("auto"))
    for frame, (time_s, stretch) in zip(played, day.times(every), strict=True):
        pressed, contacts, tracker = stretch.pressed, frame.made.contacts, player.tracker
        near = [
            contact
            for contact in contacts
            if pressed is not None
            and np.hypot(contact.x_m - pressed.press.x_m, contact.y_m - pressed.press.y_m) < NEAR_M
        ]
        yield Seen(
            time_s=time_s,
            pressed=pressed,
            shown=bool(near),
            ghosts=len(contacts) - min(len(near), 1),
            magnitude=near[0].magnitude if near else float("nan"),
            truth=float("nan") if pressed is None else day.skin.magnitude_at(pressed, time_s),
            distrusted=bool(frame.made.flags & DISTRUST),
            gain=0.0 if tracker is None else tracker.drift[Channel.STRUCTURE].gain,
            state="off" if tracker is None else tracker.state,
        )


@dataclass(frozen=True)
class DaySummary:
    """What became of a day."""

    frames: int  # how many
    ghost_share: float  # of frames, that show a contact where nothing presses
    ghosts_per_hour: float  # times that such a contact begins, an hour
    presses: int  # how many
    missed: int  # presses that were never shown
    erased: int  # presses that were shown, and vanished while they lasted
    erased_share: float  # of frames under a press, that do not show it
    distrusted: float  # share of frames that say that they are not to be trusted
    refused: float  # share of frames at which the tracker refused
    magnitude_error: float  # mean relative error of firm presses' magnitudes


def summarise_day(seen: Sequence[Seen], hours: float) -> DaySummary:
    """Sum up all frames of a day."""
    has_ghost = np.array([bool(each.ghosts) for each in seen])
    under = [each for each in seen if each.pressed is not None]
    by_press: dict[float, list[bool]] = {}
    for each in under:
        assert each.pressed is not None
        by_press.setdefault(each.pressed.start_s, []).append(each.shown)
    errors = [
        abs(e.magnitude / e.truth - 1) for e in under if e.truth > 0 and np.isfinite(e.magnitude)
    ]
    return DaySummary(
        frames=len(seen),
        ghost_share=float(has_ghost.mean()),
        ghosts_per_hour=float((has_ghost[1:] & ~has_ghost[:-1]).sum() + has_ghost[0]) / hours,
        presses=len(by_press),
        missed=sum(not any(shown) for shown in by_press.values()),
        erased=sum(
            any(shown) and not all(shown[shown.index(True) :]) for shown in by_press.values()
        ),
        erased_share=float(np.mean([not each.shown for each in under])) if under else 0.0,
        distrusted=float(np.mean([each.distrusted for each in seen])),
        refused=float(np.mean([each.state == "refused" for each in seen])),
        magnitude_error=float(np.mean(errors)) if errors else float("nan"),
    )

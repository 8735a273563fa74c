"""A day of a skin that drifts: temperature, creep, contact impedances, and presses of any length.

What is asked: does a skin that nobody touches show contacts (ghosts), does a contact that lasts
vanish (erased), is one never seen (missed), and what is its magnitude worth, with and without
baseline tracking. One tare at the start has to do for the whole day. The skin is the twin's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Final

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.scans.plausibility import DISTRUST
from tactomo_models.scans.reference import Reference
from tactomo_models.scene.press import Press
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.simulation.simulator import SkinSimulator
from tactomo_models.simulation.skin_drift import DriftingSkin, SkinDrift
from tactomo_protocol import Channel

from tactomo_lab.evaluation.play import Player, Variant
from tactomo_lab.scenes.case import REFERENCE_SCANS, Case, Frame, as_described
from tactomo_lab.scenes.drawing import SeedSet, require_channels, seed_of
from tactomo_lab.scenes.measures import Figure
from tactomo_lab.scenes.simulation import IMPEDANCE_DEVIATION, UNEVENNESS, Volts

DRIFT: Final = SkinDrift(swing_k=10.0, creep=0.01, impedance=0.1)
STEP_K: Final = 2.0  # somebody opens a window ...
STEP_S: Final = 600.0  # ... and the skin follows as slowly
NOISE_SHARE: Final = 2.5e-4  # of the largest voltage: 60 dB, a good device
PERIOD_S: Final = 20.0  # between frames of a day
BURST_S: Final = (5.0, 20.0)  # before and after something changes, in which there are more
BURST_PERIOD_S: Final = 0.5
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


@dataclass(frozen=True)
class Day:
    """What happens to a skin during a day; times are seconds since its tare."""

    description: SensorDescription
    seed_set: SeedSet
    number: int
    hours: float
    presses: tuple[TimedPress, ...]
    step_at_s: float  # when somebody opens the window

    def drift(self, time_s: float) -> SkinDrift:
        """What the sheets do by themselves."""
        after_s = max(0.0, time_s - self.step_at_s)
        return replace(DRIFT, step_k=STEP_K * float(-np.expm1(-after_s / STEP_S)))

    def pressed_at(self, time_s: float) -> TimedPress | None:
        """What presses, if anything does."""
        there = (each for each in self.presses if each.start_s <= time_s < each.end_s)
        return next(there, None)

    def times_s(self, every: int = 1) -> FloatArray:
        """When there are frames; with `every` > 1, fewer of them, and no bursts."""
        end_s = self.hours * 3600
        times = [np.arange(0.0, end_s, PERIOD_S * every)]
        if every == 1:
            changes = [time_s for each in self.presses for time_s in (each.start_s, each.end_s)]
            times += [np.arange(c - BURST_S[0], c + BURST_S[1], BURST_PERIOD_S) for c in changes]
        all_s = np.unique(np.concatenate(times))
        return all_s[(all_s >= 0) & (all_s < end_s)]

    def case(self, track: bool, every: int = 1) -> Case:
        """The day's scans after one tare, at `times_s`."""
        seed = int(seed_of(self.seed_set, "drifting skin", self.number).generate_state(1)[0])
        simulator = SkinSimulator(
            self.description,
            unevenness=UNEVENNESS,
            impedance_spread=IMPEDANCE_DEVIATION,
            seed=seed,
        )
        rng = np.random.default_rng(seed_of(self.seed_set, "drift noise", self.number))
        rest = simulator.voltages([])
        noise_v = {name: NOISE_SHARE * np.abs(volts).max() for name, volts in rest.items()}

        def scans(volts: Volts, *count: int) -> Volts:
            return {
                name: v + noise_v[name] * rng.standard_normal((*count, len(v)))
                for name, v in volts.items()
            }

        tare = Reference.from_scans(*map(scans(rest, REFERENCE_SCANS).get, Channel))
        skin, frames = DriftingSkin(simulator, seed=seed), []
        for time_s in self.times_s(every).tolist():
            skin.drift = self.drift(time_s)
            pressed = self.pressed_at(time_s)
            volts = skin.voltages([pressed.press] if pressed else [], time_s)
            frames.append(Frame({}, scans(volts), time_s=time_s))
        plan, sensor = as_described(self.description), self.description
        return Case(self.seed_set, self.number, plan, sensor, sensor, tare, frames, track)

    def magnitude_at(self, each: TimedPress, time_s: float) -> float:
        """True |relative conductivity change| of the magnitude channel under a press."""
        assert self.description.magnitude is not None
        change = self.description.magnitude.response.change(np.array(each.press.pressure_kpa))
        return float(np.abs(DRIFT.grown(1 + change, time_s - each.start_s) - 1))


def draw_day(
    description: SensorDescription, seed_set: SeedSet, number: int, hours: float = 24.0
) -> Day:
    """Draw a day; raise DataError where the sensor has no magnitude channel."""
    require_channels(description, Channel.MAGNITUDE)
    rng = np.random.default_rng(seed_of(seed_set, "drift", number))
    presses = draw_presses(description, hours, rng)
    step_at_s = float(rng.uniform(0.2, 0.8) * hours * 3600)
    return Day(description, seed_set, number, hours, tuple(presses), step_at_s)


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
    gain: float  # relative change of the last channel's baseline since the tare
    state: str  # the tracker's; "off" without one


def live(day: Day, *, track: bool = True, every: int = 1) -> Iterator[Seen]:
    """Reconstruct a day after one tare: all frames, or one of `every` and no bursts."""
    player = Player(day.description)
    for frame in player.play(day.case(track, every), Variant("auto")):
        time_s, contacts, tracker = frame.frame.time_s, frame.made.contacts, player.tracker
        pressed = day.pressed_at(time_s)
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
            truth=float("nan") if pressed is None else day.magnitude_at(pressed, time_s),
            distrusted=bool(frame.made.flags & DISTRUST),
            gain=0.0 if tracker is None else tracker.drift[day.description.channels[-1]].gain,
            state="off" if tracker is None else tracker.state,
        )


@dataclass(frozen=True)
class DaySummary:
    """What became of a day."""

    frames: Annotated[int, Figure("frames", "d")]
    ghost_share: Annotated[float, Figure("ghosts", ".1%", "frames with one")]
    ghosts_per_hour: Annotated[
        float, Figure("ghosts/h", ".2f", "contacts that begin where nothing presses")
    ]
    presses: Annotated[int, Figure("presses", "d")]
    missed: Annotated[int, Figure("unseen", "d", "presses that are never shown")]
    erased: Annotated[int, Figure("erased", "d", "presses that vanish for a while")]
    erased_share: Annotated[
        float, Figure("hidden", ".1%", "frames under a press that do not show it")
    ]
    distrusted: Annotated[
        float, Figure("distrusted", ".1%", "frames with a flag that tells to distrust")
    ]
    refused: Annotated[float, Figure("refused", ".1%", "frames not followed")]
    magnitude_error: Annotated[float, Figure("firm Δσ", ".1%", "error of firm presses' magnitude")]


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

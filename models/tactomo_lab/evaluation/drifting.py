"""A day of a skin that drifts: temperature, creep, contact impedances, and presses of any length.

What is asked: does a skin that nobody touches show contacts, does a contact that lasts vanish, and
what is its magnitude worth, with and without a reference that follows the skin. One tare at the
start has to do for the whole day. The skin is the twin's. Pressed places creep, which a score
counts as an error of the magnitude.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from tactomo_models.scans.reference import Reference
from tactomo_models.scene.press import Press
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.simulation.simulator import SkinSimulator, noisy
from tactomo_models.simulation.skin_drift import DriftingSkin, SkinDrift
from tactomo_protocol import Channel

from tactomo_lab.scenes.case import REFERENCE_SCANS, Case, Frame, as_described
from tactomo_lab.scenes.drawing import SeedSet, require_channels, seed_of
from tactomo_lab.scenes.simulation import IMPEDANCE_DEVIATION, UNEVENNESS

DRIFT: Final = SkinDrift(swing_k=10.0, creep=0.01, impedance=0.1)
STEP_K: Final = 2.0  # somebody opens a window ...
STEP_S: Final = 600.0  # ... and the skin follows as slowly
NOISE_SHARE: Final = 2.5e-4  # of the largest voltage: 60 dB, a good device
PERIOD_S: Final = 20.0  # between frames of a day
FEWER: Final = 10  # of these periods, where the reference does not follow
BURST_S: Final = (5.0, 20.0)  # before and after something changes, in which there are more
BURST_PERIOD_S: Final = 0.5
PRESSES_AN_HOUR: Final = 1.0
LIGHTEST_KPA: Final = 5.0
LIGHT_SHARE: Final = 1 / 3  # of presses that the magnitude channel does not answer to
FIRM_KPA: Final = (150.0, 190.0)
LONGEST_S: Final = 7200.0


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


def draw_day(
    description: SensorDescription,
    seed_set: SeedSet,
    number: int,
    *,
    is_followed: bool,  # whether the reference follows the skin
    hours: float = 24.0,
) -> Case:
    """Draw and simulate a day after one tare: frames in bursts where something changes.

    Where the reference does not follow, one of `FEWER` frames and no bursts: frames without a
    following reference are slow, for all that they show.

    Raises DataError where the sensor has no magnitude channel.
    """
    require_channels(description, Channel.MAGNITUDE)
    drawn = np.random.default_rng(seed_of(seed_set, "drift", number))
    presses = draw_presses(description, hours, drawn)
    step_at_s = float(drawn.uniform(0.2, 0.8) * hours * 3600)
    seed = int(seed_of(seed_set, "drifting skin", number).generate_state(1)[0])
    simulator = SkinSimulator(
        description, unevenness=UNEVENNESS, impedance_spread=IMPEDANCE_DEVIATION, seed=seed
    )
    rng = np.random.default_rng(seed_of(seed_set, "drift noise", number))
    rest = simulator.voltages([])
    noise_v = {name: NOISE_SHARE * np.abs(volts).max() for name, volts in rest.items()}
    tare = Reference.from_scans(*map(noisy(rest, noise_v, rng, REFERENCE_SCANS).get, Channel))
    skin, frames = DriftingSkin(simulator, seed=seed), []
    for time_s in _times_s(presses, hours, is_followed):
        after_s = max(0.0, time_s - step_at_s)
        skin.drift = replace(DRIFT, step_k=STEP_K * float(-np.expm1(-after_s / STEP_S)))
        there = [each.press for each in presses if each.start_s <= time_s < each.end_s]
        volts = noisy(skin.voltages(there, time_s), noise_v, rng)
        frames.append(Frame(dict(zip("A", there, strict=False)), volts, time_s=time_s))
    plan = as_described(description, *(tuple(frame.presses.values()) for frame in frames))
    return Case(seed_set, number, plan, description, description, tare, frames, is_followed)


def _times_s(presses: Sequence[TimedPress], hours: float, is_followed: bool) -> list[float]:
    """When there are frames."""
    end_s = hours * 3600
    times = [np.arange(0.0, end_s, PERIOD_S if is_followed else FEWER * PERIOD_S)]
    if is_followed:
        changes = [time_s for each in presses for time_s in (each.start_s, each.end_s)]
        times += [np.arange(c - BURST_S[0], c + BURST_S[1], BURST_PERIOD_S) for c in changes]
    all_s = np.unique(np.concatenate(times))
    found: list[float] = all_s[(all_s >= 0) & (all_s < end_s)].tolist()
    return found

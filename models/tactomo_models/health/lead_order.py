"""Which leads are not where they belong: found by which order explains the voltages at rest."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.physics.bare_sheet import exchanged, scan_voltages
from tactomo_models.scans.plausibility import MAX_DEVIATION, deviation
from tactomo_models.sensor.description import SensorDescription

Trial = Callable[[Sequence[int]], tuple[float, FloatArray]]
"""Of an order of leads: the deviation that it leaves, and the voltages (M,) expected with it."""


@dataclass(frozen=True)
class Order:
    """Which leads are not where they belong, and what is expected with them so."""

    exchanged: tuple[tuple[int, int], ...]  # pairs of electrodes whose leads changed places
    turned: int  # places by which all leads are on; 0 where they are not
    expected: FloatArray  # (M,) the model's voltages in that order, relative


def find_order(
    description: SensorDescription,  # the sensor
    transfer: FloatArray,  # (L, L) the model's transfer resistances
    # (M,) measured, on any scale; where none is negative, sizes alone are compared
    volts: FloatArray,
    noise: FloatArray,  # (M,) their standard deviation
    sought: BoolArray | bool = True,  # (M,) those to go by
) -> Order:
    """Find the order of leads that explains the voltages (M,) of an unpressed skin.

    Where the order of the description does not, all leads are turned, or else one exchange of two
    leads at a time is taken, the one that explains most, and only where it halves the deviation.
    A turn by what leaves the sheet the same, such as a quarter of a square, cannot be seen.
    """
    known = np.broadcast_to(sought, volts.shape)
    is_unsigned = bool((volts >= 0).all())

    def trial(order: Sequence[int]) -> tuple[float, FloatArray]:
        moved = scan_voltages(description, exchanged(transfer, order))
        moved = np.abs(moved) if is_unsigned else moved
        return _deviation(volts[known], moved[known], noise[known]), moved

    straight = list(range(description.electrode_count))
    left, expected = trial(straight)
    described = Order((), 0, expected)
    if left <= MAX_DEVIATION:
        return described
    return _turned(trial, straight, left) or _exchanged(trial, straight, left, described)


def _turned(trial: Trial, straight: list[int], left: float) -> Order | None:
    """The least turn of all leads that explains the voltages; None if none does."""
    count, limit = len(straight), min(MAX_DEVIATION, left / 2)
    for turn in sorted(range(1, count), key=lambda n: min(n, count - n)):
        after, moved = trial([*straight[turn:], *straight[:turn]])
        if after < limit:
            return Order((), turn, moved)
    return None


def _exchanged(trial: Trial, straight: list[int], left: float, described: Order) -> Order:
    """Exchanges, the best one first, that explain the voltages; as described if none do."""
    order, expected = straight, described.expected
    found: list[tuple[int, int]] = []
    while left > MAX_DEVIATION:
        trials = [
            (*trial(_swapped(order, pair)), pair)
            for pair in itertools.combinations(range(len(order)), 2)
        ]
        after, moved, pair = min(trials, key=lambda made: made[0])
        if not after < left / 2:  # also where no order has a finite one: voltages that are all zero
            break
        left, expected, order = after, moved, _swapped(order, pair)
        found.append(pair)
    # Halfway is no explanation: leads that are where they belong would be named for the residual.
    return described if left > MAX_DEVIATION else Order(tuple(found), 0, expected)


def _swapped(order: Sequence[int], pair: tuple[int, int]) -> list[int]:
    made = list(order)
    made[pair[0]], made[pair[1]] = made[pair[1]], made[pair[0]]
    return made


def _deviation(volts: FloatArray, expected: FloatArray, noise: FloatArray) -> float:
    """Deviation from the model after the common factor that explains most voltages."""
    scale = float(np.median(volts / expected))
    if scale == 0:
        return np.inf
    return deviation(volts / scale, expected, noise / abs(scale), np.ones(len(volts), dtype=bool))

"""Which load-cell readings the others contradict: slips in a table, such as a wrong power of ten.

Who presses harder changes the magnitude more. So a reading has its place between what the others
show at the next lower and at the next higher pressure, by a rising fit to those others alone. How
far beyond is too far goes by their scatter, taken from the median. Slips of one kind may hide each
other; with every one that is mended the others show.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from tactomo_models.calibration import APART, SOME_ANSWER, Reading

FloatArray = NDArray[np.float64]

TOO_FAR: Final = 6.0  # scatters
LEAST_SCATTER: Final = 0.05  # of the largest magnitude of the others
FEWEST: Final = 5  # others that may contradict
FEWEST_ANSWERED: Final = 3  # of them, to say what the next magnitude may be at most
MOST: Final = 300  # readings: of more, a slip moves nothing, and each is compared with all others
MOST_SHARE: Final = 0.25  # of the readings: more of them are no slips
LONE: Final = 5.0  # times the next pressure, or magnitude: nobody presses in such steps
SCATTER: Final = 3.0  # standard deviations in a median deviation from a fit to two points a step


def odd_readings(readings: Sequence[Reading]) -> list[int]:
    """Return the indices of those that disagree with the others, the worst first.

    None where there are too few to tell, or so many that a slip does not matter.
    """
    if len(readings) > MOST:
        return []
    kpa = np.array([reading.pressure_kpa for reading in readings])
    magnitude = np.array([reading.magnitude for reading in readings])
    sigma = np.array([reading.magnitude_sigma for reading in readings])
    kept = list(np.argsort(kpa, kind="stable"))
    odd: list[int] = []
    while len(kept) > FEWEST and len(odd) < MOST_SHARE * len(readings):
        off = [_off(place, kpa[kept], magnitude[kept], sigma[kept]) for place in range(len(kept))]
        worst = int(np.argmax(off))
        if off[worst] <= TOO_FAR:
            break
        odd.append(int(kept.pop(worst)))
    return odd


def _off(place: int, kpa: FloatArray, magnitude: FloatArray, sigma: FloatArray) -> float:
    """How far one of the readings, by rising pressure, is beyond what the others leave it."""
    own = kpa[place]
    others, shown = np.delete(kpa, place), np.delete(magnitude, place)
    if own > LONE * others[-1]:
        return float("inf")
    fit = isotonic_regression(shown).x
    near = APART * others[-1]
    low = fit[others < own - near].max(initial=0.0)
    answered = fit > SOME_ANSWER * fit[-1]
    can_tell = answered.sum() >= FEWEST_ANSWERED
    leap = LONE * fit[-1] * max(1.0, own / others[-1]) if can_tell else np.inf
    high = fit[others > own + near].min(initial=leap)
    beyond = max(low - magnitude[place], magnitude[place] - high)
    scatter = SCATTER * float(np.median(np.abs(shown - fit)[answered]))
    return float(beyond / max(scatter, LEAST_SCATTER * float(fit[-1]), sigma[place], 1e-12))

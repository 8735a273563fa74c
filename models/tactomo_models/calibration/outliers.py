"""Which load-cell readings the others contradict: slips in a table, such as a wrong power of ten.

Who presses harder changes the magnitude more. So a reading has its place between what the others
show at the next lower and at the next higher pressure, by a rising fit to those others alone. How
far beyond is too far goes by their robust sigma. Slips of one kind may hide each other; with every
one that is mended the others show.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.optimize import isotonic_regression

from tactomo_models.arrays import FloatArray
from tactomo_models.calibration.curve import APART, MIN_READINGS, SOME_ANSWER, Reading
from tactomo_models.robust import robust_sigma

TOO_FAR: Final = 6.0  # standard deviations: a slip of ten, not the worst of many readings
MIN_SIGMA: Final = (
    0.05  # of the others' largest magnitude; at 0.03, skins that scatter by 10 % fail
)
MAX_READINGS: Final = 300  # of more, a slip moves nothing; time goes by their square
LONE: Final = 5.0  # times the next pressure, or magnitude: nobody presses in such steps


def find_outliers(readings: Sequence[Reading]) -> list[int]:
    """Return the indices of the readings that disagree with the others, the worst first.

    None where the readings are too few to tell, or so many that a slip does not matter.
    """
    if len(readings) > MAX_READINGS:
        return []
    kpa = np.array([reading.pressure_kpa for reading in readings])
    magnitude = np.array([reading.magnitude for reading in readings])
    sigma = np.array([reading.magnitude_sigma for reading in readings])
    kept = list(np.argsort(kpa, kind="stable"))
    outliers: list[int] = []
    while len(kept) > MIN_READINGS:
        off = [_off(place, kpa[kept], magnitude[kept], sigma[kept]) for place in range(len(kept))]
        worst = int(np.argmax(off))
        if off[worst] <= TOO_FAR:
            break
        outliers.append(int(kept.pop(worst)))
    return outliers


def _off(place: int, kpa: FloatArray, magnitude: FloatArray, sigma: FloatArray) -> float:
    """How many sigma one of the readings, by rising pressure, is beyond what the others leave."""
    own = kpa[place]
    others, magnitudes = np.delete(kpa, place), np.delete(magnitude, place)
    if own > LONE * others[-1]:
        return float("inf")
    fit = isotonic_regression(magnitudes).x
    near = APART * others[-1]
    low = fit[others < own - near].max(initial=0.0)
    answered = fit > SOME_ANSWER * fit[-1]
    can_tell = answered.sum() >= 3  # fewer do not say how the magnitude goes on
    leap = LONE * fit[-1] * max(1.0, own / others[-1]) if can_tell else np.inf
    high = fit[others > own + near].min(initial=leap)
    beyond = max(low - magnitude[place], magnitude[place] - high)
    # A rising fit takes about every second reading's own deviation for the response's.
    scatter = 2 * robust_sigma((magnitudes - fit)[answered]) if answered.any() else 0.0
    return float(beyond / max(scatter, MIN_SIGMA * float(fit[-1]), sigma[place], 1e-12))

"""Pressure calibration: from load-cell readings to a sensor's own curve, with its uncertainty.

A reading is a press held still: what a load cell says of it, and what the magnitude channel shows.
The response is fitted as a rise that never falls,

    r(p) = a_0 + sum_j a_j clip((p - k_j) / (k_{j+1} - k_j), 0, 1),     all a >= 0

over pressure, which the load cell knows well, and then read the other way round. Below its first
knot the channel does not answer: that onset lies where the readings that show nothing give way to
those that do. It and the number of pieces are chosen by the Bayesian information criterion. Above
the last reading nothing is claimed.

How wrong a pressure may be has two parts here, the third comes with each contact: what readings
scatter about the curve beyond their own uncertainty (repeatability, and hysteresis where there are
readings of rising and of falling loads), and how well so few readings know the curve (parametric
bootstrap).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, Field

from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.errors import CalibrationError
from tactomo_models.scene.pressure import CLEARLY, PressureCurve

MIN_READINGS: Final = 5  # that the magnitude channel answers to: a line and its scatter
MIN_PRESSURES: Final = 4  # different ones among them
MAX_PIECES: Final = 6  # of a curve; fewer where the information criterion says so
APART: Final = 0.02  # of the range: pressures closer than this are the same one again
SOME_ANSWER: Final = 0.03  # of the largest magnitude: less is hardly an answer
MAX_MAGNITUDE: Final = 5.0  # a relative change beyond this is one in per cent
MIN_KPA: Final = 2.0  # of the hardest press: less is in MPa
MAX_KPA: Final = 5000.0  # no skin bears more: it is in Pa

Direction = Literal["up", "down", "unknown"]


class Reading(BaseModel, extra="forbid", frozen=True, allow_inf_nan=False):
    """A press held still."""

    pressure_kpa: Annotated[float, Field(ge=0)]  # what the load cell says, over the indenter's area
    magnitude: Annotated[float, Field(ge=0)]  # |relative conductivity change| inside the contact
    # its standard uncertainty; 0 where nobody has said
    magnitude_sigma: Annotated[float, Field(ge=0)] = 0.0
    direction: Direction = "unknown"  # of the load before it was held


@dataclass(frozen=True)
class Fit:
    """A sensor's curve, and what it came from."""

    curve: PressureCurve  # with the uncertainty of the readings and of the fit
    onset_kpa: float  # from where the channel answers; NaN where the lightest reading did already
    # by how much a falling load reads higher than a rising one, mean; NaN where only one of the two
    # was taken
    hysteresis_kpa: float
    # scatter of readings about the curve, half way up, hysteresis included
    repeatability_kpa: float


class _Columns(NamedTuple):
    """Readings by rising pressure, from those on that may belong to the rise.

    `onset` is where it may begin, from and to; None where the lightest reading answers already.
    """

    kpa: FloatArray
    magnitude: FloatArray
    sigma: FloatArray
    onset: tuple[float, float] | None = None


class _Basis(NamedTuple):
    """Ramps between `knots` (n,) kPa, as `terms` (readings, n - 1), or n with a constant first."""

    knots: FloatArray
    terms: FloatArray
    pieces: int


class _Rise(NamedTuple):
    """A response: `heights` (n,) at a basis' knots; flat below and above."""

    basis: _Basis
    heights: FloatArray
    badness: float

    def __call__(self, kpa: FloatArray) -> FloatArray:
        return np.asarray(np.interp(kpa, self.basis.knots, self.heights))


def directions_of(pressures_kpa: Sequence[float]) -> list[Direction]:
    """Whether the load rose or fell to each of the pressures, in the order of their taking."""
    taken = np.array(pressures_kpa, np.float64)
    return [direction_at(taken, i) for i in range(len(taken))]


def direction_at(pressures_kpa: FloatArray, index: int) -> Direction:
    """Whether the load rose or fell to one of the pressures (n,), in the order of their taking.

    It goes by the last one before that differs by more than a fiftieth of the largest.
    """
    step = pressures_kpa[index] - pressures_kpa[:index]
    clear = step[np.abs(step) > APART * pressures_kpa.max(initial=0.0)]
    return "up" if not len(clear) or clear[-1] > 0 else "down"


def fit_curve(readings: Sequence[Reading]) -> Fit:
    """Fit a sensor's curve to load-cell readings.

    Args:
        readings: in any order; those below the onset, too, they are what it is found from.

    Raises CalibrationError where there are too few readings, none is answered to, units look wrong,
    or the magnitude does not rise with the pressure.
    """
    data = _columns(readings)
    _check_units(data)
    _check_answers(data)
    data = _from_onset(data)
    bases = _bases(data)
    rise = _best_rise(bases, data.magnitude, np.ones(len(data.kpa)))
    for _ in range(2):  # weights need a curve, and it needs weights
        rise = _best_rise(bases, data.magnitude, 1 / _scatter(data, rise))
    own = _own_scatter(data, rise)
    curve = _inverse(rise, float(data.kpa.max()))
    if len(curve.magnitude) < 2:
        raise _not_rising(data)
    slope = np.abs(np.gradient(curve.pressure_kpa, curve.magnitude))
    repeatability = own(curve.magnitude) * slope
    alike = [basis for basis in bases if basis.pieces == rise.basis.pieces]
    of_fit = _fit_sigma(data, rise, alike, curve.magnitude, np.random.default_rng(0))
    middle = float(np.interp(curve.magnitude[-1] / 2, curve.magnitude, repeatability))
    return Fit(
        curve=PressureCurve(curve.magnitude, curve.pressure_kpa, np.hypot(repeatability, of_fit)),
        onset_kpa=float("nan") if data.onset is None else float(rise.basis.knots[0]),
        hysteresis_kpa=_hysteresis(readings, curve),
        repeatability_kpa=middle,
    )


def still_wanted(readings: Sequence[Reading]) -> list[str]:
    """What a calibration still lacks, in words; empty where it is enough."""
    wanted, enough = [], 2 * MIN_READINGS
    ordered = sorted(readings, key=lambda reading: reading.pressure_kpa)
    answers = _answers(_columns(ordered)).tolist() if ordered else []
    answered = [reading for reading, does in zip(ordered, answers, strict=True) if does]
    different = _different(np.array([r.pressure_kpa for r in answered]))
    if len(answered) < enough:
        wanted.append(f"{enough - len(answered)} more that the channel answers to")
    if different < MAX_PIECES:
        wanted.append(f"{MAX_PIECES - different} more pressures, different from these")
    if len(answered) == len(readings):
        wanted.append("one so light that the channel does not answer, for the onset")
    elif answered:
        wanted += _wanted_near_onset(_from_onset(_columns(ordered)))
    if "up" not in {r.direction for r in answered}:
        wanted.append("some with the load rising")
    if "down" not in {r.direction for r in answered}:
        wanted.append("some with the load falling, for the hysteresis")
    return wanted


def _wanted_near_onset(data: _Columns) -> list[str]:
    if data.onset is None:
        return []
    start, first = data.onset
    last = (start + first) / 2 if start else 0.0
    if first - last < 0.15 * data.kpa[-1]:  # as well known as it need be
        return []
    return [f"one between {last:.0f} and {first:.0f} kPa, for the onset"]


def _columns(readings: Sequence[Reading]) -> _Columns:
    ordered = sorted(readings, key=lambda reading: reading.pressure_kpa)
    return _Columns(
        np.array([reading.pressure_kpa for reading in ordered]),
        np.array([reading.magnitude for reading in ordered]),
        np.array([reading.magnitude_sigma for reading in ordered]),
    )


def refuse_mpa(top_kpa: float) -> None:
    """Raise CalibrationError where the largest pressure is less than any calibration has."""
    if top_kpa < MIN_KPA:
        raise CalibrationError(
            f"the largest pressure is {top_kpa:g} kPa; is it in MPa, or the indenter's area too "
            "large?"
        )


def _check_units(data: _Columns) -> None:
    if not len(data.kpa):
        raise CalibrationError("there are no readings; take some with the skin pressed")
    top = float(data.kpa.max())
    if top > MAX_KPA:
        raise CalibrationError(
            f"a pressure of {top:g} kPa is more than any skin bears; is it in Pa, or the "
            "indenter's area too small?"
        )
    refuse_mpa(top)
    if data.magnitude.max() > MAX_MAGNITUDE:
        raise CalibrationError(
            f"a magnitude of {data.magnitude.max():g} is no relative change of conductivity; is "
            "it in per cent? Give a ratio"
        )


def _check_answers(data: _Columns) -> None:
    least = max(0.01, 2 * float(np.median(data.sigma)))  # noise and drift make less
    if data.magnitude.max() < least:
        raise CalibrationError(
            f"the magnitude channel does not answer to any of the {len(data.kpa)} readings, up to "
            f"{data.kpa.max():.0f} kPa; press harder"
        )
    answered = _answers(data)
    count, different = int(answered.sum()), _different(data.kpa[answered])
    if count < MIN_READINGS or different < MIN_PRESSURES:
        raise CalibrationError(
            f"the magnitude channel answers to {count} of {len(data.kpa)} readings, at "
            f"{different} different pressures; at least {MIN_READINGS} at {MIN_PRESSURES} are "
            "needed"
        )
    total = float(np.sum((data.magnitude - data.magnitude.mean()) ** 2))
    from scipy.optimize import isotonic_regression  # 10 MB, which a daemon need not hold

    rising = isotonic_regression(data.magnitude).x
    left = float(np.sum((data.magnitude - rising) ** 2))
    if left >= total / 2:  # a rise explains less than half of the variance
        raise _not_rising(data)


def _not_rising(data: _Columns) -> CalibrationError:
    worst = int(np.argmin(np.diff(data.magnitude)))
    return CalibrationError(
        f"the magnitude does not rise with the pressure: it is {data.magnitude[worst]:.3f} at "
        f"{data.kpa[worst]:.0f} kPa and {data.magnitude[worst + 1]:.3f} at "
        f"{data.kpa[worst + 1]:.0f} kPa; check that both are of the same press, and the columns' "
        "order"
    )


def _answers(data: _Columns) -> BoolArray:
    """Whether the channel answers to each reading: its magnitude is clearly above nothing."""
    least = SOME_ANSWER * data.magnitude.max(initial=0.0)
    return np.asarray(data.magnitude > np.maximum(least, CLEARLY * data.sigma))


def _from_onset(data: _Columns) -> _Columns:
    """Leave out what is clearly before the onset, and say where that may lie.

    It is where answering or not goes best with being above or below: one odd reading moves nothing.
    """
    answers = _answers(data)
    below = np.concatenate([[0], np.cumsum(answers)])  # wrong, were the onset after so many
    above = np.concatenate([np.cumsum(~answers[::-1])[::-1], [0]])
    split = int(np.argmin(below + above))
    if split == 0:
        return data
    last, first = float(data.kpa[split - 1]), float(data.kpa[split])
    start = max(0.0, 2 * last - first)  # what answers too little to be noticed is before the split
    kept = data.kpa > start
    return _Columns(data.kpa[kept], data.magnitude[kept], data.sigma[kept], (start, first))


def _different(kpa: FloatArray) -> int:
    """Number of pressures that are not nearly the same."""
    if not len(kpa):
        return 0
    ordered = np.sort(kpa)
    last, count = ordered[0], 1
    for value in ordered[1:]:
        if value - last > APART * ordered[-1]:
            last, count = value, count + 1
    return count


def _best_rise(bases: Sequence[_Basis], magnitude: FloatArray, weight: FloatArray) -> _Rise:
    """The rise whose onset and number of pieces pay for themselves."""
    return min((_rise(basis, magnitude, weight) for basis in bases), key=lambda rise: rise.badness)


def _bases(data: _Columns) -> list[_Basis]:
    """Every number of pieces from every pressure at which the rise may begin."""
    starts = data.kpa[:1]
    if data.onset is not None:  # in steps finer than what readings tell of the onset
        starts = np.linspace(*data.onset, 20, endpoint=False)
    most = max(1, min(MAX_PIECES, _different(data.kpa) - 2))
    return [_basis(data, float(start), n) for start in starts for n in range(1, most + 1)]


def _basis(data: _Columns, start: float, pieces: int) -> _Basis:
    """Ramps from `start` on, with as many readings to each piece."""
    inner = np.quantile(data.kpa[data.kpa > start], np.arange(1, pieces) / pieces)
    knots = np.unique(np.concatenate([[start], inner, [data.kpa[-1]]]))
    terms = np.clip((data.kpa[:, None] - knots[:-1]) / np.diff(knots), 0, 1)
    if data.onset is None:
        terms = np.column_stack([np.ones(len(terms)), terms])
    return _Basis(knots, terms, pieces)


def _rise(basis: _Basis, magnitude: FloatArray, weight: FloatArray) -> _Rise:
    """The best rise of a basis."""
    from scipy.optimize import nnls

    steps, left = nnls(basis.terms * weight[:, None], magnitude * weight)
    has_onset = basis.terms.shape[1] < len(basis.knots)
    heights = np.cumsum(np.append(0.0, steps) if has_onset else steps)
    count = len(magnitude)
    variance = max(left**2 / count, 1e-12 * float(np.mean((magnitude * weight) ** 2)))
    badness = count * np.log(variance) + (len(basis.knots) + 1) * np.log(count)
    return _Rise(basis, heights, float(badness))


class _Scatter(NamedTuple):
    """Standard deviation of a magnitude: a part that is constant, and one that goes with it."""

    constant: float
    share: float

    def __call__(self, magnitude: FloatArray) -> FloatArray:
        return np.hypot(self.constant, self.share * magnitude)


def _own_scatter(data: _Columns, rise: _Rise) -> _Scatter:
    """What readings scatter beyond their own uncertainty: repeatability and hysteresis."""
    answered = rise(data.kpa) > 0  # those on the rise, not before it
    from scipy.optimize import nnls

    expected = rise(data.kpa)[answered]
    free = max(1, int(answered.sum()) - len(rise.basis.knots))
    square = (data.magnitude[answered] - expected) ** 2 * (answered.sum() / free)
    beyond = square - data.sigma[answered] ** 2
    terms = np.stack([np.ones(len(expected)), expected**2], axis=1)
    (constant, share), _ = nnls(terms, beyond)
    return _Scatter(float(np.sqrt(constant)), float(np.sqrt(share)))


def _scatter(data: _Columns, rise: _Rise) -> FloatArray:
    """Standard deviation of each reading about the curve, its own uncertainty included."""
    whole = np.hypot(_own_scatter(data, rise)(rise(data.kpa)), data.sigma)
    return np.maximum(whole, 1e-4 * float(data.magnitude.max()))


def _inverse(rise: _Rise, top_kpa: float) -> PressureCurve:
    """The rise read the other way round, on finer points; what is flat has no inverse."""
    rising = np.append(True, np.diff(rise.heights) > 1e-6 * rise.heights[-1])
    heights, knots = rise.heights[rising], rise.basis.knots[rising]
    between = np.arange(4 * (len(heights) - 1) + 1) / 4  # the uncertainty is no straight line
    places = np.arange(len(heights))
    kpa = np.minimum(np.interp(between, places, knots), top_kpa)
    return PressureCurve(np.interp(between, places, heights), kpa, np.zeros(len(between)))


def _fit_sigma(
    data: _Columns,
    rise: _Rise,
    bases: Sequence[_Basis],
    magnitude: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """How well the curve is known at some magnitudes, in kPa, by readings that might have been."""
    expected, sigma = rise(data.kpa), _scatter(data, rise)
    found = np.empty((100, len(magnitude)))  # draws: a standard deviation to 7 %
    for i in range(len(found)):
        drawn = np.maximum(expected + sigma * rng.standard_normal(len(sigma)), 0)
        again = _best_rise(bases, drawn, 1 / sigma)
        found[i] = _inverse(again, float(data.kpa[-1])).pressure(magnitude)
    return np.asarray(found.std(axis=0))


def _hysteresis(readings: Sequence[Reading], curve: PressureCurve) -> float:
    """Mean of what falling loads read too high, less the same of rising ones, kPa."""
    too_high: dict[Direction, list[float]] = {"up": [], "down": [], "unknown": []}
    for reading in readings:
        if reading.magnitude > SOME_ANSWER * curve.magnitude[-1]:
            found = float(curve.pressure(np.array(reading.magnitude)))
            too_high[reading.direction].append(found - reading.pressure_kpa)
    if not (too_high["up"] and too_high["down"]):
        return float("nan")
    return float(np.mean(too_high["down"]) - np.mean(too_high["up"]))

"""Where a press is and how hard, learnt on one skin from presses at known places.

Voltages depend smoothly on where a skin is pressed. A Gaussian process learns that dependence, of
two inputs and M outputs, from few presses; a new press is where its voltages are likely, by Bayes'
rule on a grid of places. This takes far fewer presses than a regression from M voltages to a place
does. A second Gaussian process learns what is then still wrong, as far as the presses tell: of the
first process, or of a model of the skin.

Voltages are taken at unit length: how hard a press is scales them, and where it is turns them.

Source of both: Rasmussen & Williams, "Gaussian Processes for Machine Learning" (2006), equations
2.25, 2.26, 5.8 (hyperparameters by marginal likelihood) and 5.12 (leave-one-out residuals).
"""

from __future__ import annotations

from typing import Final, NamedTuple, Self

import numpy as np

from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.errors import DataError

MIN_PRESSES: Final = 12  # below it, five folds leave hardly two presses each to choose by
FOLDS: Final = 5
GRID: Final = 32
"""Places along the longer side: 2.5 mm on a skin of 80 mm. With 40 the median falls by 1 %."""
REACH: Final = 3.0
"""Median distances between neighbouring presses, within which a place counts as taught."""
LENGTHS: Final = (0.075, 0.11, 0.16, 0.23, 0.33)
"""Length scales of the voltages over the skin, in shares of its longer side, to choose from."""
NOISES: Final = tuple(np.geomspace(3e-3, 3.0, 10).tolist())
"""Variances of noise over those of the signal, to choose from."""
SHRINKAGE: Final = 30.0
"""Presses over which the noise's covariance outweighs its diagonal. 15 or 60: medians by 1 %."""
TEMPERING: Final = 0.4
"""Exponent of the likelihood: residuals are not Gaussian. From 0.3 to 1 medians differ by 2 %."""
CORRECTION_SCALES: Final = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Squared length scales of the correction, over the median squared distance of presses."""
CORRECTION_NOISES: Final = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
CORRECTION_PLACE: Final = 1 / 3
"""Share of the skin's longer side that counts as much as the spread of the unit voltages."""
CORRECTION_RANK: Final = 100
"""Eigenvectors that tell its variance; the others would lower it by less than 1 %."""
UNLIKE: Final = 1.5
"""Times the misfit of the least explained presses (99 %), beyond which none like it was taught."""
MIN_SPREAD: Final = 0.02
"""Standard deviation of the logarithms of loads, below which no line can be told."""


class Located(NamedTuple):
    """Where T presses are."""

    xy_mm: FloatArray  # (T, 2)
    sigma_mm: FloatArray  # (T,) standard uncertainty of each coordinate
    # (T,) whether presses like it were taught; where not, the place is a guess
    is_taught: BoolArray


class PressRegression:
    """Locates presses on the skin whose presses it was made of.

    Attributes:
        found_mm: (N, 2) where the voltages of each have it, by presses of other folds alone.

    Raises DataError where there are too few presses, or they hold what is no number or no press.
    """

    def __init__(
        self,
        changes: FloatArray,  # (N, M) voltage changes under each press, on any one scale
        xy_mm: FloatArray,  # (N, 2) where each was
        # (N, 2) where a model of the skin has them, to be corrected; if None, the voltages alone
        # tell
        guess_mm: FloatArray | None = None,
    ) -> None:
        if len(changes) < MIN_PRESSES:
            raise DataError(
                f"{len(changes)} presses are too few to learn from; give {MIN_PRESSES} or more"
            )
        if not np.isfinite(xy_mm).all() or np.ptp(xy_mm, axis=0).max() <= 0:
            raise DataError("the presses are all at one place, or at none; give where each was")
        unit, log_size = _unit(changes)
        self._field, found, misfit = _VoltageField.cross_validated(unit, xy_mm)
        self.found_mm, self._xy_mm = found, xy_mm
        self._reach_mm = _reach_mm(xy_mm)
        self._has_guess = guess_mm is not None
        self._limit = UNLIKE * float(np.quantile(misfit, 0.99))
        self._scale = np.concatenate(
            [
                np.full(unit.shape[1], 1 / np.sqrt(unit.var(axis=0).sum() + 1e-30)),
                [0.3 / (log_size.std() + 1e-30)],  # how hard tells less than where
                np.full(2, 1 / (CORRECTION_PLACE * np.ptp(xy_mm, axis=0).max())),
            ]
        )
        guess = found if guess_mm is None else guess_mm
        self._correction = Correction(
            np.column_stack([unit, log_size, guess]) * self._scale, xy_mm - guess
        )

    def locate(self, changes: FloatArray, guess_mm: FloatArray | None = None) -> Located:
        """Locate T presses by their changes (T, M), and where the model has them (T, 2)."""
        unit, log_size = _unit(changes)
        found, misfit = self._field.locate(unit)
        is_taught = misfit <= self._limit
        guess = found
        if self._has_guess and guess_mm is not None:
            guess = guess_mm
            nearest = _squared_distances(guess, self._xy_mm).min(axis=1)
            is_taught &= nearest <= self._reach_mm**2
        seen = np.column_stack([unit, log_size, guess]) * self._scale
        correction, variance = self._correction.at(seen)
        return Located(guess + correction, np.sqrt(variance), is_taught)


def _unit(changes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Changes (T, M) at unit length, and the logarithms (T,) of their lengths."""
    size = np.linalg.norm(changes, axis=1)
    if not (np.isfinite(size) & (size > 0)).all():
        first = int(np.flatnonzero(~(np.isfinite(size) & (size > 0)))[0])
        raise DataError(
            f"press {first} changes no voltage, or holds what is no number; leave it out"
        )
    return changes / size[:, None], np.log(size)


def _squared_distances(a: FloatArray, b: FloatArray) -> FloatArray:
    """Of each row of one (T, K) from each row of the other (N, K), as (T, N)."""
    squares = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1)
    return np.asarray(np.maximum(squares - 2.0 * (a @ b.T), 0.0))


class _Spectrum:
    """What N presses teach of K outputs (N, K), by a squared-exponential kernel, at any noise.

    Args:
        squared: (N, N) squared distances of the presses over the squared length scale.
        y: the outputs, of zero mean.
    """

    def __init__(self, squared: FloatArray, y: FloatArray) -> None:
        values, self.vectors = np.linalg.eigh(np.exp(-0.5 * squared))
        self.values = np.maximum(values, 0.0)
        self._turned = self.vectors.T @ y

    def variance(self, noise: float) -> FloatArray:
        """Variance (K,) of each output's signal, at its most likely."""
        inverse = 1 / (self.values + noise)
        return np.asarray(inverse @ self._turned**2) / len(self.values) + 1e-30

    def log_likelihood(self, noise: float) -> float:
        """Marginal, of all outputs together, but for a constant."""
        logs = np.log(self.variance(noise)) + np.log(self.values + noise).mean()
        return -0.5 * len(self.values) * float(logs.sum())

    def weights(self, noise: float) -> FloatArray:
        """Weights (N, K) of the kernel's rows."""
        return np.asarray(self.vectors @ (self._turned / (self.values + noise)[:, None]))

    def residual(self, noise: float) -> FloatArray:
        """Leave-one-out residuals (N, K)."""
        precision = self.vectors**2 @ (1 / (self.values + noise))
        return np.asarray(self.weights(noise) / precision[:, None])


class _VoltageField:
    """Unit voltages (M,) as a smooth function of the place, with the noise about it.

    Attributes:
        length_mm: scale over which the voltages change.
        noise: variance of the noise over the signal's.
    """

    def __init__(self, unit: FloatArray, xy_mm: FloatArray, length_mm: float, noise: float) -> None:
        self.length_mm, self.noise = length_mm, noise
        self._mean = unit.mean(axis=0)
        squared = _squared_distances(xy_mm, xy_mm) / length_mm**2
        spectrum = _Spectrum(squared, unit - self._mean)
        self._grid = _taught_places(xy_mm)
        kernel = np.exp(-0.5 * _squared_distances(self._grid, xy_mm) / length_mm**2)
        on_grid = kernel @ spectrum.weights(noise) + self._mean
        self._whitener = _whitener(spectrum.residual(noise))
        self._white_grid = on_grid @ self._whitener
        self._grid_squares = (self._white_grid**2).sum(axis=1)

    def locate(self, unit: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean places (T, 2), and how far from the nearest place's voltages (T,), rms."""
        white = unit @ self._whitener
        squares = self._grid_squares - 2.0 * (white @ self._white_grid.T)
        least = squares.min(axis=1)
        weight = np.exp(-0.5 * TEMPERING * (squares - least[:, None]))
        xy_mm = weight @ self._grid / weight.sum(axis=1)[:, None]
        misfit = np.sqrt(np.maximum(least + (white**2).sum(axis=1), 0.0) / unit.shape[1])
        return xy_mm, misfit

    @classmethod
    def cross_validated(
        cls, unit: FloatArray, xy_mm: FloatArray
    ) -> tuple[Self, FloatArray, FloatArray]:
        """Learn from N presses; also where each is by the others (N, 2), and its misfit (N,).

        The folds are runs of presses in order: what drifts is not in the others.
        """
        length_mm, noise = _best_scales(unit, xy_mm)
        fold = np.arange(len(unit)) * FOLDS // len(unit)
        parts = [
            cls(unit[fold != k], xy_mm[fold != k], length_mm, noise).locate(unit[fold == k])
            for k in range(FOLDS)
        ]
        places, misfit = (np.concatenate(each) for each in zip(*parts, strict=True))
        return cls(unit, xy_mm, length_mm, noise), places, misfit


def _whitener(residual: FloatArray) -> FloatArray:
    """Matrix (M, M) that makes N residuals (N, M) even, their covariance shrunk to its diagonal."""
    covariance = residual.T @ residual / len(residual)
    power = np.diag(covariance)
    shrinkage = min(0.5, SHRINKAGE / len(residual))
    floor = 1e-6 * power.max() + 1e-30  # a dead channel has no noise at all
    covariance = (1 - shrinkage) * covariance + np.diag(shrinkage * power + floor)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)).T)


def _best_scales(unit: FloatArray, xy_mm: FloatArray) -> tuple[float, float]:
    """Length scale in mm and noise of the largest marginal likelihood."""
    squared, y = _squared_distances(xy_mm, xy_mm), unit - unit.mean(axis=0)
    tried = []
    for length_mm in np.multiply(LENGTHS, np.ptp(xy_mm, axis=0).max()).tolist():
        spectrum = _Spectrum(squared / length_mm**2, y)
        tried += [(spectrum.log_likelihood(noise), length_mm, noise) for noise in NOISES]
    _, length_mm, noise = max(tried)
    return length_mm, noise


def _reach_mm(xy_mm: FloatArray) -> float:
    """How far from a press a place still counts as taught."""
    squared = _squared_distances(xy_mm, xy_mm)
    apart = np.where(squared > 1e-6 * squared.max(), squared, np.inf)  # one place twice is one
    return REACH * float(np.sqrt(np.median(apart.min(axis=1))))


def _taught_places(xy_mm: FloatArray) -> FloatArray:
    """A grid of places (P, 2) as far as presses (N, 2) reach."""
    low, high = xy_mm.min(axis=0), xy_mm.max(axis=0)
    step_mm = float((high - low).max()) / GRID
    axes = [np.arange(a, b + step_mm, step_mm) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    reach_mm = max(_reach_mm(xy_mm), step_mm)
    return np.asarray(grid[_squared_distances(grid, xy_mm).min(axis=1) <= reach_mm**2])


class Correction:
    """What is still wrong, learnt from inputs (N, K) and errors (N, D)."""

    def __init__(self, seen: FloatArray, error: FloatArray) -> None:
        squared = _squared_distances(seen, seen)
        scales = np.median(squared) * np.array(CORRECTION_SCALES)
        spectra = [_Spectrum(squared / scale, error) for scale in scales]
        which, noise = max(
            ((k, noise) for k in range(len(scales)) for noise in CORRECTION_NOISES),
            key=lambda tried: spectra[tried[0]].log_likelihood(tried[1]),
        )
        best, top = spectra[which], slice(-CORRECTION_RANK, None)
        self._seen, self._scale, self._noise = seen, scales[which], noise
        self._weights, self._variance = best.weights(noise), float(best.variance(noise).mean())
        # The product of the kernel's rows with it, squared, is what is known.
        self._factor = best.vectors[:, top] / np.sqrt(best.values[top] + noise)

    def at(self, seen: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The corrections (T, D), and the variance (T,) of each."""
        kernel = np.exp(-0.5 * _squared_distances(seen, self._seen) / self._scale)
        known = ((kernel @ self._factor) ** 2).sum(axis=1)
        return kernel @ self._weights, self._variance * (1.0 + self._noise - known)


class ForceRegression:
    """Tells forces on the skin whose presses, of known force, it was made of.

    The physics' load, magnitude times area, grows with the force. On logarithms the dependence is a
    straight line; what is left depends on the place, where a Gaussian process learns it. A cover
    that takes part of the load, and a table of another sheet, are in the line.

    Raises DataError where there are too few presses, or all are of one load.
    """

    def __init__(
        self,
        loads: FloatArray,  # (N,) magnitude times area of each contact, on any one scale
        xy_mm: FloatArray,  # (N, 2) where each was
        force_n: FloatArray,  # (N,) newtons
    ) -> None:
        seen, known = np.log(loads), np.log(force_n)
        if len(seen) < MIN_PRESSES or seen.std() < MIN_SPREAD:
            raise DataError(f"give {MIN_PRESSES} presses of known force, or more, of various ones")
        self._line = np.polyfit(seen, known, 1)
        rest = known - np.polyval(self._line, seen)
        self._rest = Correction(xy_mm, rest[:, None])

    def force(self, loads: FloatArray, xy_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Forces (T,) of loads (T,) at places (T, 2), and their standard uncertainties, newtons."""
        rest, variance = self._rest.at(xy_mm)
        force_n = np.exp(np.polyval(self._line, np.log(loads)) + rest[:, 0])
        return force_n, force_n * np.sqrt(variance)

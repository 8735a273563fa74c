"""Tanks as the Kuopio Tomography Challenge reads and judges them.

A reading that is not a number belongs to an electrode that is lost. The conductivity of the water
follows from the empty tank; what stood in the full one has no part in anything but the score.

Source: Rasanen et al., "Kuopio Tomography Challenge 2023 open electrical impedance tomographic
dataset", doi 10.5281/zenodo.8252370.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter
from tactomo_models.arrays import BoolArray, FloatArray, Image, IntArray
from tactomo_models.errors import DataError
from tactomo_models.sensor.description import SensorDescription

from tactomo_lab.evaluation.measured_sets import check_pictures, read_set
from tactomo_lab.tanks.fit import TankFit
from tactomo_lab.tanks.model import Readings, TankModel, pixel_grid

WATER_SIGMA = 0.05  # of the scale's logarithm; four measured empty tanks leave the model 0.04 off
WINDOW = 80  # pixels, standard deviation of the score's window; it ends at twice that
C1, C2 = 1e-4, 9e-4
MAX_READINGS = 4096  # of a tank, as of the largest pattern; the challenge's are 2356


@dataclass(frozen=True)
class Challenge:
    """A file of the challenge's tanks."""

    currents: FloatArray  # (T, L, D) of each drive, amperes
    weights: FloatArray  # (L, m) of the electrodes' potentials in each reading of a drive
    reference: FloatArray  # (T, D m) readings of the empty tank, volts, drive by drive
    voltages: FloatArray  # (T, D m) of the full one; not a number where an electrode is lost
    truth: Image  # (T, rows, columns) 0 water, 1 conducts worse, 2 better
    level: IntArray  # (T,) of difficulty, as the file has it

    def at_level(self, level: int) -> Challenge:
        """The same tanks without the electrodes that a level of difficulty loses."""
        voltages = self.voltages.copy()
        for currents, volts in zip(self.currents, voltages, strict=True):
            of_drive, of_reading = every_reading(currents, self.weights)
            volts[~kept_readings(of_drive, of_reading, range(2 * level - 2))] = np.nan
        return replace(self, voltages=voltages, level=np.full_like(self.level, level))


@dataclass(frozen=True)
class ChallengeOutcome:
    """One tank's; `image` (rows, columns) has the truth's kinds."""

    level: int
    readings: int
    score: float
    misfit: float
    seconds: float
    image: Image


def read_challenge(path: Path, description: SensorDescription) -> Challenge:
    """Read a file of the challenge's tanks.

    Raises DataError where the file cannot be read or holds something else.
    """
    keys = ("injection", "measurement", "reference", "voltages", "truth")
    arrays = read_set(path, "the challenge's tanks", *keys)
    currents, weights, reference, voltages, truth = (arrays[key] for key in keys)
    check_pictures(path, truth)
    level = arrays.get("level", np.zeros(len(truth)))
    tanks, electrodes = len(truth), description.electrode_count
    readings = currents.shape[-1] * weights.shape[-1]
    shapes = {
        "injection": (currents, (tanks, electrodes, currents.shape[-1])),
        "measurement": (weights, (electrodes, weights.shape[-1])),
        "reference": (reference, (tanks, readings)),
        "voltages": (voltages, (tanks, readings)),
        "level": (level, (tanks,)),
    }
    for key, (array, wanted) in shapes.items():
        if array.shape != wanted:
            raise DataError(f"{path}: {key} is {array.shape}; {wanted} is needed, drive by drive")
    if readings > MAX_READINGS:
        raise DataError(f"{path}: {readings} readings of a tank; at most {MAX_READINGS} are read")
    if not np.isin(truth, (0, 1, 2)).all():
        raise DataError(f"{path}: truth holds other values than 0 water, 1 worse, 2 better")
    if not np.isin(level, range(8)).all():
        raise DataError(f"{path}: level holds other values than 0 to 7")
    usable = np.isfinite(reference) & np.isfinite(voltages)
    if not usable.any(axis=1).all():
        tank = int(np.flatnonzero(~usable.any(axis=1))[0])
        raise DataError(f"{path}: tank {tank} has no reading that is a number; leave it out")
    return Challenge(
        currents, weights, reference, voltages, truth.astype(np.uint8), level.astype(int)
    )


def evaluate_challenge(
    given: Challenge, description: SensorDescription
) -> Iterator[ChallengeOutcome]:
    """Find what stands in every tank, and score it.

    Raises DataError where a reference is none of this tank.
    """
    model = TankModel(description)
    known: dict[bytes, TankFit] = {}  # of the last way to read: tanks in a row are read one way
    for currents, reference, volts, truth, level in zip(
        given.currents, given.reference, given.voltages, given.truth, given.level, strict=True
    ):
        begin = time.process_time()
        of_drive, of_reading = every_reading(currents, given.weights)
        kept = np.isfinite(reference) & np.isfinite(volts)
        empty = model.readings_of_empty(of_drive[kept], of_reading[kept])
        # The largest readings tell most, and are nearest to the model's.
        shown = float(empty @ reference[kept])
        if not shown > 0:
            raise DataError(
                "the reference is no scan of this tank: give injection in amperes into the "
                "electrodes, measurement as the weights of their potentials, drive by drive"
            )
        key = of_drive.tobytes() + of_reading.tobytes() + kept.tobytes()
        if key not in known:
            readings = Readings(model, of_drive[kept], of_reading[kept], empty)
            known = {key: TankFit(model, readings)}
        changes = float(empty @ empty) / shown * (volts - reference)[kept]
        tank = known[key].find(changes, WATER_SIGMA)
        image = classes(known[key].image(tank, *truth.shape))
        seconds = time.process_time() - begin
        found = score(truth, image)
        yield ChallengeOutcome(int(level), len(changes), found, tank.misfit, seconds, image)


def classes(f: FloatArray) -> Image:
    """Kinds (rows, columns) as the challenge has them, of a level-set function."""
    inside = pixel_grid(*f.shape)[2]
    return np.asarray(np.where(f > 0.5, 2, np.where(f < -0.5, 1, 0)) * inside, np.uint8)


def every_reading(currents: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Currents and weights (D m, L) of each reading, of those of D drives (L, D) and m (L, m)."""
    each = np.repeat(currents.T, weights.shape[1], axis=0)
    return each, np.tile(weights.T, (currents.shape[1], 1))


def kept_readings(currents: FloatArray, weights: FloatArray, lost: Iterable[int]) -> BoolArray:
    """Which readings (n,) touch none of the lost electrodes."""
    lost = list(lost)
    return np.asarray(~(currents[:, lost].any(axis=1) | weights[:, lost].any(axis=1)))


def score(truth: Image, found: Image) -> float:
    """The challenge's score: mean structural similarity of what conducts worse, and of better.

    Both (rows, columns) of 0 water, 1 worse, 2 better.
    """
    return float(np.mean([_similarity(truth == kind, found == kind) for kind in (1, 2)]))


def _similarity(truth: BoolArray, found: BoolArray) -> float:
    """Mean of the index of Wang et al., IEEE Trans. Image Process. 13 (2004), equation 13."""
    here = _windowed(np.ones(truth.shape))
    t, f = (_windowed(image.astype(float)) / here for image in (truth, found))
    both = _windowed((truth & found).astype(float)) / here
    means = (2 * t * f + C1) / (t**2 + f**2 + C1)  # a mask is its own square
    return float(np.mean(means * (2 * (both - t * f) + C2) / (t - t**2 + f - f**2 + C2)))


def _windowed(image: FloatArray) -> FloatArray:
    return np.asarray(gaussian_filter(image, WINDOW, mode="constant", truncate=2))

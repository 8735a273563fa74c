"""Round tanks with objects in them, and how alike images and truth are.

Measured sets often hold no more than each voltage's change, on some common scale, and the truth
as a picture. The reference is then the model's own empty tank, and the scale is an unknown of
the whole set, a parameter of each tank's fit, see `estimate_scale`: without a look at the truth.

`levelset` is the fit of `tactomo_lab.tanks`, all other methods are those of the daemon.

An image's likeness is its Pearson correlation with the truth over the pixels of the disc, of the
signed `structure` map: 1 in what conducts better than the saline, -1 in what conducts worse; a
linear method's map is in proportion to the conductivity's change.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from tactomo_models.archive import read_arrays
from tactomo_models.arrays import FloatArray, Image
from tactomo_models.errors import DataError
from tactomo_models.physics.artifact import Artifact, load_or_build_artifact
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.reconstruct import Reconstructor
from tactomo_models.scans.reference import Reference, noise_of_reciprocity
from tactomo_models.scene.reconstruction import Reconstruction
from tactomo_models.sensor.description import SensorDescription

from tactomo_lab.scenes import measures
from tactomo_lab.tanks.fit import Tank, TankFit
from tactomo_lab.tanks.model import Readings, TankModel

BUDGET_S = 20.0  # a file has no deadline
EXACT = 10**6  # scans that a reference without noise is the mean of
FIRST_SHARE = 0.8  # of the scale at which some voltage would have fallen to nothing
FREE = 0.3  # deviation of a scale's logarithm that nothing is known of but that share
SAME = 0.02  # of a scale's logarithm: a change not worth another round, and the least deviation
MAX_ROUNDS = 4


@dataclass(frozen=True)
class Tanks:
    """Scans of tanks with objects, and what stood in them.

    Attributes:
        names: of the n tanks.
        changes: (n, M) by how much each voltage's size grew, on one common scale.
        truth: (n, rows, columns) 1 in what conducts better, -1 worse; row 0 is the top, and the
            disc fills the picture.
    """

    names: tuple[str, ...]
    changes: FloatArray
    truth: FloatArray


@dataclass(frozen=True)
class TankOutcome:
    """What one method made of one tank; `image` (rows, columns) is on the truth's pixels."""

    name: str
    method: str
    correlation: float
    misfit: float
    seconds: float
    image: FloatArray


def read_tanks(path: Path, description: SensorDescription) -> Tanks:
    """Read `dv` (n, M), `truth` (n, rows, columns) and `name` (n,).

    Raises:
        DataError: the file cannot be read or holds something else.
    """
    try:
        arrays = read_arrays(path)
        changes, truth = arrays["dv"].astype(float), arrays["truth"].astype(float)
        names = arrays["name"]
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror}; give the set's .npz") from error
    except (KeyError, ValueError) as error:
        raise DataError(
            f"{path} is no set of tanks ({error}): dv, truth and name are needed, the first two "
            "numbers"
        ) from error
    wanted = (len(names), description.measurements)
    if changes.shape != wanted or truth.ndim != 3 or len(truth) != len(names):
        raise DataError(
            f"{path}: dv is {changes.shape}, truth is {truth.shape}; {wanted} and "
            f"({len(names)}, rows, columns) are needed"
        )
    if not np.isfinite(changes).all():
        raise DataError(f"{path}: dv holds voltages that are not numbers; leave those tanks out")
    return Tanks(tuple(str(name) for name in names), changes, truth)


def pixels(rows: int, columns: int, radius_m: float) -> tuple[FloatArray, FloatArray]:
    """Centres of a picture's pixels, metres; row 0 is the top."""
    x = ((np.arange(columns) + 0.5) / columns * 2 - 1) * radius_m
    y = (1 - (np.arange(rows) + 0.5) / rows * 2) * radius_m
    grid = np.meshgrid(x, y)
    return grid[0], grid[1]


class TankImager:
    """Reconstructs voltage changes against the model's own empty tank."""

    def __init__(self, description: SensorDescription, artifact: Artifact | None = None) -> None:
        self.description = description
        self._artifact = artifact or load_or_build_artifact(description)
        self._empty = ForwardModel(description, self._artifact.bare).bare_voltages
        self._reconstructors: dict[str, Reconstructor] = {}

    def reconstruct(self, change: FloatArray, method: str) -> Reconstruction:
        """Reconstruct one tank.

        Args:
            change: (M,) by how much each voltage's size grew, in units of the model's voltages.
            method: of reconstruction.
        """
        if method not in self._reconstructors:
            self._reconstructors[method] = Reconstructor(
                self.description, self._artifact, method=method, budget_s=BUDGET_S
            )
        reconstructor = self._reconstructors[method]
        scan = self._empty + np.sign(self._empty) * change
        noise = noise_of_reciprocity(self.description, scan - self._empty)
        reconstructor.set_reference(
            Reference(None, self._empty, structure_noise=noise, scans=EXACT)
        )
        return reconstructor.reconstruct(None, scan)


class TankFitter:
    """Fits objects to voltage changes against the model's own empty tank."""

    def __init__(self, description: SensorDescription) -> None:
        model, pairs = TankModel(description), description.pairs
        unit = np.eye(description.electrode_count)
        drive, measure = (unit[p[:, 0]] - unit[p[:, 1]] for p in (pairs.drive, pairs.measure))
        self._empty = model.readings_of_empty(drive, measure)
        self._fit = TankFit(model, Readings(model, drive, measure, self._empty))

    def largest_scale(self, changes: FloatArray) -> float:
        """Scale at which some voltage would have fallen to nothing."""
        return float(1 / np.max(-changes / np.abs(self._empty)))

    def find(self, change: FloatArray, scale: float, scale_sigma: float) -> Tank:
        """Fit one tank.

        Args:
            change: (M,) by how much each voltage's size grew.
            scale: of the changes, in units of the model's voltages.
            scale_sigma: standard deviation of its logarithm.
        """
        return self._fit.find(np.sign(self._empty) * scale * change, max(scale_sigma, SAME))

    def image(self, tank: Tank, shape: tuple[int, ...]) -> FloatArray:
        """Objects of either sign on the pixels of a picture; NaN off the disc."""
        rows, columns = shape
        f = self._fit.image(tank, rows, columns)
        x, y = pixels(rows, columns, 1.0)
        return np.where(np.hypot(x, y) < 1, np.clip(2 * f, -1, 1), np.nan)


def estimate_scale(fitter: TankFitter, changes: FloatArray) -> tuple[float, float]:
    """Common scale of all tanks (n, M), and the standard deviation of its logarithm.

    Each tank's fit has it as a parameter; the tanks' are averaged by their precisions, and fitted
    again from there until they stay.
    """
    scale = FIRST_SHARE * fitter.largest_scale(changes)
    for _ in range(MAX_ROUNDS):
        found = [fitter.find(change, scale, FREE) for change in changes]
        off = np.array([tank.log_scale for tank in found])
        precision = np.array([tank.log_scale_sigma for tank in found]) ** -2.0
        mean = float(np.average(off, weights=precision))
        scatter = max(1.0, float(np.mean(precision * (off - mean) ** 2)))
        scale *= np.exp(-mean)
        if abs(mean) < SAME:
            break
    return scale, float(np.sqrt(scatter / precision.sum()))


def evaluate_tanks(
    imager: TankImager,
    fitter: TankFitter,
    tanks: Tanks,
    methods: Iterable[str],
    scale: float,
    scale_sigma: float = 0.0,
) -> Iterator[TankOutcome]:
    """Reconstruct every tank by every method and compare with the truth."""
    for name, change, truth in zip(tanks.names, tanks.changes, tanks.truth, strict=True):
        for method in methods:
            begin = time.perf_counter()
            if method == "levelset":
                found = fitter.find(change, scale, scale_sigma)
                image, misfit = fitter.image(found, truth.shape), found.misfit
            else:
                made = imager.reconstruct(scale * change, method)
                assert made.structure is not None
                image = on_pixels(imager.description, made.structure, truth.shape)
                misfit = made.misfit
            seconds = time.perf_counter() - begin
            yield TankOutcome(name, method, correlation(image, truth), misfit, seconds, image)


def on_pixels(description: SensorDescription, nodes: Image, shape: tuple[int, ...]) -> FloatArray:
    """A map (nodes_y, nodes_x) on the pixels of a picture; NaN off the disc."""
    radius_m = description.width_m / 2
    rows, columns = shape
    x, y = pixels(rows, columns, radius_m)
    grid = (description.map_y_m, description.map_x_m)
    image = RegularGridInterpolator(grid, nodes)(np.stack([y, x], axis=-1))
    return np.where(np.hypot(x, y) < radius_m, image, np.nan)


def correlation(image: FloatArray, truth: FloatArray) -> float:
    """Pearson correlation over the pixels where the image is known; 0 for an even image."""
    on = np.isfinite(image)
    return measures.correlation(image[on], truth[on])

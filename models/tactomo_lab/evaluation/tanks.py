"""Round tanks with objects in them, and how alike images and truth are.

Measured sets often hold no more than each voltage's change, on some common scale, and the truth
as a picture. The reference is then the model's own empty tank, and the scale is an unknown of
the whole set, found by what the level set can explain, see `estimate_scale`: without a look at
the truth.

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

BUDGET_S = 20.0  # a file has no deadline
EXACT = 10**6  # scans that a reference without noise is the mean of
# Scales that are tried, as shares of the one at which some voltage would have fallen to nothing.
SCALE_SHARES = (0.5, 0.6, 0.72, 0.86, 1.03, 1.24)
AS_WELL = 0.01  # of the misfit's mean logarithm: explained as well as at any scale


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

    def largest_scale(self, changes: FloatArray) -> float:
        """Scale at which some voltage would have fallen to nothing."""
        return float(1 / np.max(-changes / np.abs(self._empty)))

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


def estimate_scale(imager: TankImager, changes: FloatArray) -> float:
    """Common scale of all tanks: the largest at which they are explained as well as at any.

    Metal and plastic conduct so much better or worse than saline that more of it would change
    little. Changes on too small a scale are explained as well, by smaller or weaker objects; on
    too large a scale by none. On simulated tanks of tuning seeds, eight at a time, the rule found
    the true scale within 7 %. `changes` are (n, M).
    """
    largest = imager.largest_scale(changes)
    logs: list[float] = []  # of the misfits; their mean, so that no tank counts more than another
    for share in SCALE_SHARES:
        misfits = [
            imager.reconstruct(share * largest * change, "levelset").misfit for change in changes
        ]
        logs.append(float(np.mean(np.log(misfits))))
    limit = min(logs) + AS_WELL
    last = int(np.flatnonzero(np.array(logs) <= limit)[-1])
    # np.interp stays at the last scale where there is none beyond.
    share = np.exp(np.interp(limit, logs[last : last + 2], np.log(SCALE_SHARES[last : last + 2])))
    return float(largest * share)


def evaluate_tanks(
    imager: TankImager,
    tanks: Tanks,
    methods: Iterable[str],
    scale: float,
) -> Iterator[TankOutcome]:
    """Reconstruct every tank by every method and compare with the truth."""
    for name, change, truth in zip(tanks.names, tanks.changes, tanks.truth, strict=True):
        for method in methods:
            begin = time.perf_counter()
            made = imager.reconstruct(scale * change, method)
            seconds = time.perf_counter() - begin
            assert made.structure is not None
            image = on_pixels(imager.description, made.structure, truth.shape)
            yield TankOutcome(name, method, correlation(image, truth), made.misfit, seconds, image)


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

"""Round tanks with objects in them, measured or simulated, and how alike the images are.

Measured sets often hold no more than each voltage's change, on some common scale, and the truth
as a picture. The reference is then the model's own empty tank, and the scale is an unknown of
the whole set, found by what the level set can explain, see `estimate_scale`: without a look at
the truth.

An image's likeness is its Pearson correlation with the truth over the pixels of the disc, of the
signed `structure` map: 1 in what conducts better than the saline, -1 in what conducts worse; a
linear method's map is in proportion to the conductivity's change.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from tactomo_models.archive import read_arrays
from tactomo_models.artifact import Artifact, load_or_build_artifact
from tactomo_models.description import SensorDescription
from tactomo_models.errors import DataError
from tactomo_models.evaluation.scenes import SeedSet
from tactomo_models.evaluation.simulation import (
    SHARP_M,
    UnevenSheet,
    centroids,
    fine_mesh,
    fitted_mesh,
)
from tactomo_models.forward import ForwardModel
from tactomo_models.mesh import SheetMesh
from tactomo_models.reconstruct import Reconstruction, Reconstructor
from tactomo_models.reference import Reference, noise_of_reciprocity
from tactomo_models.scene import Press
from tactomo_models.tier import Tier

FloatArray = NDArray[np.float64]
Progress = Callable[[int, int], None]

BUDGET_S = 20.0  # a file has no deadline
EXACT = 10**6  # scans that a reference without noise is the mean of
# Scales that are tried, as shares of the one at which some voltage would have fallen to nothing.
SCALE_SHARES = (0.5, 0.6, 0.72, 0.86, 1.03, 1.24)
AS_WELL = 0.01  # of the misfit's mean logarithm: explained as well as at any scale
SIMULATED_ROWS = 128
# Of simulated tanks: as uneven and noisy as the measured ones are by their reciprocity.
UNEVENNESS = 0.03
IMPEDANCE_SPREAD = 0.3
NOISE_SHARE = 0.035  # of a tank's typical voltage change
HALF_AXIS = (0.1, 0.28)  # of an object, over the tank's radius
GAP = 0.07  # least distance of two objects and from the wall, likewise


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
    """What one method made of one tank.

    Attributes:
        name: of the tank.
        method: of reconstruction.
        correlation: with the truth.
        misfit: of the data; NaN where it is not known.
        seconds: compute time.
        image: (rows, columns) the structure map on the truth's pixels; NaN off the disc.
    """

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


def simulated_tanks(description: SensorDescription, seed_set: SeedSet, count: int) -> Tanks:
    """Draw and solve tanks of one to three objects of either kind, on a finer mesh than ours.

    Args:
        description: the tank.
        seed_set: "tuning" for whoever chooses a constant, "reporting" for published figures.
        count: of tanks.
    """
    mesh = fine_mesh(description)
    name = int.from_bytes(hashlib.sha256(f"{seed_set} tanks".encode()).digest()[:8])
    drawn = [_simulated(description, mesh, np.random.default_rng([name, i])) for i in range(count)]
    return Tanks(
        tuple(f"{seed_set} {i}" for i in range(count)),
        np.array([changes for changes, _ in drawn]),
        np.array([truth for _, truth in drawn]),
    )


def _simulated(
    description: SensorDescription, mesh: SheetMesh, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    radius_m = description.width_m / 2
    objects = _drawn_objects(radius_m, rng)
    mesh = fitted_mesh(mesh, [outline for outline, _ in objects], description)
    points, pixels = centroids(mesh), _pixels(SIMULATED_ROWS, SIMULATED_ROWS, radius_m)
    kind, truth = np.zeros(points.shape[1]), np.zeros(pixels[0].shape)
    for outline, sign in objects:
        kind[outline.coverage(points[0], points[1], SHARP_M) > 0.5] = sign
        truth[outline.coverage(*pixels, SHARP_M) > 0.5] = sign
    assert description.structure is not None
    saline = UnevenSheet(description, rng, UNEVENNESS, IMPEDANCE_SPREAD)
    full = np.abs(saline.voltages(mesh, description.structure.saturated_ratio**kind))
    changes = full - np.abs(saline.voltages(mesh))
    noise = NOISE_SHARE * np.sqrt(np.mean(changes**2))
    return changes + noise * rng.standard_normal(len(changes)), truth


def _drawn_objects(radius_m: float, rng: np.random.Generator) -> list[tuple[Press, int]]:
    """Outlines, and 1 or -1 for what conducts better or worse than the saline."""
    placed: list[tuple[Press, int]] = []
    wanted = int(rng.integers(1, 4))
    while len(placed) < wanted:
        long = radius_m * rng.uniform(*HALF_AXIS)
        short = max(long * rng.uniform(0.5, 1), radius_m * HALF_AXIS[0])
        rectangle = bool(rng.integers(2))
        reach = float(np.hypot(long, short)) if rectangle else long
        away = np.sqrt(rng.uniform()) * radius_m
        angle = rng.uniform(0, 2 * np.pi)
        outline = Press(
            away * np.cos(angle),
            away * np.sin(angle),
            1.0,
            long,
            short,
            rng.uniform(0, np.pi),
            "rectangle" if rectangle else "ellipse",
        )
        free = away + reach < radius_m * (1 - GAP) and all(
            np.hypot(outline.x_m - other.x_m, outline.y_m - other.y_m)
            > reach + max(other.radius_m, other.radius_y_m or 0) + GAP * radius_m
            for other, _ in placed
        )
        if free:
            placed.append((outline, int(rng.choice([-1, 1]))))
    return placed


def _pixels(rows: int, columns: int, radius_m: float) -> tuple[FloatArray, FloatArray]:
    """Centres of a picture's pixels, metres; row 0 is the top."""
    x = ((np.arange(columns) + 0.5) / columns * 2 - 1) * radius_m
    y = (1 - (np.arange(rows) + 0.5) / rows * 2) * radius_m
    grid = np.meshgrid(x, y)
    return grid[0], grid[1]


class TankImager:
    """Reconstructs voltage changes against the model's own empty tank.

    Args:
        description: the tank.
        artifact: what is precomputed for it; read or built if None.
    """

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
                self.description, self._artifact, tier=Tier(method), budget_s=BUDGET_S
            )
        reconstructor = self._reconstructors[method]
        scan = self._empty + np.sign(self._empty) * change
        noise = noise_of_reciprocity(self.description, scan - self._empty)
        reconstructor.set_reference(
            Reference(None, self._empty, structure_noise=noise, scans=EXACT)
        )
        return reconstructor.reconstruct(None, scan)


def estimate_scale(
    imager: TankImager, changes: FloatArray, progress: Progress | None = None
) -> float:
    """Common scale of all tanks: the largest at which they are explained as well as at any.

    Metal and plastic conduct so much better or worse than saline that more of it would change
    little. Changes on too small a scale are explained as well, by smaller or weaker objects; on
    too large a scale by none. On simulated tanks of tuning seeds, eight at a time, the rule found
    the true scale within 7 %.

    Args:
        imager: of the tanks.
        changes: (n, M) on one unknown scale.
        progress: called with fits done and fits in all.
    """
    largest = imager.largest_scale(changes)
    logs: list[float] = []  # of the misfits; their mean, so that no tank counts more than another
    for share in SCALE_SHARES:
        misfits = []
        for change in changes:
            misfits.append(imager.reconstruct(share * largest * change, Tier.LEVELSET).misfit)
            if progress:
                progress(len(logs) * len(changes) + len(misfits), len(SCALE_SHARES) * len(changes))
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
    """Reconstruct every tank by every method and compare with the truth.

    Args:
        imager: of the tanks.
        tanks: what to reconstruct.
        methods: of reconstruction.
        scale: of the tanks' changes, see `estimate_scale`.
    """
    for name, change, truth in zip(tanks.names, tanks.changes, tanks.truth, strict=True):
        for method in methods:
            begin = time.perf_counter()
            made = imager.reconstruct(scale * change, method)
            seconds = time.perf_counter() - begin
            assert made.structure is not None
            image = on_pixels(imager.description, made.structure, truth.shape)
            yield TankOutcome(name, method, correlation(image, truth), made.misfit, seconds, image)


def on_pixels(
    description: SensorDescription, nodes: NDArray[np.float32], shape: tuple[int, ...]
) -> FloatArray:
    """A map (nodes_y, nodes_x) on the pixels of a picture; NaN off the disc."""
    radius_m = description.width_m / 2
    rows, columns = shape
    x, y = _pixels(rows, columns, radius_m)
    grid = (description.map_y_m, description.map_x_m)
    image = RegularGridInterpolator(grid, nodes)(np.stack([y, x], axis=-1))
    return np.where(np.hypot(x, y) < radius_m, image, np.nan)


def correlation(image: FloatArray, truth: FloatArray) -> float:
    """Pearson correlation over the pixels where the image is known; 0 for an even image."""
    on = np.isfinite(image)
    if np.ptp(image[on]) == 0 or np.ptp(truth[on]) == 0:
        return 0.0
    return float(np.corrcoef(image[on], truth[on])[0, 1])

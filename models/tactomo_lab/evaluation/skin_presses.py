"""Presses of a robot on a real round skin: how near the linear image comes to where it pressed.

Nobody says how such a skin lies in the robot's frame, nor which way its electrodes run, so an
affine map from image to robot is fitted to some presses and judged on others (cross-validation in
ten folds). Beside it stand what needs no physics: what the presses themselves teach, and the mean
position.

The set's converter turns out to read voltages of one sign only: of a pair that is driven both
ways, each voltage changes with the press in one of the two scans and is noise in the other. Which
sign that is is taken from the training presses, and the other half is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.calibration.press_regression import PressRegression
from tactomo_models.errors import DataError
from tactomo_models.physics.artifact import Artifact, load_or_build_artifact
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.tikhonov import noser_scale, tikhonov_matrix
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.sensor.pattern import scan_positions

from tactomo_lab.evaluation.measured_sets import read_set

METHODS = (
    "mean position (no measurement)",
    "NOSER image",
    "taught by the other presses (no physics)",
)
Estimator = Callable[[IntArray, IntArray], FloatArray]

FOLDS = 10
SEED = 0  # of the folds
WEIGHTS = (0.01, 0.1, 1.0, 10.0, 100.0)  # regularisation over the data's mean power, to choose from
CUT_HEIGHT = 0.5  # of the image's peak, above which the centroid is taken


@dataclass(frozen=True)
class Presses:
    """Robot presses on a skin."""

    # (n, M) voltage changes in the description's order and sign, on one unknown scale
    changes: FloatArray
    positions_m: FloatArray  # (n, 2) where the robot pressed, about the middle of their range


@dataclass(frozen=True)
class Localisation:
    """How far a method's positions are from the robot's, on presses that it was not fitted to."""

    method: str
    errors_m: FloatArray

    @property
    def median_mm(self) -> float:
        """Half of the presses are nearer."""
        return float(np.median(self.errors_m) * 1e3)

    @property
    def most_mm(self) -> float:
        """95 % of the presses are nearer."""
        return float(np.quantile(self.errors_m, 0.95) * 1e3)


def read_presses(path: Path, description: SensorDescription) -> Presses:
    """Read `lookup` (M, 4) source, sink, v+, v-; `dv` (n, M); `pos_m` (n, 2 or 3).

    Raises DataError where the file cannot be read, or its pattern is not the description's.
    """
    arrays = read_set(path, "presses", "lookup", "dv", "pos_m")
    lookup, volts, position = arrays["lookup"].astype(int), arrays["dv"], arrays["pos_m"]
    of_presses = volts.shape == (len(position), len(lookup)) and position.ndim == 2
    if not of_presses or lookup.shape[1:] != (4,):
        raise DataError(
            f"{path}: dv is {volts.shape}, lookup {lookup.shape}, pos_m {position.shape}; (n, M), "
            "(M, 4) and (n, 2) are needed"
        )
    position = position[:, :2]
    order, sign = scan_order(lookup, description)
    changes = np.empty_like(volts)
    changes[:, order] = volts * sign
    middle = (position.max(axis=0) + position.min(axis=0)) / 2
    return Presses(changes, position - middle)


def scan_order(lookup: IntArray, description: SensorDescription) -> tuple[IntArray, FloatArray]:
    """Where each voltage of a lookup (M, 4) is in a scan (M,), and 1 or -1 for its sign (M,).

    Raises DataError where it is not the description's pattern.
    """
    place = scan_positions(description.pairs)
    order, sign = [], []
    for source, sink, plus, minus in lookup.tolist():
        turned = (source, sink, plus, minus) not in place
        key = (source, sink, minus, plus) if turned else (source, sink, plus, minus)
        order.append(place.get(key, -1))
        sign.append(-1.0 if turned else 1.0)
    if sorted(order) != list(range(len(place))):
        raise DataError(
            f"the lookup is not the pattern of {description.name!r} ({description.pattern}): give "
            "another --sensor"
        )
    return np.array(order), np.array(sign)


def localise(presses: Presses, description: SensorDescription) -> Iterator[Localisation]:
    """Locate every press by each of `METHODS`, fitted to the presses of other folds only."""
    imager = _Imager(description, presses, load_or_build_artifact(description))
    positions = presses.positions_m

    def mean(train: IntArray, test: IntArray) -> FloatArray:
        return np.repeat(positions[train].mean(axis=0)[None], len(test), axis=0)

    def taught(train: IntArray, test: IntArray) -> FloatArray:
        learnt = PressRegression(presses.changes[train], positions[train] * 1e3)
        return learnt.locate(presses.changes[test]).xy_mm * 1e-3

    def image(train: IntArray, test: IntArray) -> FloatArray:
        candidates = [imager.affine(weight) for weight in WEIGHTS]
        return _best(candidates, positions, train)(train, test)

    for name, method in zip(METHODS, (mean, image, taught), strict=True):
        yield Localisation(name, _cross_validated(method, positions))


def _folds(presses: IntArray) -> list[IntArray]:
    shuffled = np.random.default_rng(SEED).permutation(presses)
    return [shuffled[fold::FOLDS] for fold in range(FOLDS)]


def _cross_validated(estimate: Estimator, positions: FloatArray) -> FloatArray:
    """Distance (n,) of each press's estimate from its position, by fits to the other folds."""
    everything = np.arange(len(positions))
    errors = np.empty(len(positions))
    for test in _folds(everything):
        train = np.setdiff1d(everything, test)
        errors[test] = np.linalg.norm(estimate(train, test) - positions[test], axis=1)
    return errors


def _best(candidates: list[Estimator], positions: FloatArray, train: IntArray) -> Estimator:
    """The candidate of the least median error on a tenth of the training presses."""
    check = _folds(train)[0]
    rest = np.setdiff1d(train, check)

    def median(estimate: Estimator) -> float:
        off = estimate(rest, check) - positions[check]
        return float(np.median(np.linalg.norm(off, axis=1)))

    return min(candidates, key=median)


class _Imager:
    """Linear images of presses, each located by its centroid; computed once for every setting."""

    def __init__(
        self, description: SensorDescription, presses: Presses, artifact: Artifact
    ) -> None:
        self._presses = presses
        self._bare = artifact.bare
        empty = ForwardModel(description, artifact.bare).bare_voltages
        # Noise of one size in volts on every voltage: the relative Jacobian back in volts.
        self._jacobian = artifact.jacobian * np.abs(empty)[:, None]
        self._positive = empty > 0
        grid = np.meshgrid(description.map_x_m, description.map_y_m)
        self._map_m = np.stack([axis.ravel() for axis in grid], axis=1)
        self._centroids: dict[tuple[bytes, float], FloatArray] = {}

    def affine(self, weight: float) -> Estimator:
        """Positions by an affine map of the images' centroids, of a press that conducts better."""

        def estimate(train: IntArray, test: IntArray) -> FloatArray:
            use = self._responding(train)
            # Which way a press changes the conductivity is learnt, too.
            best = min(
                (self._of(sign, use, weight) for sign in (1.0, -1.0)),
                key=lambda c: _affine(c[train], self._presses.positions_m[train])[1],
            )
            map_, _ = _affine(best[train], self._presses.positions_m[train])
            return np.asarray(np.column_stack([best[test], np.ones(len(test))]) @ map_)

        return estimate

    def _responding(self, train: IntArray) -> BoolArray:
        """Voltages of the sign that changes more in the training presses."""
        size = np.median(np.abs(self._presses.changes[train]), axis=0)
        more = np.median(size[self._positive]) > np.median(size[~self._positive])
        return self._positive if more else ~self._positive

    def _of(self, sign: float, use: BoolArray, weight: float) -> FloatArray:
        key = (use.tobytes(), sign * weight)
        if key not in self._centroids:
            J, even = self._jacobian[use], np.ones(int(use.sum()))
            spread = noser_scale(J, even)
            power = float(np.mean(((J * spread) ** 2).sum(axis=1)))
            matrix = self._bare.map_weights @ tikhonov_matrix(J, even, weight * power, spread)
            images = np.maximum(sign * (self._presses.changes[:, use] @ matrix.T), 0.0)
            peak = images.max(axis=1, keepdims=True)
            inside = np.maximum(images - CUT_HEIGHT * peak, 0.0)
            total = np.maximum(inside.sum(axis=1, keepdims=True), 1e-30)
            self._centroids[key] = inside @ self._map_m / total
        return self._centroids[key]


def _affine(centroids: FloatArray, positions: FloatArray) -> tuple[FloatArray, float]:
    """Affine map (3, 2) from centroids to positions by least squares, and its median error."""
    known = np.column_stack([centroids, np.ones(len(centroids))])
    map_ = np.asarray(np.linalg.lstsq(known, positions, rcond=None)[0], dtype=np.float64)
    return map_, float(np.median(np.linalg.norm(known @ map_ - positions, axis=1)))

"""Presses on real skins: located by physics and by what other presses teach.

*A robot's presses on a round skin*: how near the linear image comes to where it pressed.
Nobody says how such a skin lies in the robot's frame, nor which way its electrodes run, so an
affine map from image to robot is fitted to some presses and judged on others (cross-validation in
ten folds). Beside it stands what needs no physics: what the presses themselves teach.

The set's converter turns out to read voltages of one sign only: of a pair that is driven both
ways, each voltage changes with the press in one of the two scans and is noise in the other. Which
sign that is is taken from the training presses, and the other half is left out.

*Skins of unknown make* are learnt from their first presses and judged on their last. Each skin is
learnt alone, in the order in which it was pressed, so that whatever drifts or wears between
teaching and judging counts as it will on a robot.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.calibration.press_regression import PressRegression
from tactomo_models.errors import DataError
from tactomo_models.physics.artifact import load_or_build_artifact
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.tikhonov import noser_scale, tikhonov_matrix
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.sensor.pattern import scan_positions

from tactomo_lab.evaluation.measured_sets import read_set

Estimator = Callable[[IntArray, IntArray], FloatArray]  # of training and judged presses

IMAGE, TAUGHT = "NOSER image", "taught by the other presses (no physics)"
FOLDS = 10
SEED = 0  # of the folds
# Regularisation over the data's mean power: of 0.01, 0.1, ..., 100 the best on the one public set.
# Chosen in each fold by a tenth of its presses, the median error is 0.1 mm larger.
WEIGHT = 10.0
CUT_HEIGHT = 0.5  # of the image's peak, above which the centroid is taken


@dataclass(frozen=True)
class Presses:
    """Robot presses on a skin."""

    # (n, M) voltage changes in the description's order and sign, on one unknown scale
    changes: FloatArray
    positions_m: FloatArray  # (n, 2) where the robot pressed, about the middle of their range


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
    if not np.isfinite(volts).all() or not np.isfinite(position).all():
        raise DataError(f"{path}: dv or pos_m has values that are no numbers; leave them out")
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


def localise(presses: Presses, description: SensorDescription) -> Iterator[tuple[str, FloatArray]]:
    """Distances (n,) in mm of every press's place as found, by fits to other folds' presses only.

    By the linear image and by what presses teach, each after its name.
    """
    positions, everything = presses.positions_m, np.arange(len(presses.positions_m))
    shuffled = np.random.default_rng(SEED).permutation(everything)

    def taught(train: IntArray, test: IntArray) -> FloatArray:
        learnt = PressRegression(presses.changes[train], positions[train] * 1e3)
        return learnt.locate(presses.changes[test]).xy_mm * 1e-3

    for name, estimate in ((IMAGE, _by_image(presses, description)), (TAUGHT, taught)):
        errors_m = np.empty(len(positions))
        for test in (shuffled[fold::FOLDS] for fold in range(FOLDS)):
            found = estimate(np.setdiff1d(everything, test), test)
            errors_m[test] = np.linalg.norm(found - positions[test], axis=1)
        yield name, errors_m * 1e3


def _by_image(presses: Presses, description: SensorDescription) -> Estimator:
    """Places by an affine map of the linear images' centroids."""
    artifact = load_or_build_artifact(description)
    bare = artifact.bare
    empty = ForwardModel(description, bare).bare_voltages
    # Noise of one size in volts on every voltage: the relative Jacobian back in volts.
    jacobian = artifact.jacobian * np.abs(empty)[:, None]
    grid = np.meshgrid(description.map_x_m, description.map_y_m)
    map_m = np.stack([axis.ravel() for axis in grid], axis=1)

    @cache
    def centroids(voltages: float, press: float) -> FloatArray:
        """Places (n, 3) of images by voltages of one sign, and of presses of one; 1 at the end."""
        use = voltages * empty > 0
        J, even = jacobian[use], np.ones(int(use.sum()))
        spread = noser_scale(J, even)
        power = float(np.mean(((J * spread) ** 2).sum(axis=1)))
        matrix = bare.map_weights @ tikhonov_matrix(J, even, WEIGHT * power, spread)
        images = np.maximum(press * (presses.changes[:, use] @ matrix.T), 0.0)
        inside = np.maximum(images - CUT_HEIGHT * images.max(axis=1, keepdims=True), 0.0)
        total = np.maximum(inside.sum(axis=1, keepdims=True), 1e-30)
        return np.column_stack([inside @ map_m / total, np.ones(len(images))])

    def estimate(train: IntArray, test: IntArray) -> FloatArray:
        size, true = np.median(np.abs(presses.changes[train]), axis=0), presses.positions_m[train]
        voltages = 1.0 if np.median(size[empty > 0]) > np.median(size[empty < 0]) else -1.0
        fits = []
        for press in (1.0, -1.0):  # which way a press changes the conductivity is learnt, too
            known = centroids(voltages, press)
            map_ = np.linalg.lstsq(known[train], true, rcond=None)[0]
            off = np.median(np.linalg.norm(known[train] @ map_ - true, axis=1))
            fits.append((off, known[test] @ map_))
        return np.asarray(min(fits, key=lambda fit: fit[0])[1])

    return estimate


JUDGED: Final = 800  # of the last presses; half of those not learnt from, where they are fewer
SINCE: Final = 4  # parts of all later presses, to see errors grow


@dataclass(frozen=True)
class SkinPresses:
    """One skin's presses in order: voltage changes (P, M) and places (P, 2) in mm."""

    name: str
    changes: FloatArray
    xy_mm: FloatArray


@dataclass(frozen=True)
class Judgement:
    """How far presses were located from where they were."""

    name: str  # of the skin
    train: int  # presses learnt from
    judged: int  # presses judged
    # median_mm, p95_mm: distances that half and 95 % of them are within
    median_mm: float
    p95_mm: float
    # share of coordinates within one standard uncertainty; 0.68 where that holds
    within_sigma: float
    is_taught: float  # share of presses of which the like was taught
    median_mm_since: tuple[float, ...]  # medians of the quarters of all later presses, in order


def read_skins(path: Path) -> list[SkinPresses]:
    """Read `NAME_voltages` (P, M) and `NAME_xy_mm` (P, 2) of each skin.

    Raises DataError where the file cannot be read, or holds no such skin.
    """
    arrays = read_set(path, "presses")
    names = [key.removesuffix("_voltages") for key in arrays if key.endswith("_voltages")]
    if not names:
        raise DataError(
            f"{path} is no set of presses: NAME_voltages (P, M) and NAME_xy_mm (P, 2) are needed "
            f"for each skin; it holds: {', '.join(arrays) or 'nothing'}"
        )
    return [_skin(path, name, arrays) for name in names]


def _skin(path: Path, name: str, arrays: Mapping[str, Any]) -> SkinPresses:
    if f"{name}_xy_mm" not in arrays:
        raise DataError(f"{path} has {name}_voltages but no {name}_xy_mm: add where it was pressed")
    changes, xy_mm = arrays[f"{name}_voltages"], arrays[f"{name}_xy_mm"]
    are_numbers = {changes.dtype.kind, xy_mm.dtype.kind} <= set("fiu")
    if not are_numbers or changes.ndim != 2 or xy_mm.shape != (len(changes), 2):
        raise DataError(
            f"{path}: {name}_voltages is {changes.dtype} {changes.shape}, {name}_xy_mm "
            f"{xy_mm.dtype} {xy_mm.shape}; real numbers (P, M) and (P, 2) are needed"
        )
    return SkinPresses(name, changes.astype(np.float64), xy_mm.astype(np.float64))


def judge(skins: list[SkinPresses], train: int) -> Iterator[Judgement]:
    """Learn from the first presses of each skin, and judge on the last.

    Raises DataError where a skin has too few presses, or presses that cannot be learnt from.
    """
    for skin in skins:
        rest = len(skin.xy_mm) - train
        if rest < SINCE:
            raise DataError(
                f"{skin.name} has {len(skin.xy_mm)} presses, which leaves {max(rest, 0)} to judge "
                f"on; give --train {len(skin.xy_mm) // 2} or less"
            )
        try:
            learnt = PressRegression(skin.changes[:train], skin.xy_mm[:train])
            found = learnt.locate(skin.changes[train:])
        except DataError as error:
            raise DataError(f"{skin.name}: {error}") from error
        off_mm = found.xy_mm - skin.xy_mm[train:]
        errors_mm = np.linalg.norm(off_mm, axis=1)
        judged = JUDGED if rest >= JUDGED else rest // 2
        last = slice(-judged, None)
        yield Judgement(
            skin.name,
            train,
            judged,
            float(np.median(errors_mm[last])),
            float(np.quantile(errors_mm[last], 0.95)),
            float((np.abs(off_mm) <= found.sigma_mm[:, None])[last].mean()),
            float(found.is_taught[last].mean()),
            tuple(float(np.median(part)) for part in np.array_split(errors_mm, SINCE)),
        )

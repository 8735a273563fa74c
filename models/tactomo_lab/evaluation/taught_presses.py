"""Presses on skins of unknown make: learnt from the first, judged on the last of each skin.

Each skin is learnt alone, in the order in which it was pressed, so that whatever drifts or wears
between teaching and judging counts as it will on a robot.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.calibration.press_regression import PressRegression
from tactomo_models.errors import DataError

from tactomo_lab.evaluation.measured_sets import read_set

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

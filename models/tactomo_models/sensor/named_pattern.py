"""Patterns by name, such as `32:adjacent` or `16:opposite:adjacent`: what a file does not say.

ELECTRODES:DRIVE[:MEASURE][:rotated], where DRIVE and MEASURE (DRIVE's, if left out) are *adjacent*,
*opposite*, or how many electrodes further round the other electrode of a pair is. Each drive's
measuring pairs ascend from 0 or, *rotated*, from the drive's own (EIDORS calls it rotate_meas).
"""

from __future__ import annotations

from itertools import product
from typing import Final, NamedTuple, Self

import numpy as np
from pydantic import ValidationError

from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.errors import DataError, DescriptionError, explain
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.sensor.pattern import PatternLayout, reciprocal_pairs, scan_pairs

ROTATED: Final = "rotated"
MIN_ELECTRODES: Final = 6
MAX_ELECTRODES: Final = 64  # of a description, likewise
MAX_ASYMMETRY: Final = 0.2
"""Difference of reciprocal voltages over their size, rms, that a device which serves is below."""
BEST: Final = 2.0
"""Times the least difference, within which others count as fitting. On a simulated tank with 2 %
noise the true offset leaves 0.02, the next one 0.10 (32 electrodes) to 0.14 (16)."""


class NamedPattern(NamedTuple):
    """Electrodes in a ring, and by how many the two of a pair are apart."""

    electrodes: int
    drive: int
    measure: int
    rotated: bool = False

    @classmethod
    def of_name(cls, name: str) -> Self:
        """Read a pattern's name.

        Raises DataError where it is none.
        """
        count, *offsets = name.lower().split(":")
        rotated = offsets[-1:] == [ROTATED]
        try:
            electrodes = int(count)
            words = {"adjacent": 1, "opposite": electrodes // 2}
            told = [words.get(o) or int(o) for o in (offsets[:-1] if rotated else offsets)]
            drive, measure = told if len(told) == 2 else told * 2
            if not MIN_ELECTRODES <= electrodes <= MAX_ELECTRODES:
                raise ValueError
            if not 0 < min(drive, measure) <= max(drive, measure) <= electrodes // 2:
                raise ValueError
        except ValueError:
            raise DataError(
                f"{name!r} is no pattern; give ELECTRODES:DRIVE or ELECTRODES:DRIVE:MEASURE, such "
                "as 16:adjacent, 16:opposite:adjacent or 32:5:5, and :rotated behind it where "
                "measuring pairs begin at the drive's"
            ) from None
        return cls(electrodes, drive, measure, rotated)

    def __str__(self) -> str:
        """The name."""
        words = {self.electrodes // 2: "opposite", 1: "adjacent"}
        pairs = [self.drive] if self.drive == self.measure else [self.drive, self.measure]
        parts = [words.get(offset, str(offset)) for offset in pairs]
        return ":".join([str(self.electrodes), *parts, *([ROTATED] if self.rotated else [])])

    @property
    def layout(self) -> PatternLayout:
        """Which electrodes each voltage is of, measuring pairs ascending."""
        return PatternLayout(scan_pairs(*self[:3]), self.electrodes)

    @property
    def order(self) -> IntArray:
        """Where a file has each voltage of the layout, (M,)."""
        pairs = self.layout.pairs
        drive, measure = pairs.drive[:, 0], pairs.measure[:, 0]
        key = (measure - drive) % self.electrodes if self.rotated else measure
        return np.argsort(np.lexsort((key, drive)))

    def applied(self, description: SensorDescription) -> SensorDescription:
        """The sensor with this pattern; other electrodes cover the share of the rim that its do.

        Raises DescriptionError where there can be no such sensor.
        """
        raw = description.model_dump(by_alias=True, exclude_none=True)
        now, electrodes = description.electrode_count, raw["electrodes"]
        if now != self.electrodes:
            if description.electrodes.count is None:
                raise DescriptionError(
                    f"{description.name!r} has {now} electrodes, and the pattern has "
                    f"{self.electrodes}; give --description with as many, or that of a disc"
                )
            electrodes["count"] = self.electrodes
            electrodes["length_m"] *= now / self.electrodes
        raw["pattern"] = {
            "current_a": description.pattern.current_a,
            "drive_offset": self.drive,
            "measure_offset": self.measure,
        }
        try:
            return SensorDescription.model_validate(raw)
        except ValidationError as error:
            why = explain(error.errors()[0])
            raise DescriptionError(f"{description.name!r} with {self}: {why}") from error


@np.errstate(over="ignore", invalid="ignore")  # no pattern fits zeros, or what is beyond numbers
def fitting_patterns(scans: FloatArray) -> list[NamedPattern]:
    """Patterns that scans (T, M) may have, by their count and zeros, and then by reciprocity.

    Where drive and measuring pairs differ no voltages are reciprocal, so that nothing but the count
    is known: the usual *opposite:adjacent* alone is named.
    """
    count = scans.shape[1]
    root = round(np.sqrt(count))
    zero = (scans == 0).all(axis=0)
    if root * root == count and zero.any():
        return _patterns_of_zeros(zero.reshape(root, root))
    mean = scans.mean(axis=0)
    tried, other = [], []
    for electrodes in range(MIN_ELECTRODES, MAX_ELECTRODES + 1):
        half = electrodes // 2
        if electrodes * (electrodes - 4) == count and electrodes % 2 == 0:
            other.append(NamedPattern(electrodes, half, 1))
        for offset in range(1, half + 1):
            kept = electrodes - (2 if 2 * offset == electrodes else 3)
            if electrodes * kept != count:
                continue
            for rotated in (False, True):
                named = NamedPattern(electrodes, offset, offset, rotated)
                first, second = mean[named.order[reciprocal_pairs(named.layout.pairs).T]]
                asymmetry = np.linalg.norm(first - second) / np.linalg.norm([first, second])
                if asymmetry < MAX_ASYMMETRY:
                    tried.append((float(asymmetry), named))
    least = min((asymmetry for asymmetry, _ in tried), default=0.0)
    return [named for asymmetry, named in tried if asymmetry <= BEST * least] + other


def _patterns_of_zeros(zero: BoolArray) -> list[NamedPattern]:
    """The pattern of a device that reads every measuring pair in every drive; none if unclear.

    `zero` (drives, pairs) is where a pair touches a driven electrode: where the pair's number less
    the drive's is 0, the drive offset, minus the measuring offset, or their difference.
    """
    drives = np.arange(count := len(zero))
    always = {n for n in range(count) if zero[drives, (drives + n) % count].all()}
    fits = [
        NamedPattern(count, drive, measure)
        for drive, measure in product(range(1, count // 2 + 1), repeat=2)
        if {0, drive, -measure % count, (drive - measure) % count} == always
    ]
    return fits if len(fits) == 1 else []

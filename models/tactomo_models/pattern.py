"""Which electrodes drive and which measure: the order of the voltages in a scan."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Pairs:
    """Electrodes of every voltage of a scan, in order.

    Attributes:
        drive: (M, 2) electrodes that the current enters and leaves by.
        measure: (M, 2) electrodes whose potential difference, first minus second, is read.
    """

    drive: NDArray[np.intp]
    measure: NDArray[np.intp]


def scan_pairs(electrodes: int, drive_offset: int = 1, measure_offset: int = 1) -> Pairs:
    """List the pairs drive-major, measuring pairs ascending, none that touches a driven electrode.

    With both offsets at 1 and 16 electrodes these are the 208 voltages of adjacent drive and
    adjacent measurement, in the order that EIDORS and pyEIT use.
    """
    return combined(ring_pairs(electrodes, drive_offset), ring_pairs(electrodes, measure_offset))


def ring_pairs(electrodes: int, offset: int) -> NDArray[np.intp]:
    """Every electrode with the one `offset` further round, (electrodes, 2)."""
    first = np.arange(electrodes)
    return np.stack([first, (first + offset) % electrodes], axis=1)


def combined(drive: NDArray[np.intp], measure: NDArray[np.intp]) -> Pairs:
    """Every drive pair (D, 2) with every measuring pair (K, 2) that does not touch it."""
    drive, measure = np.repeat(drive, len(measure), axis=0), np.tile(measure, (len(drive), 1))
    apart = ~touching(drive, measure)
    return Pairs(drive[apart], measure[apart])


def touching(drive: NDArray[np.intp], measure: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Tell which of the pairs (n, 2) and (n, 2) share an electrode, (n,)."""
    return np.asarray((drive[:, :, None] == measure[:, None, :]).any(axis=(1, 2)))


def reciprocal_pairs(pairs: Pairs) -> NDArray[np.intp]:
    """Positions (n, 2) in a scan of voltages that are the same but for noise: V(k, m) = V(m, k)."""
    order = {
        (*drive, *measure): index
        for index, (drive, measure) in enumerate(
            zip(pairs.drive.tolist(), pairs.measure.tolist(), strict=True)
        )
    }
    found = [(i, order[k[2:] + k[:2]]) for k, i in order.items() if k[2:] + k[:2] in order]
    return np.array([(i, j) for i, j in found if i < j], dtype=np.intp).reshape(-1, 2)

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
    k, m = np.divmod(np.arange(electrodes * electrodes), electrodes)
    drive = np.stack([k, (k + drive_offset) % electrodes], axis=1)
    measure = np.stack([m, (m + measure_offset) % electrodes], axis=1)
    apart = ~(drive[:, :, None] == measure[:, None, :]).any(axis=(1, 2))
    return Pairs(drive[apart], measure[apart])


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

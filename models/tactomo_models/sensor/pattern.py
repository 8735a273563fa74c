"""Which electrodes drive and which measure: the order of the voltages in a scan."""

from dataclasses import dataclass

import numpy as np

from tactomo_models.arrays import BoolArray, IntArray


@dataclass(frozen=True)
class Pairs:
    """Electrodes of every voltage of a scan, in order."""

    drive: IntArray  # (M, 2) electrodes that the current enters and leaves by
    measure: IntArray  # (M, 2) electrodes whose potential difference, first minus second, is read


def scan_pairs(electrodes: int, drive_offset: int = 1, measure_offset: int = 1) -> Pairs:
    """List the pairs drive-major, measuring pairs ascending, none that touches a driven electrode.

    With both offsets at 1 and 16 electrodes these are the 208 voltages of adjacent drive and
    adjacent measurement, in the order that EIDORS and pyEIT use.
    """
    return combined(ring_pairs(electrodes, drive_offset), ring_pairs(electrodes, measure_offset))


def ring_pairs(electrodes: int, offset: int) -> IntArray:
    """Every electrode with the one `offset` further round, (electrodes, 2)."""
    first = np.arange(electrodes)
    return np.stack([first, (first + offset) % electrodes], axis=1)


def combined(drive: IntArray, measure: IntArray) -> Pairs:
    """Every drive pair (D, 2) with every measuring pair (K, 2) that does not touch it."""
    drive, measure = np.repeat(drive, len(measure), axis=0), np.tile(measure, (len(drive), 1))
    apart = ~touching(drive, measure)
    return Pairs(drive[apart], measure[apart])


def touching(drive: IntArray, measure: IntArray) -> BoolArray:
    """Tell which of the pairs (n, 2) and (n, 2) share an electrode, (n,)."""
    return np.asarray((drive[:, :, None] == measure[:, None, :]).any(axis=(1, 2)))


def rim_signs(pairs: Pairs, rim_order: IntArray) -> IntArray:
    """Signs (M,) of a sheet's voltages, 0 where pairs cross or an electrode is off the outer rim.

    Potential falls along the rim from the source to the sink, whichever way one goes.
    """
    ends = rim_order[np.hstack([pairs.drive, pairs.measure])]
    source, *others = ends.T
    on_rim = max(np.count_nonzero(rim_order >= 0), 1)
    sink, plus, minus = ((end - source) % on_rim for end in others)
    one_way = (plus <= sink) & (minus <= sink)
    other_way = (plus >= sink) & (minus >= sink)
    signs = np.sign(minus - plus) * (one_way.astype(int) - other_way)
    return np.where((ends >= 0).all(axis=1), signs, 0)


def scan_positions(pairs: Pairs) -> dict[tuple[int, ...], int]:
    """Position in a scan of each voltage by its electrodes: source, sink, plus, minus."""
    rows = np.hstack([pairs.drive, pairs.measure]).tolist()
    return {tuple(electrodes): position for position, electrodes in enumerate(rows)}


def reciprocal_pairs(pairs: Pairs) -> IntArray:
    """Positions (n, 2) in a scan of voltages that are the same but for noise: V(k, m) = V(m, k)."""
    order = scan_positions(pairs)
    found = [(i, order[k[2:] + k[:2]]) for k, i in order.items() if k[2:] + k[:2] in order]
    return np.array([(i, j) for i, j in found if i < j], dtype=np.intp).reshape(-1, 2)


@dataclass(frozen=True)
class PatternLayout:
    """A pattern without a sheet: for devices of which no description is at hand."""

    pairs: Pairs
    electrode_count: int

    @property
    def rim_order(self) -> IntArray:
        """The electrodes are numbered round the rim."""
        return np.arange(self.electrode_count)

"""What a scan repeats of earlier ones: that was not measured.

Noise makes every scan another one. Where the scans of a tare had noise, a scan that is an earlier
one over again says what the skin was at another time. That holds of a whole channel, and of all
that one drive or one measuring pair reads in it: a multiplexer sticks, or one converter of many
does. A whole channel need not repeat bit for bit, nor its last scan: a last bit flickers, and
firmware sends its buffers round and round.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.scans.frame_noise import FALSE_ALARM
from tactomo_models.scans.reference import Reference
from tactomo_models.sensor.pattern import Pairs

MIN_NOISE: Final = 0.1
"""Share of the tare's noise that a converter at work has at least: what is left by the mean of a
hundred scans. A flicker of one count is told where the tare's noise is 8 counts or more."""
EARLIER: Final = 16
"""Scans that one is held against: a longer round of buffers is not told."""


class Repeated(NamedTuple):
    """What a scan repeats."""

    parts: tuple[str, ...]  # in words: drives and measuring pairs; none where all is repeated
    voltages: BoolArray  # (M,)
    # whether it differs from every earlier scan by more than a last bit: noise that has fallen, if
    # somebody says so by a tare
    is_another: bool = False

    def without(self, scan: FloatArray) -> FloatArray | None:
        """What was measured of the scan (M,), NaN elsewhere; None where all is repeated."""
        return None if self.voltages.all() else np.where(self.voltages, np.nan, scan)


class Repeats:
    """Finds what scans of one sensor's pattern repeat, one after another."""

    def __init__(self, pairs: Pairs) -> None:
        parts = {
            f"{what} {first}-{second}": (ends == (first, second)).all(axis=1)
            for what, ends in (("drive", pairs.drive), ("measuring pair", pairs.measure))
            for first, second in np.unique(ends, axis=0).tolist()
        }
        self._names, self._parts = np.array(list(parts)), np.array(list(parts.values()))
        self._sizes = self._parts.sum(axis=1)
        self._smallest = int(self._sizes.min())
        self._earlier: dict[Channel, FloatArray] = {}  # (n, M) scans of each, the last one last

    def forget(self) -> None:
        """Take the next scans for the first ones: they may be the same again, as of a replay."""
        self._earlier.clear()

    def find(
        self, channel: Channel, scan: FloatArray, reference: Reference | None
    ) -> Repeated | None:
        """What a scan (M,) repeats: all of an earlier one, or drives and pairs of the last one.

        Coarse counts repeat by chance: as often as those beside the drives and pairs in question.
        None where nothing can be told: of the first scan, and of those without noise at the tare.
        """
        earlier = self._earlier.get(channel, np.empty((0, len(scan))))
        self._earlier[channel] = np.concatenate([earlier[1 - EARLIER :], scan[None]])
        noise: Any = getattr(reference, f"{channel}_noise", None)
        if not len(earlier) or not _is_noisy(reference, noise, scan):
            return None
        told = np.isfinite(scan) & (noise > 0) & (noise < np.inf)
        with np.errstate(all="ignore"):
            changes = np.where(told, (scan - earlier) / noise, 0.0)
            squares = (changes * changes).sum(axis=1)
        if (squares < 2 * MIN_NOISE**2 * np.count_nonzero(told)).any():
            apart = np.abs(scan - earlier)
            last_bit = apart.min(initial=np.inf, where=apart > 0)
            is_another = bool(np.median(apart, axis=1).min() > 1.5 * last_bit)
            return Repeated((), np.ones(len(scan), bool), is_another)
        same = scan == earlier[-1]
        if np.count_nonzero(same) < self._smallest:
            return Repeated((), np.zeros(len(scan), bool))
        whole = self._parts @ same.astype(int) == self._sizes
        others = same[~self._parts[whole].any(axis=0)]
        by_chance = (np.count_nonzero(others) + 1) / (len(others) + 2)
        whole &= by_chance**self._sizes < FALSE_ALARM
        return Repeated(tuple(self._names[whole].tolist()), self._parts[whole].any(axis=0))


def _is_noisy(reference: Reference | None, noise: FloatArray | None, scan: FloatArray) -> bool:
    """Whether scans at rest differed in most voltages, by more than a mean of equals rounds."""
    if reference is None or not reference.is_noise_measured or noise is None:
        return False
    differs = bool(2 * np.count_nonzero(noise) > len(noise))
    return differs and bool((noise > 1e-12 * np.abs(scan)).any())

"""What a scan repeats of the last one, bit for bit: that was not measured.

Noise makes every scan another one. Where the scans of a tare had noise, what is the last scan over
again says what the skin was at another time. That holds of a whole channel, and of all that one
drive or one measuring pair reads in it: a multiplexer sticks, or one converter of many does.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.scans.frame_noise import FALSE_ALARM
from tactomo_models.scans.reference import Reference
from tactomo_models.sensor.pattern import Pairs


class Repeated(NamedTuple):
    """What a scan repeats."""

    parts: tuple[str, ...]  # in words: drives and measuring pairs; none where all is repeated
    voltages: BoolArray  # (M,)


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
        self._last: dict[Channel, FloatArray] = {}

    def find(
        self, channel: Channel, scan: FloatArray, reference: Reference | None
    ) -> Repeated | None:
        """What a scan (M,) repeats of its channel's last one: all of it, or drives and pairs.

        Coarse counts repeat by chance: as often as those beside the drives and pairs in question.
        None where nothing can be told: of the first scan, and of those without noise at the tare.
        """
        last, self._last[channel] = self._last.get(channel), scan
        if last is None or not _is_noisy(reference, channel, scan):
            return None
        same = scan == last
        if same.all():
            return Repeated((), same)
        whole = self._parts @ same.astype(int) == self._sizes
        others = same[~self._parts[whole].any(axis=0)]
        by_chance = (np.count_nonzero(others) + 1) / (len(others) + 2)
        whole &= by_chance**self._sizes < FALSE_ALARM
        return Repeated(tuple(self._names[whole].tolist()), self._parts[whole].any(axis=0))


def _is_noisy(reference: Reference | None, channel: Channel, scan: FloatArray) -> bool:
    """Whether scans at rest differed in most voltages, by more than a mean of equals rounds."""
    noise: Any = getattr(reference, f"{channel}_noise", None)
    if reference is None or not reference.is_noise_measured or noise is None:
        return False
    differs = bool(2 * np.count_nonzero(noise) > len(noise))
    return differs and bool(np.any(noise > 1e-12 * np.abs(scan)))

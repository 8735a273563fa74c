"""Which contact is which: identities over time."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from math import dist
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import min_weight_full_bipartite_matching

from tactomo_models.arrays import FloatArray

FARTHEST_STEP_M = 0.025  # a contact that moved more than this between frames is a new one
MAX_MISSED = 5  # frames that a contact may be gone and still be the same when it comes back
GROWN = 1.5  # times its area: a contact that grew so much may be two; merged ones grow by 2 to 7
LANDING = 5  # frames in which one lands: 0.25 s at 20 frames/s
MAX_MERGED = 10  # frames until what has grown is one contact: twice what a fit takes to tell two


class _Seen(NamedTuple):
    """One sight of a contact."""

    centre_m: FloatArray
    area_m2: float


@dataclass
class _Track:
    """One identity."""

    id: int  # counted up from 1
    last: _Seen  # its last sight
    # the last `LANDING` sights of it; while it is grown, those before it grew
    before: deque[_Seen] = field(default_factory=lambda: deque(maxlen=LANDING))
    grown: int = 0  # frames for which it has been larger than it was in `before`
    missed: int = 0  # frames since it was last seen

    def see(self, seen: _Seen) -> None:
        """Follow it to where it is now."""
        is_grown = bool(self.before) and seen.area_m2 > GROWN * self.before[0].area_m2
        self.grown = self.grown + 1 if is_grown else 0
        if self.grown > MAX_MERGED:
            self.before.clear()
            self.grown = 0
        if not self.grown:
            self.before.append(seen)
        self.last, self.missed = seen, 0

    def distances_m(self, centres_m: FloatArray) -> list[float]:
        """How far contacts (K, 2) are from where it is, or was before it grew: the nearer."""
        places = [self.last.centre_m, *(seen.centre_m for seen in self.before if self.grown)]
        return [min(dist(place, centre_m) for place in places) for centre_m in centres_m]


class ContactTracker:
    """Gives contacts an identity over time: the assignment that moves them least.

    Rules that a controller can rely on:

    - A contact keeps its identity while it moves less than 25 mm from one frame to the next.
    - It keeps it through a gap: what comes back within 5 frames and 25 mm is the same contact, not
      a new one. So a frame that misses a contact costs nothing.
    - Where two contacts merge, the one whose centre is nearer to that of both together lives on;
      if they part again within 5 frames, each has its own identity back.
    - Where a contact lands beside another and both are first seen as one, the identity is, once
      they are told apart within 10 frames, that of the contact that was there before.
    - An identity that is gone for longer is never used again.
    """

    def __init__(self) -> None:
        self._tracks: list[_Track] = []
        self._next = 1

    @property
    def ids(self) -> tuple[int, ...]:
        """Identities that are followed, those that were missed lately among them."""
        return tuple(track.id for track in self._tracks)

    def update(self, centres_m: FloatArray, areas_m2: FloatArray) -> list[int]:
        """Identities of the contacts at `centres_m` (K, 2) of `areas_m2` (K,) in the next frame."""
        tracks = self._tracks
        distance = np.array([track.distances_m(centres_m) for track in tracks])
        distance = distance.reshape(len(tracks), len(centres_m))
        # Too far costs alike: such a pair is made only where nothing better is left, and dropped.
        # What has been missed comes second to what was there.
        cost = np.minimum(distance, FARTHEST_STEP_M)
        cost += FARTHEST_STEP_M * np.array([[track.missed > 0] for track in tracks]).reshape(-1, 1)
        owner = {
            new: tracks[old]
            for old, new in zip(*_cheapest(cost), strict=True)
            if distance[old, new] < FARTHEST_STEP_M
        }
        for track in tracks:
            track.missed += 1
        ids = []
        for index, (centre_m, area_m2) in enumerate(zip(centres_m, areas_m2, strict=True)):
            seen = _Seen(centre_m, float(area_m2))
            if index not in owner:
                owner[index] = _Track(self._next, seen)
                self._next += 1
            owner[index].see(seen)
            ids.append(owner[index].id)
        lost = [track for track in tracks if 0 < track.missed <= MAX_MISSED]
        self._tracks = [*(owner[index] for index in range(len(ids))), *lost]
        return ids

    def clear(self) -> None:
        """Forget all contacts; identities are not used again."""
        self._tracks = []


def _cheapest(cost: FloatArray) -> tuple[Iterable[int], Iterable[int]]:
    """Rows and columns of the assignment that costs least: a pair for each of the fewer.

    By SciPy's graphs where two want the same: its `optimize` would take 10 MB.
    """
    if cost.shape[0] > cost.shape[1]:
        columns, rows = _cheapest(cost.T)
        return rows, columns
    wanted = cost.argmin(axis=1) if cost.size else np.zeros(0, np.intp)
    if len(set(wanted)) == len(wanted):
        return range(len(wanted)), wanted
    rows, columns = min_weight_full_bipartite_matching(csr_array(1 + cost))  # a 0 would be no pair
    return rows, columns

"""Which contact is which: identities over time."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from tactomo_models.arrays import FloatArray

FARTHEST_STEP_M = 0.025  # a contact that moved more than this between frames is a new one
MAX_MISSED = 5  # frames that a contact may be gone and still be the same when it comes back


class ContactTracker:
    """Gives contacts an identity over time: the assignment that moves them least.

    Rules that a controller can rely on:

    - A contact keeps its identity while it moves less than 25 mm from one frame to the next.
    - It keeps it through a gap: what comes back within 5 frames and 25 mm is the same contact, not
      a new one. So a frame that misses a contact costs nothing.
    - Where two contacts merge, the one whose centre is nearer to that of both together lives on;
      if they part again within 5 frames, each has its own identity back.
    - An identity that is gone for longer is never used again.
    """

    def __init__(self) -> None:
        self._centres = np.zeros((0, 2))
        self._ids: list[int] = []
        self._missed: list[int] = []  # frames since each was last seen
        self._next = 1

    def update(self, centres_m: FloatArray) -> list[int]:
        """Identities of the contacts at `centres_m` (K, 2) in the next frame."""
        ids = [0] * len(centres_m)
        distance = np.linalg.norm(self._centres[:, None] - centres_m[None], axis=2)
        # Too far costs alike: such a pair is made only where nothing better is left, and dropped.
        # What has been missed comes second to what was there.
        cost = np.minimum(distance, FARTHEST_STEP_M)
        cost += np.where(np.array(self._missed, int) > 0, FARTHEST_STEP_M, 0.0)[:, None]
        found = set()
        for old, new in zip(*linear_sum_assignment(cost), strict=True):
            if distance[old, new] < FARTHEST_STEP_M:
                ids[new] = self._ids[old]
                found.add(old)
        for index, known in enumerate(ids):
            if not known:
                ids[index] = self._next
                self._next += 1
        kept = [
            old
            for old in range(len(self._ids))
            if old not in found and self._missed[old] < MAX_MISSED
        ]
        self._missed = [0] * len(ids) + [self._missed[old] + 1 for old in kept]
        self._centres = np.vstack([centres_m, self._centres[kept]])
        self._ids = ids + [self._ids[old] for old in kept]
        return ids

    def clear(self) -> None:
        """Forget all contacts; identities are not used again."""
        self._centres, self._ids, self._missed = np.zeros((0, 2)), [], []

"""Whether two scans are of one scene: whether they differ by noise alone.

Whatever moves on a sheet moves its voltages along few directions: those that its conductivity can
move at all (the Jacobian's leading singular vectors, 40 or 50 of 208). Noise moves all of them
alike. So the difference of two scans tells how noisy both are, by the directions that no
conductivity explains, and whether something moved, by the others (an F test). Neither a tare of a
single scan nor a device that breaks reciprocity by the same share in every scan can make a moving
scene look still: no noise is taken from them but as an upper bound. What changes by less than a
frame's noise shows in a mean of the frames that came since (`Since`).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np
from scipy.special import chdtri, fdtri
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.scans.changes import Changes

FALSE_ALARM = 1e-4  # chance that a still frame is solved again, which costs a few solves
MEMORY = 5  # frames of a mean; a longer one sees a small change later, and no more of them


def is_still(
    settled: Changes,  # changes of one channel's scan, which a solution is of
    new: Changes,  # changes of a later scan of the same channel since the same tare
) -> bool:
    """Tell whether a scan is of the same scene as the one that was settled on.

    Changes that are far below the model's own error (`Changes.tolerance`) count as still.
    """
    valid = (settled.weight > 0) & (new.weight > 0)
    sigma = np.sqrt(new.noise_variance)
    difference = np.where(valid, (new.change - settled.change) / sigma, 0.0)
    along = difference @ new.modes
    smooth, total = float(along @ along), float(difference @ difference)
    modes, others = len(along), max(int(np.count_nonzero(valid)) - len(along), 1)
    # Where the difference is large, curvature leaves some of it in the other directions, too.
    noise = min((total - smooth) / others, 2.0)
    tolerated = 2 * float((new.tolerance / new.noise_variance)[valid].sum())
    return smooth <= _noise_limit(modes, others) * modes * noise + tolerated


def are_still(settled: Mapping[Channel, Changes], new: Mapping[Channel, Changes]) -> bool:
    """Tell whether scans of all channels are of the same scene; not if their channels differ."""
    return new.keys() == settled.keys() and all(
        is_still(settled[name], changes) for name, changes in new.items()
    )


class Since:
    """What has come since a fit: whether its parameters would follow the mean of it.

    To first order they would, by what the fit's Jacobian makes of the mean difference. Noise alone
    makes a chi-squared of it, with one degree of freedom for each parameter.

    Args:
        settled: the frame that was fitted.
        jacobian: (sum M, N) of its weighted residual.
        precision: (N,) inverse variances of the prior.
    """

    def __init__(
        self, settled: Mapping[Channel, Changes], jacobian: FloatArray, precision: FloatArray
    ) -> None:
        normal = jacobian.T @ jacobian + np.diag(precision)
        self._settled = settled
        self._follow = np.linalg.solve(np.linalg.cholesky(normal), jacobian.T)  # (N, sum M)
        self._mean, self._count = np.zeros(len(precision)), 0
        self._limit = float(chdtri(len(precision), FALSE_ALARM))

    def shows_change(self, new: Mapping[Channel, Changes]) -> bool:
        """Take in one frame more of the same channels, and tell whether something has changed."""
        off = [
            old.weight * (new[name].change - old.change) * (new[name].weight > 0)
            for name, old in self._settled.items()
        ]
        self._count = min(self._count + 1, MEMORY)
        self._mean += (self._follow @ np.concatenate(off) - self._mean) / self._count
        return bool(self._mean @ self._mean > self._limit * (1 + 1 / self._count))


@cache
def _noise_limit(modes: int, others: int) -> float:
    """Ratio of two variances of so many degrees of freedom that noise stays below."""
    return float(fdtri(modes, others, 1 - FALSE_ALARM))

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
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.special import chdtri, fdtri
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.scans.changes import Changes
from tactomo_models.scans.companion_forces import companions_of

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
    forces, before = companions_of(new), companions_of(settled)
    return (
        new.keys() == settled.keys()
        and forces.keys() == before.keys()
        and all(is_still(settled[name], changes) for name, changes in new.items())
        and all(
            one.agrees_with(before[name].force_n, before[name].sigma_n)
            for name, one in forces.items()
        )
    )


@dataclass(frozen=True)
class Since:
    """What has come since a fit: whether its parameters would follow the mean of it.

    To first order they would, by what the fit's Jacobian makes of the mean difference. Noise alone
    makes a chi-squared of it, with one degree of freedom for each parameter.
    """

    settled: Mapping[Channel, Changes]  # the frame that was fitted
    follow: FloatArray  # (N, sum M) takes a weighted difference to parameters of unit variance
    mean: FloatArray  # (N,) what these parameters would follow
    count: int = 0  # of the frames that it is the mean of

    @classmethod
    def after(
        cls,
        settled: Mapping[Channel, Changes],  # the frame that was fitted
        jacobian: FloatArray,  # (sum M, N) of its weighted residual
        precision: FloatArray,  # (N,) inverse variances of the prior
    ) -> Since:
        """Nothing has come yet."""
        normal = jacobian.T @ jacobian + np.diag(precision)
        of_sheets = jacobian[: sum(len(each.change) for each in settled.values())]
        follow = np.linalg.solve(np.linalg.cholesky(normal), of_sheets.T)
        return cls(settled, follow, np.zeros(len(precision)))

    def taken(self, new: Mapping[Channel, Changes]) -> tuple[Since, bool]:
        """With one frame more of the same channels, and whether something has changed."""
        off = [
            old.weight * (new[name].change - old.change) * (new[name].weight > 0)
            for name, old in self.settled.items()
        ]
        count = min(self.count + 1, MEMORY)
        mean = self.mean + (self.follow @ np.concatenate(off) - self.mean) / count
        changed = bool(mean @ mean > _mean_limit(len(mean)) * (1 + 1 / count))
        return replace(self, mean=mean, count=count), changed


@cache
def _mean_limit(parameters: int) -> float:
    """Sum of squares of so many parameters of unit variance that noise stays below."""
    return float(chdtri(parameters, FALSE_ALARM))


@cache
def _noise_limit(modes: int, others: int) -> float:
    """Ratio of two variances of so many degrees of freedom that noise stays below."""
    return float(fdtri(modes, others, 1 - FALSE_ALARM))

"""From volts to relative changes: what a scan says against the reference, and how surely.

Relative changes (V - V_ref) / |V_ref| cancel current, gain and sheet resistance. Each carries two
variances: of noise, as seen at the tare, and of the model's error, which grows with the change.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.physics.compiled_sheet import CompiledData
from tactomo_models.scans.frame_noise import CERTAIN
from tactomo_models.scans.plausibility import Flag
from tactomo_models.sensor.description import SensorDescription

# In which models err; of the paper's sensor, as many as a conductivity can move above the noise.
# With half and twice, peaks of mixed tuning scenes are right in 80 and 87 % (83 %) there, and on an
# insole of two sheets and 928 voltages in 33 and 43 % (38 %), surely wrong in 5 and 10 % (8 %).
ERROR_DIRECTIONS = 44
WRONG_WAY = 5.0  # standard uncertainties by which a conductivity may change against its sign


@dataclass(frozen=True)
class Changes:
    """Relative voltage changes of one channel's scan."""

    change: FloatArray  # (M,) 0 where it is invalid
    # (M,) inverse standard deviations, of noise and of model error; 0 where invalid
    weight: FloatArray
    # (M,) factor by which the variance of an estimate exceeds what independent errors of that size
    # would give it: model errors go together, see `inflated`
    variance_inflation: FloatArray
    quiet: bool  # whether nothing presses
    # root mean square of the changes over their noise and what no noise accounts for; what is quiet
    # is below the root of `noise_limit` over the count (1.24 of 208)
    signal: float
    # (M,) inverse variances of the changes where nothing presses, by noise and by what a skin at
    # rest does by itself; 0 where invalid
    precision: FloatArray
    # (M,) variances of the changes by noise: the tare's, and the scan's own where it has more
    noise_variance: FloatArray
    # (M,) square of a change too far below the model's error to be worth a solve
    tolerance: FloatArray
    # (M, K) orthonormal directions in which the sheet's conductivity can move changes over their
    # noise
    modes: FloatArray
    # (M, K) changes of one standard deviation each that count as errors: by a drift of the sheet,
    # and by what the mesh makes of outlines; None where none are allowed for
    drift: FloatArray | None = None
    outline_errors: FloatArray | None = None
    # the factor by which most voltages have changed since the tare, and what `signal` is without
    # it; of a quiet scan nobody asks
    factor: float = 1.0
    signal_beyond_factor: float = np.inf
    # whether the scan is quiet only because it is noisy: a press that the tare's noise would have
    # shown half of the time may be in it
    hides: bool = False

    @cached_property
    def is_factor(self) -> bool:
        """Whether a factor that all voltages share, such as a gain's, explains them to noise."""
        count = int(np.count_nonzero(self.precision))
        by_noise = count + CERTAIN * (2 * count) ** 0.5
        return not self.quiet and self.signal_beyond_factor**2 * count < by_noise

    def judged_by(self, error_ratio: float) -> Changes:
        """The same for a found sheet, whose errors have so many times the even one's variance."""
        there = self.weight > 0
        variance = 1 / np.where(there, self.weight, 1.0) ** 2
        error = error_ratio * np.maximum(variance - self.noise_variance, 0.0)
        variance = self.noise_variance + error
        return replace(
            self,
            weight=there / np.sqrt(variance),
            variance_inflation=inflated(error / variance, int(np.count_nonzero(there))),
            tolerance=error_ratio * self.tolerance,
        )

    @cached_property
    def nuisance(self) -> tuple[FloatArray, FloatArray] | None:
        """Orthonormal directions (M, K) of weighted changes that may be such errors.

        And the share (K,) of what is along each that is taken off.
        """
        given = [each for each in (self.drift, self.outline_errors) if each is not None]
        if not given:
            return None
        weighted = self.weight[:, None] * np.concatenate(given, axis=1)
        along, size, _ = np.linalg.svd(weighted, full_matrices=False)
        return along, 1 - 1 / np.sqrt(1 + size**2)

    @cached_property
    def compiled(self) -> CompiledData:
        """What C knows of them."""
        return CompiledData(self.change, self.weight, self.nuisance)

    def weighted(self, changes: FloatArray) -> FloatArray:
        """Relative changes (M,) or (M, N) over their errors, less what may be no press's."""
        return self.less_nuisance((self.weight * changes.T).T)

    def less_nuisance(self, over: FloatArray) -> FloatArray:
        """Weighted changes (M,) or (M, N) less what may be no press's."""
        if self.nuisance is None:
            return over
        along, share = self.nuisance
        return np.asarray(over - along @ (share * (along.T @ over).T).T)

    @property
    def misfit(self) -> float:
        """Misfit of a model in which nothing is pressed."""
        count = max(int(np.count_nonzero(self.weight)), 1)
        return float(np.sqrt((self.weighted(self.change) ** 2).sum() / count))


def inflated(error_share: FloatArray, count: int) -> FloatArray:
    """Factor (M,) by which model errors that go together weigh more than independent ones.

    What is drawn a little wrong moves the voltages in few directions, however many electrodes look
    on: the more voltages there are to each, the less each of them adds.

    Args:
        error_share: (M,) share of each variance that is of model errors.
        count: voltages that are valid.
    """
    together = max(count / ERROR_DIRECTIONS, 1.0)
    return 1 + (together - 1) * error_share


def towards_pressing(
    description: SensorDescription, data: Mapping[Channel, Changes]
) -> tuple[dict[Channel, FloatArray], dict[Channel, FloatArray]]:
    """Changes (M,) in the direction of pressing, and their inverse variances by noise."""
    changes = {name: description.sign(name) * each.change for name, each in data.items()}
    return changes, {name: each.precision for name, each in data.items()}


def missing(name: Channel) -> Flag:
    """The flag that says that a channel has nothing to show."""
    return Flag.MAGNITUDE_MISSING if name == Channel.MAGNITUDE else Flag.STRUCTURE_MISSING

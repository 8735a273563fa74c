"""From volts to relative changes: what a scan says against the reference, and how surely.

Relative changes (V - V_ref) / |V_ref| cancel current, gain and sheet resistance. Each carries two
variances: of noise, as seen at the tare, and of the model's error, which grows with the change.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.errors import DataError
from tactomo_models.physics.actual_sheet import explains
from tactomo_models.physics.artifact import MODEL_ERROR, Artifact, nominal_noise_v
from tactomo_models.physics.compiled_sheet import CompiledData
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.robust import median, robust_sigma
from tactomo_models.scans.frame_noise import FrameNoiseEstimator, noise_limit
from tactomo_models.scans.plausibility import (
    Flag,
    ScanCheck,
    Wiring,
    asymmetry_of,
    examine_reference,
)
from tactomo_models.scans.polarity import Polarity
from tactomo_models.scans.reference import noise_of_reciprocity
from tactomo_models.sensor.description import SensorDescription

# An uneven sheet has few degrees of freedom: errors of the model go together, about as many
# voltages at a time, and average out so much less than noise does. Correlation of the map on tuning
# rows with 2, 4 and 10: mixed 0.984 each; ordinary, 40 dB 0.987, 0.986, 0.982; rectangles and rings
# 0.984, 0.986, 0.982; crowds 0.978, 0.981, 0.970; soft on hand-made skins 0.963, 0.962, 0.958, and
# 48, 56 and 67 % of the places there within one sigma.
CORRELATED = 4.0
NOISELESS = 1e-9  # of the largest voltage: the noise of data that have none
UNUSABLE = 1e3  # relative error of a voltage whose reference is zero or no number
WRONG_WAY = 5.0  # standard uncertainties by which a conductivity may change against its sign


@dataclass(frozen=True)
class Changes:
    """Relative voltage changes of one channel's scan."""

    change: FloatArray  # (M,) 0 where it is invalid
    # (M,) inverse standard deviations, of noise and of model error; 0 where invalid
    weight: FloatArray
    # (M,) factor by which the variance of an estimate exceeds what independent errors of that size
    # would give it: model errors go together
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
    # (M, K) orthonormal directions of weighted changes that are the sheet's own drift, and the
    # share (K,) of each that is; None where none is allowed for
    drift: tuple[FloatArray, FloatArray] | None = None

    def judged_by(self, error_ratio: float) -> Changes:
        """The same for a found sheet, whose errors have so many times the even one's variance."""
        there = self.weight > 0
        variance = np.divide(1, self.weight**2, out=np.ones_like(self.weight), where=there)
        error = error_ratio * np.maximum(variance - self.noise_variance, 0.0)
        variance = self.noise_variance + error
        return replace(
            self,
            weight=there / np.sqrt(variance),
            variance_inflation=1 + (CORRELATED - 1) * error / variance,
            tolerance=error_ratio * self.tolerance,
        )

    def drifting(self, directions: FloatArray) -> Changes:
        """The same, where a drift of the sheet since the tare counts as an error.

        Args:
            directions: (M, K) changes of one standard deviation each.
        """
        drift = self.weight[:, None] * directions
        along, size, _ = np.linalg.svd(drift, full_matrices=False)
        return replace(self, drift=(along, 1 - 1 / np.sqrt(1 + size**2)))

    @cached_property
    def compiled(self) -> CompiledData:
        """What C knows of them."""
        return CompiledData(self.change, self.weight, self.drift)

    def weighted(self, changes: FloatArray) -> FloatArray:
        """Relative changes (M,) or (M, N) over their errors, less what may be drift."""
        over = (self.weight * changes.T).T
        if self.drift is not None:
            along, share = self.drift
            over -= along @ (share * (along.T @ over).T).T
        return over

    @property
    def misfit(self) -> float:
        """Misfit of a model in which nothing is pressed."""
        count = max(int(np.count_nonzero(self.weight)), 1)
        return float(np.sqrt((self.weighted(self.change) ** 2).sum() / count))


class ChannelResult(NamedTuple):
    """What is to be had of a scan."""

    changes: Changes | None  # None where there is too little to go by; a flag says so
    flags: Flag
    electrodes: list[int]  # those left out, ascending
    own_flags: Flag  # those of `flags` that this scan raises, and not its reference


class MeasuredChannel:
    """What is known of one channel since the last tare, and what its scans say against that.

    Attributes:
        reference: (M,) volts of the unpressed sheet, as it was at the tare.
        usable: (M,) voltages that the tare has found nothing wrong with.
        relative_noise: (M,) standard deviation of a relative change by noise, at the tare.

    Raises DataError for another number of voltages than the sensor has.
    """

    def __init__(
        self,
        description: SensorDescription,  # the sensor
        artifact: Artifact,  # what is precomputed for it
        forward: ForwardModel,  # the model of its sheet
        wiring: Wiring,  # which voltages belong to which electrodes
        name: Channel,  # the channel
        volts: FloatArray,  # (M,) of the unpressed sheet
        # (M,) standard deviation of one scan in volts; None where it is not known
        noise: FloatArray | None,
        scans: int,  # how many `volts` is the mean of
        # whether scans at rest tell `noise`; else it is no more than an upper bound
        is_noise_measured: bool,
    ) -> None:
        max_invalid = 0.5  # share of voltages that may be invalid before the channel is given up
        self._description, self._name = description, name
        self._check_length(volts, f"the {name} reference")
        is_bound = noise is None or not is_noise_measured
        if noise is None:
            noise = noise_of_reciprocity(description, volts)
        if noise is None:
            noise = nominal_noise_v(volts)
        predicted, contrast = forward.bare_voltages, description.contrast(name)
        self._polarity = Polarity(description, wiring, predicted)
        volts, sought = self._polarity.apply(volts), self._polarity.certain
        self._least_valid = (1 - max_invalid) * float(np.count_nonzero(sought))
        verdict = examine_reference(
            wiring, volts, predicted, noise / np.sqrt(scans), contrast, sought
        )
        self._flags, self._electrodes = verdict.flags, verdict.electrodes
        self.usable = valid = verdict.usable
        reference = np.where(valid, volts, 0.0)
        noise = np.where(valid, noise, 0.0)
        noiseless = NOISELESS * float(np.abs(reference).max(initial=0.0))
        of_change = np.maximum(noise * np.sqrt(1 + 1 / scans), noiseless)
        self.reference = self._reference = reference
        self._tare_per_volt = self._per_volt = np.divide(
            1, np.abs(reference), out=np.zeros_like(reference), where=valid
        )
        self._creep: FloatArray | None = None  # relative changes (M,) that may be a touch's
        self._least_noise = (noiseless * self._per_volt) ** 2
        self._noise = np.where(valid, (of_change * self._per_volt) ** 2, UNUSABLE**2)
        self.relative_noise = np.sqrt(self._noise + MODEL_ERROR**2)
        self._modes = _leading_modes(artifact.jacobian, np.where(valid, self._noise, np.inf))
        self._error_share = self._error_share_of(predicted)
        asymmetry = asymmetry_of(wiring, reference)
        self._check = ScanCheck(wiring, reference, noise, valid, contrast, asymmetry)
        self._frame_noise = FrameNoiseEstimator(wiring, reference, of_change, is_bound=is_bound)
        # Weights of the changes whose sum is the whole sheet's, in the direction of pressing.
        direction = 0.0 if description.either_way(name) else description.sign(name)
        self._total = direction * artifact.tikhonov.sum(axis=0)

    def _error_share_of(self, predicted: FloatArray) -> float:
        """Model error as a share of a change, of a model that predicts this reference (M,)."""
        least = 0.01
        # A model that is wrong about the reference is wrong about the changes, too, if less: most
        # of its error divides out.
        mismatch_share = 1 / 3
        valid = self.usable
        return max(least, mismatch_share * _mismatch(self.reference[valid], predicted[valid]))

    def error_ratio(self, predicted: FloatArray) -> float:
        """Variance of the errors of a model that predicts this reference (M,), over those told."""
        return (self._error_share_of(predicted) / self._error_share) ** 2

    def meet(self, sheet: ForwardModel) -> None:
        """Take back that the reference is of no such sheet where it is of this one, as found."""
        whole = not self._electrodes  # without some leads, the others may fit though misplaced
        if whole and explains(sheet, self.reference, self.usable, self.relative_noise):
            self._flags &= ~Flag.REFERENCE_MISMATCH

    def follow(self, drift: FloatArray | None, creep: FloatArray | None) -> None:
        """Measure changes against the tare as it has drifted since.

        What is known of noise, wiring and faults stays that of the tare.

        Args:
            drift: (M,) logarithms of factors.
            creep: (M,) the part of it in which a touch may be hidden.
        """
        self._creep = None if creep is None else np.sign(self.reference) * creep
        factor = 1.0 if drift is None else np.exp(drift)
        self._reference = self.reference * factor
        self._per_volt = self._tare_per_volt / factor

    def compare(self, scan: FloatArray, *, saturated: bool = False) -> ChannelResult:
        """Relative changes of a scan (M,), volts; `saturated` where its converter clipped.

        Raises DataError for another number of voltages than the sensor has.
        """
        still_share = 0.01  # of the model error's variance, that a still scene may change by
        median_square = 0.455  # of a normal distribution of unit variance
        self._check_length(scan, f"a {self._name} scan")
        scan = self._polarity.apply(scan)
        verdict = self._check.examine(scan, saturated=saturated)
        valid, flags = verdict.usable, self._flags | verdict.flags
        electrodes = sorted({*self._electrodes, *verdict.electrodes})
        count = int(np.count_nonzero(valid))
        if count < self._least_valid or not scan[valid].any():
            gone = missing(self._name) | Flag.INVALID_VOLTAGE
            return ChannelResult(None, flags | gone, electrodes, verdict.flags | gone)
        change = np.where(valid, scan - self._reference, 0.0) * self._per_volt
        square = change * change
        ratio, freedom = self._frame_noise.estimate(scan, valid)
        noise = np.maximum(self._noise * ratio, self._least_noise)
        # Of a change where nothing presses, drift included.
        variance = noise + self._description.instrument.stability**2
        # Small changes share in the error of the large ones beside them.
        typical = median(square[valid]) / median_square
        error = self._error_share**2 * (square + typical)
        statistic = float((square / variance).sum())
        quiet = statistic < noise_limit(count, freedom)
        if self._creep is not None:
            unfollowed = (change if quiet else 0.0) + self._creep
            shown = float((valid * unfollowed**2 / variance).sum()) + (0 if quiet else count)
            if shown >= noise_limit(count, freedom):
                flags |= Flag.CREEPING
        total = self._total
        if not (quiet or electrodes) and _fell(total * change, total**2 * variance):
            flags |= Flag.REFERENCE_MISMATCH
        changes = Changes(
            change=change,
            weight=valid / np.sqrt(noise + error),
            variance_inflation=1 + (CORRELATED - 1) * error / (noise + error),
            noise_variance=noise,
            tolerance=still_share * error,
            modes=self._modes,
            quiet=quiet,
            signal=(statistic / count) ** 0.5,
            precision=valid / variance,
        )
        return ChannelResult(changes, flags, electrodes, flags & ~self._flags | verdict.flags)

    def _check_length(self, volts: FloatArray, what: str) -> None:
        if volts.shape != (self._description.measurements,):
            raise DataError(
                f"{what} has shape {volts.shape}; sensor {self._description.name!r} has "
                f"{self._description.measurements} voltages a scan"
            )


def towards_pressing(
    description: SensorDescription, data: Mapping[Channel, Changes]
) -> tuple[dict[Channel, FloatArray], dict[Channel, FloatArray]]:
    """Changes (M,) in the direction of pressing, and their inverse variances by noise."""
    changes = {name: description.sign(name) * each.change for name, each in data.items()}
    return changes, {name: each.precision for name, each in data.items()}


def missing(name: Channel) -> Flag:
    """The flag that says that a channel has nothing to show."""
    return Flag.MAGNITUDE_MISSING if name == Channel.MAGNITUDE else Flag.STRUCTURE_MISSING


def _leading_modes(
    jacobian: FloatArray,  # (M, P) of the relative voltage changes
    variance: FloatArray,  # (M,) of their noise; infinite where they are not measured
) -> FloatArray:
    """Orthonormal directions (M, K) that the sheet's conductivity moves voltages over noise in."""
    least = 0.02  # of the largest singular value: 45 of 208; with half or twice that, 50 or 40
    whitened = jacobian / np.sqrt(variance)[:, None]
    squares, vectors = np.linalg.eigh(whitened @ whitened.T)
    return np.ascontiguousarray(vectors[:, squares > least**2 * squares[-1]])


def _fell(total: FloatArray, variance: FloatArray) -> bool:
    """Tell whether the sheet as a whole changed against the sign that pressing has.

    Then less presses now than did at the tare.
    """
    return float(total.sum()) < -WRONG_WAY * float(np.sqrt(variance.sum()))


def _mismatch(reference: FloatArray, predicted: FloatArray) -> float:
    """Typical relative error of a model that may be off by a common factor; 1 where none fits."""
    ratio = reference / predicted
    if len(ratio) == 0:
        return 1.0
    middle = float(np.median(ratio))
    return robust_sigma(ratio / middle - 1)

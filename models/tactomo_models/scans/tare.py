"""What the tare knows, and what scans say against it.

From the unpressed scans alone follow, for each channel, its volts and noise, the voltages that can
be used, what stands in the way of trusting it, and the sheet as it was made.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple, Self

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.errors import DataError
from tactomo_models.physics.actual_sheet import SheetEstimator, Sheets, explains
from tactomo_models.physics.artifact import MODEL_ERROR, Artifact, nominal_noise_v
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.robust import median, robust_sigma
from tactomo_models.scans.changes import WRONG_WAY, Changes, inflated, missing
from tactomo_models.scans.companion_forces import CompanionForce, CompanionReading
from tactomo_models.scans.frame_noise import FrameNoiseEstimator, hides_press, noise_limit
from tactomo_models.scans.measurement import Measurement
from tactomo_models.scans.plausibility import (
    Flag,
    ScanCheck,
    Wiring,
    asymmetry_of,
    examine_reference,
)
from tactomo_models.scans.polarity import Polarity
from tactomo_models.scans.reference import Reference, noise_of_reciprocity
from tactomo_models.sensor.description import SensorDescription

LEFT_OUT: Final = Flag.ELECTRODE_FAULT | Flag.INVALID_VOLTAGE  # what is known to be missing
NOISELESS = 1e-9  # of the largest voltage: the noise of data that have none
NOISY: Final = 0.016  # of the voltages (36 dB, where the doctor says ill): hides a fingertip
UNUSABLE = 1e3  # relative error of a voltage whose reference is zero or no number
MUCH_MORE: Final = 5.0  # ratio of the channels' contrasts (logarithms) that tells them apart


@dataclass(frozen=True)
class Sensor:
    """One sensor before its first tare."""

    description: SensorDescription
    artifact: Artifact  #: what is precomputed for it
    forward: ForwardModel  #: the model of its even sheet

    @cached_property
    def wiring(self) -> Wiring:
        """Which voltages belong to which electrodes."""
        return Wiring(self.description)

    @cached_property
    def estimator(self) -> SheetEstimator:
        """What finds how its sheets were made."""
        return SheetEstimator(self.description, self.artifact.bare)

    @cached_property
    def drift(self) -> FloatArray:
        """What its sheets may do by themselves, see `SheetEstimator.drift`."""
        return self.estimator.drift()

    @cached_property
    def companion_weights(self) -> dict[str, FloatArray]:
        """Newtons (P,) that each companion feels of one kPa at each pressable node."""
        companions = self.description.companion.items()
        return {name: self.forward.newtons_per_kpa(one.region_m) for name, one in companions}

    @cached_property
    def structure_answers_more(self) -> bool:
        """Whether pressing changes the structure channel far more than the other."""
        contrast = self.description.contrast
        return len(self.description.channels) == 2 and bool(
            np.log(contrast(Channel.STRUCTURE)) > MUCH_MORE * np.log(contrast(Channel.MAGNITUDE))
        )


class ChannelResult(NamedTuple):
    """What is to be had of a scan."""

    changes: Changes | None  # None where there is too little to go by; a flag says so
    flags: Flag  # that this scan raises, beside those of its reference
    electrodes: list[int]  # those left out, ascending


class ChannelTare:
    """What the tare knows of one channel; nothing of it changes.

    Attributes:
        reference: (M,) volts of the unpressed sheet.
        usable: (M,) voltages that the tare has found nothing wrong with.
        relative_noise: (M,) standard deviation of a relative change by noise.

    Raises DataError for another number of voltages than the sensor has.
    """

    def __init__(
        self,
        sensor: Sensor,  # whose channel it is
        name: Channel,  # the channel
        reference: Reference,  # what was taken of the unpressed sheets
        volts: FloatArray,  # (M,) of this one
        is_even: bool,  # whether its sheet is taken as even, and not found
    ) -> None:
        max_invalid = 0.5  # share of voltages that may be invalid before the channel is given up
        description, wiring, scans = sensor.description, sensor.wiring, reference.scans
        self._sensor, self._name, self._is_even = sensor, name, is_even
        self._check_length(volts, f"the {name} reference")
        noise: FloatArray | None = getattr(reference, f"{name}_noise")
        is_bound = noise is None or not reference.is_noise_measured
        if noise is None:
            noise = noise_of_reciprocity(description, volts)
        if noise is None:
            noise = nominal_noise_v(volts)
        predicted, contrast = sensor.forward.bare_voltages, description.contrast(name)
        self._polarity = Polarity(description, wiring, predicted)
        volts, sought = self._polarity.apply(volts), self._polarity.certain
        self._least_valid = (1 - max_invalid) * float(np.count_nonzero(sought))
        verdict = examine_reference(
            wiring, volts, predicted, noise / np.sqrt(scans), contrast, sought
        )
        self._flags, self._electrodes = verdict.flags, verdict.electrodes
        self.usable = valid = verdict.usable
        self.reference = np.where(valid, volts, 0.0)
        noise = np.where(valid, noise, 0.0)
        noiseless = NOISELESS * float(np.abs(self.reference).max(initial=0.0))
        noisy = NOISY * float(np.linalg.norm(self.reference))
        self._is_noisy = float(np.linalg.norm(noise)) > noisy
        of_change = np.maximum(noise * np.sqrt(1 + 1 / scans), noiseless)
        size = np.abs(self.reference)
        self._per_volt = np.divide(1, size, out=np.zeros_like(size), where=valid)
        self._least_noise = np.where(valid, (noiseless * self._per_volt) ** 2, UNUSABLE**2)
        self._noise = np.where(valid, (of_change * self._per_volt) ** 2, UNUSABLE**2)
        self.relative_noise = np.sqrt(self._noise + MODEL_ERROR**2)
        jacobian = sensor.artifact.jacobian
        self._modes = _leading_modes(jacobian, np.where(valid, self._noise, np.inf))
        at_rest = self._noise + description.instrument.stability**2
        self._at_rest = np.where(valid, at_rest, np.inf)
        self._modes_at_rest = _leading_modes(jacobian, self._at_rest)
        self._error_share = self._error_share_of(predicted)
        asymmetry = asymmetry_of(wiring, self.reference)
        self._check = ScanCheck(wiring, self.reference, noise, valid, contrast, asymmetry)
        self._frame_noise = FrameNoiseEstimator(
            wiring, self.reference, of_change, is_bound=is_bound
        )
        # Weights of the changes whose sum is the whole sheet's, in the direction of pressing.
        direction = 0.0 if description.either_way(name) else description.sign(name)
        self._total = direction * sensor.artifact.tikhonov.sum(axis=0)

    def _error_share_of(self, predicted: FloatArray) -> float:
        """Model error as a share of a change, of a model that predicts this reference (M,)."""
        least = 0.01  # beside what the mesh makes of outlines, see `account.outline_errors`
        # A model that is wrong about the reference is wrong about the changes, too, if less: most
        # of its error divides out.
        mismatch_share = 1 / 3
        valid = self.usable
        return max(least, mismatch_share * _mismatch(self.reference[valid], predicted[valid]))

    @cached_property
    def sheet(self) -> ForwardModel | None:
        """The model of the sheet as the reference tells it; None where the even one stays."""
        structure = self._sensor.description.structure
        if self._is_even or (structure is not None and structure.either_way):
            return None  # a tank is no skin: its water is even
        return self._sensor.estimator.estimate(self.reference, self.usable, self.relative_noise)

    @cached_property
    def error_ratio(self) -> float:
        """Variance of the errors of the sheet as found, over those of the even one."""
        if self.sheet is None:
            return 1.0
        return (self._error_share_of(self.sheet.bare_voltages) / self._error_share) ** 2

    @cached_property
    def flags(self) -> Flag:
        """What stands in the way of trusting the reference.

        That it is of no such sheet is taken back where it is of the sheet as found.
        """
        # Without some leads, the others may fit though misplaced.
        if Flag.REFERENCE_MISMATCH not in self._flags or self._electrodes or self.sheet is None:
            return self._flags
        is_explained = explains(self.sheet, self.reference, self.usable, self.relative_noise)
        return self._flags & ~Flag.REFERENCE_MISMATCH if is_explained else self._flags

    def compare(
        self,
        scan: FloatArray,
        drift: FloatArray | None,
        creep: FloatArray | None,
        *,
        saturated: bool = False,
    ) -> ChannelResult:
        """Relative changes of a scan (M,), volts.

        Args:
            scan: (M,) volts.
            drift: (M,) logarithms of the factors by which the reference has drifted since; None
                where it has not. What is known of noise, wiring and faults stays the tare's.
            creep: (M,) the part of it in which a touch may be hidden.
            saturated: whether its converter clipped.

        Raises DataError where it has another number of voltages than the sensor.
        """
        still_share = 0.01  # of the model error's variance, that a still scene may change by
        median_square = 0.455  # of a normal distribution of unit variance
        self._check_length(scan, f"a {self._name} scan")
        scan = self._polarity.apply(scan)
        verdict = self._check.examine(scan, saturated=saturated)
        valid, flags = verdict.usable, verdict.flags
        electrodes = sorted({*self._electrodes, *verdict.electrodes})
        count = int(np.count_nonzero(valid))
        if count < self._least_valid or not scan[valid].any():
            gone = missing(self._name) | Flag.INVALID_VOLTAGE
            return ChannelResult(None, flags | gone, electrodes)
        factor = 1.0 if drift is None else np.exp(drift)
        change = np.where(valid, scan - self.reference * factor, 0.0) * (self._per_volt / factor)
        square = change * change
        ratio, freedom = self._frame_noise.estimate(scan, valid)
        noise = np.maximum(self._noise * ratio, self._least_noise)
        # Of a change where nothing presses, drift included.
        variance = noise + self._sensor.description.instrument.stability**2
        # Small changes share in the error of the large ones beside them.
        typical = median(square[valid]) / median_square
        error = self._error_share**2 * (square + typical)
        squares = (square / variance)[valid]
        statistic = float(squares.sum())
        quiet = statistic < noise_limit(count, freedom)
        if creep is not None:
            unfollowed = (change if quiet else 0.0) + np.sign(self.reference) * creep
            shown = float((valid * unfollowed**2 / variance).sum()) + (0 if quiet else count)
            if shown >= noise_limit(count, freedom):
                flags |= Flag.CREEPING
        # Where the whole sheet changed against the sign of pressing, less presses than at the tare.
        total = self._total
        least = -WRONG_WAY * (total**2 @ variance) ** 0.5
        if not (quiet or electrodes) and total @ change < least:
            flags |= Flag.REFERENCE_MISMATCH
        common, beyond, hides = 1.0, np.inf, quiet and self._is_noisy
        if quiet and ratio > 1 and not hides:
            hides = self._hides(change, variance, freedom, count)
        if not quiet:
            over = 1 + (change * np.sign(self.reference))[valid]
            common = median(over) or 1.0
            # A gain behind what makes the noise takes the noise along; one before leaves it.
            scale = max(abs(common), 1.0)
            off = over / scale - common / scale
            beyond = float((off**2 / variance[valid]).sum()) / count
        changes = Changes(
            change=change,
            weight=valid / np.sqrt(noise + error),
            variance_inflation=inflated(error / (noise + error), count),
            noise_variance=noise,
            tolerance=still_share * error,
            modes=self._modes,
            quiet=quiet,
            signal=(statistic / count) ** 0.5,
            precision=valid / variance,
            factor=common,
            signal_beyond_factor=beyond**0.5,
            hides=hides,
        )
        return ChannelResult(changes, flags, electrodes)

    def _hides(self, change: FloatArray, variance: FloatArray, freedom: float, count: int) -> bool:
        """Whether a press that would show by the tare's noise may be in a quiet, noisy scan."""
        ways = self._modes_at_rest.shape[1]
        along = self._modes_at_rest.T @ (change / np.sqrt(self._at_rest))
        noise = float((self._modes_at_rest**2).sum(axis=1) @ (variance / self._at_rest)) / ways
        told = noise_limit(count) - count
        return hides_press(float(along @ along), ways, noise, freedom, told)

    def _check_length(self, volts: FloatArray, what: str) -> None:
        description = self._sensor.description
        if volts.shape != (description.measurements,):
            raise DataError(
                f"{what} has shape {volts.shape}; sensor {description.name!r} has "
                f"{description.measurements} voltages a scan"
            )


@dataclass(frozen=True, eq=False)
class Tare:
    """What is known of a sensor since its unpressed scans were taken: `Tare.take` makes it."""

    sensor: Sensor
    reference: Reference  #: the unpressed scans, and how they have drifted since
    channels: Mapping[Channel, ChannelTare]  #: those that the reference has
    asks_noise: bool  #: whether the first frame is to tell the noise, see `with_noise_of`
    is_even: bool = False  #: whether the sheets are taken as even, and not found

    @classmethod
    def take(cls, sensor: Sensor, reference: Reference, *, is_even: bool = False) -> Self:
        """What a reference tells; for any thread.

        Raises DataError where a channel has another number of voltages than the sensor.
        """
        channels = _channels(sensor, reference, is_even)
        return cls(sensor, reference, channels, reference.lacks_noise, is_even)

    def with_noise_of(self, *scans: FloatArray | None) -> Self:
        """The same with the noise of the first frame's scans, where one scan alone was taken.

        A reference is often the mean of many scans, and so much quieter than the scans to come; and
        it breaks reciprocity not by noise alone, but also by what is the same in every scan.
        """
        description = self.sensor.description
        wanted = (description.measurements,)
        asked = replace(self, asks_noise=False)
        if any(scan is not None and scan.shape != wanted for scan in scans):
            return asked
        seen = self.reference.with_noise_of(description, *scans)
        if seen.lacks_noise:
            return asked
        return replace(asked, channels=_channels(self.sensor, seen, self.is_even))

    @cached_property
    def sheets(self) -> Sheets:
        """The models of those sheets whose references tell how they were made.

        All others are taken as even. Takes half a second of processor time a sheet, once.
        """
        found = {name: channel.sheet for name, channel in self.channels.items()}
        return {name: sheet for name, sheet in found.items() if sheet is not None}

    def with_model_error(self, measurement: Measurement) -> Measurement:
        """The same, with each weight from the model error of the sheet as it was found."""
        changes = {
            name: each.judged_by(self.channels[name].error_ratio) if name in self.sheets else each
            for name, each in measurement.changes.items()
        }
        return replace(measurement, changes=changes)

    def changes(
        self,
        magnitude: FloatArray | None,
        structure: FloatArray | None,
        saturated: Collection[Channel] = (),
        companions: Collection[tuple[str, float] | CompanionReading] | None = None,
    ) -> Measurement:
        """Relative changes of one frame's scans; see `Reconstructor.reconstruct`."""
        start_s = time.perf_counter()
        changes: dict[Channel, Changes] = {}
        flags = own_flags = Flag(0)
        faults: list[str] = []
        scans = {Channel.MAGNITUDE: magnitude, Channel.STRUCTURE: structure}
        for name in self.sensor.description.channels:
            scan = scans[name]
            if scan is None or name not in self.channels:
                absent = missing(name) if scan is None else Flag.NO_REFERENCE
                flags, own_flags = flags | absent, own_flags | absent
                continue
            moved = (getattr(self.reference, f"{name}_{what}") for what in ("drift", "creep"))
            channel = self.channels[name]
            result = channel.compare(scan, *moved, saturated=name in saturated)
            flags, own_flags = flags | channel.flags | result.flags, own_flags | result.flags
            if result.electrodes:
                faults.append(_named(name, result.electrodes))
            if result.changes is not None:
                changes[name] = result.changes
                if result.changes.is_factor:
                    factor = result.changes.factor
                    faults.append(f"all {name} voltages are {factor:.3g} times those of the tare")
        if self._are_swapped(changes) or (
            len(changes) == 2 and self._are_one(magnitude, structure)
        ):
            flags |= Flag.CHANNELS_SWAPPED
        standing_flags = flags & (LEFT_OUT & ~own_flags | Flag.CREEPING)
        stage_s = {"data": time.perf_counter() - start_s}
        readings = {each[0]: CompanionReading(*each) for each in companions or ()}
        known = self.sensor.description.companion
        usable = {k for k in known if k in readings and known[k].may_read(readings[k].value)}
        if companions is not None and usable != known.keys():
            flags |= Flag.COMPANION_MISSING
            faults += [f"companion {name} has no reading" for name in known if name not in usable]
        forces = {name: self._force(readings[name]) for name in known if name in usable}
        return Measurement(
            changes, flags, standing_flags, tuple(faults), stage_s, companions=forces
        )

    def _force(self, reading: CompanionReading) -> CompanionForce:
        """What a companion feels since the tare."""
        companion = self.sensor.description.companion[reading.name]
        at_rest = dict(self.reference.companions or ())
        offset = at_rest.get(reading.name, companion.offset)
        force_n = companion.gain_n_per_unit * (reading.value - offset)
        sigma_n = float(np.hypot(companion.noise_n, companion.relative_error * force_n))
        weights = self.sensor.companion_weights[reading.name]
        return CompanionForce(reading.value, force_n, sigma_n, weights)

    def _are_one(self, magnitude: FloatArray | None, structure: FloatArray | None) -> bool:
        """Tell whether both channels carry one sheet's scan: noise makes no two of them alike."""
        is_measured = self.reference.is_noise_measured and not self.reference.lacks_noise
        if magnitude is None or structure is None or not is_measured:
            return False
        return bool((magnitude == structure).all())

    def _are_swapped(self, changes: Mapping[Channel, Changes]) -> bool:
        """Tell whether the magnitude channel answers more than the structure channel.

        The structure channel's contrast is far the larger, so that no pressing does that. A gain
        that has changed does, and is no swap: a factor that all voltages share does not count.
        """
        swapped = 2.0  # times the structure channel's signal, that the magnitude channel's is below
        if len(changes) < 2 or not self.sensor.structure_answers_more:
            return False
        magnitude, structure = changes[Channel.MAGNITUDE], changes[Channel.STRUCTURE]
        answer = min(magnitude.signal, magnitude.signal_beyond_factor)
        return not magnitude.quiet and answer > swapped * structure.signal


def _channels(sensor: Sensor, reference: Reference, is_even: bool) -> dict[Channel, ChannelTare]:
    return {
        name: ChannelTare(sensor, name, reference, volts, is_even)
        for name in sensor.description.channels
        if (volts := getattr(reference, name)) is not None
    }


def _named(name: Channel, electrodes: list[int]) -> str:
    """Say in words which electrodes are left out; they are counted from 0."""
    word = "electrode" if len(electrodes) == 1 else "electrodes"
    return f"{name} {word} {', '.join(map(str, electrodes))} left out"


def _leading_modes(
    jacobian: FloatArray,  # (M, P) of the relative voltage changes
    variance: FloatArray,  # (M,) of their noise; infinite where they are not measured
) -> FloatArray:
    """Orthonormal directions (M, K) that the sheet's conductivity moves voltages over noise in."""
    least = 0.02  # of the largest singular value: 45 of 208; with half or twice that, 50 or 40
    whitened = jacobian / np.sqrt(variance)[:, None]
    squares, vectors = np.linalg.eigh(whitened @ whitened.T)
    return np.ascontiguousarray(vectors[:, squares > least**2 * squares[-1]])


def _mismatch(reference: FloatArray, predicted: FloatArray) -> float:
    """Typical relative error of a model that may be off by a common factor; 1 where none fits."""
    ratio = reference / predicted
    if len(ratio) == 0:
        return 1.0
    middle = float(np.median(ratio))
    return robust_sigma(ratio / middle - 1)

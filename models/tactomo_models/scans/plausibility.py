"""What a scan can show of its own faults: broken leads, clipping, interference, wrong wiring.

Nothing here knows what presses. Any sheet of any conductivity obeys three rules, whatever lies on
it, and a scan that breaks one of them has a fault beyond its noise:

- reciprocity: V(k, m) = V(m, k).
- order: where the drive pair and the measuring pair do not cross, the voltage has the sign that it
  has on the bare sheet. Potential falls steadily along the rim from one driven electrode to the
  other: at a highest point in between no current could leave the sheet.
- size: no voltage exceeds the bare sheet's by orders of magnitude, and a pair of electrodes under
  which the sheet conducts does not fall silent in every measurement.

Faults that most of an electrode's voltages share are that electrode's.

Source of the second rule: Curtis, Ingerman & Morrow, "Circular planar graphs and resistor
networks", Linear Algebra Appl. 283 (1998). What is read here of wrong leads follows Asfaw & Adler,
"Automatic detection of detached and erroneous electrodes in electrical impedance tomography",
Physiol. Meas. 26 (2005).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from typing import TypeAlias

import numpy as np

from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.robust import robust_sigma
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.sensor.pattern import PatternLayout, reciprocal_pairs, rim_signs

Layout: TypeAlias = SensorDescription | PatternLayout
"""Which electrodes every voltage is of: a sensor's description, or a pattern alone."""

TINY = float(np.finfo(float).tiny)
LARGEST = 1e3  # times the largest voltage expected: more is no voltage of this sheet
FARTHEST_SCALE = 1e30  # a reference in any sensible unit is within this of the model
OUTLIER = 8.0  # standard deviations that noise does not reach
SILENT = 0.3  # over the channel's contrast: a share of its voltage that a pair always exceeds
MIN_FAULTY_VOLTAGES = 5  # of its voltages, likewise
MAX_DEVIATION = 3.0  # times that: a reference of this sheet, unloaded, deviates less


class Flag(IntFlag):
    """What stands in the way of trusting a frame."""

    STRUCTURE_MISSING = 1
    MAGNITUDE_MISSING = 2
    INVALID_VOLTAGE = 4
    NO_REFERENCE = 8
    MISFIT_HIGH = 16
    NOT_CONVERGED = 32
    REFERENCE_MISMATCH = 64  # tared under load, other electrodes' order, or another sensor
    ELECTRODE_FAULT = 128  # a broken lead; what was read by it is left out
    NOISE_HIGH = 256  # reciprocity broken throughout: interference, or a device that is broken
    CHANNELS_SWAPPED = 512  # the magnitude channel answers more than the structure channel
    SATURATED = 1024  # the converter clipped; what it clipped is left out
    LOW_CONFIDENCE = 2048  # the network expects its own map to be wrong
    CHANNELS_SKEWED = 4096  # the two scans are not of one instant; set by who pairs them
    NO_USABLE_SCAN = 8192  # nothing was measured: that no contact is shown says nothing
    REFERENCE_DISPUTED = 16384  # the skin at the start was not as last known; set by who tares
    UNTAUGHT = 32768  # the skin was taught, and no press like this one: the physics alone locates
    CREEPING = 65536  # what is taken for creep may hide a touch
    COMPANION_MISSING = 131072  # a companion has no usable reading; the sheets stand alone
    COMPANION_DISPUTED = 262144  # a companion contradicts the sheets, and is left out

    def names(self) -> list[str]:
        """Names of the flags that are set, in lower case, as the stream carries them."""
        return [flag.name.lower() for flag in self if flag.name]


# Flags that tell a user not to trust a frame. The others say that a part of the data is missing or
# was left out, and that the frame stands on the rest.
DISTRUST = (
    Flag.MISFIT_HIGH
    | Flag.NOT_CONVERGED
    | Flag.REFERENCE_MISMATCH
    | Flag.NOISE_HIGH
    | Flag.CHANNELS_SWAPPED
    | Flag.CHANNELS_SKEWED
    | Flag.LOW_CONFIDENCE
)


@dataclass(frozen=True)
class Verdict:
    """What is wrong with a scan."""

    usable: BoolArray  # (M,) voltages that may be believed
    flags: Flag  # what is wrong
    electrodes: tuple[int, ...] = ()  # those whose voltages were left out


class Wiring:
    """Which voltages belong together: reciprocal ones, and those of a pair or an electrode."""

    def __init__(self, layout: Layout) -> None:
        pairs, electrodes = layout.pairs, layout.electrode_count
        self.reciprocal = reciprocal_pairs(pairs)
        ends = np.hstack([pairs.drive, pairs.measure])
        self.electrodes = (ends == np.arange(electrodes)[:, None, None]).any(axis=2)
        # No press turns these voltages round.
        self.ordered = np.asarray(rim_signs(pairs, layout.rim_order) != 0)
        self.off_rim = np.asarray((layout.rim_order[ends] < 0).any(axis=1))
        self.drives = np.array(
            [(pairs.drive == p).all(axis=1) for p in np.unique(pairs.drive, axis=0)]
        )
        driven = np.unique(np.concatenate([pairs.drive, pairs.measure]), axis=0)
        self.pairs = np.array(
            [(pairs.drive == p).all(axis=1) | (pairs.measure == p).all(axis=1) for p in driven]
        )

    def faulty_electrodes(self, wrong: BoolArray) -> tuple[int, ...]:
        """Electrodes that share most of the wrong voltages (M,) and have most of theirs wrong."""
        faulty_share = 0.35  # of an electrode's voltages that must be wrong for it to be the cause
        touches = self.electrodes
        enough = np.maximum(MIN_FAULTY_VOLTAGES, faulty_share * touches.sum(axis=1))
        faulty: list[int] = []
        while True:
            counts = (touches & wrong).sum(axis=1)
            worst = int(counts.argmax())
            if counts[worst] < enough[worst]:
                return tuple(sorted(faulty))
            faulty.append(worst)
            wrong = wrong & ~touches[worst]


class ScanCheck:
    """Holds scans of one channel against the voltages that are expected."""

    def __init__(
        self,
        wiring: Wiring,  # of the sensor
        expected: FloatArray,  # (M,) volts of the unpressed sheet
        noise: FloatArray,  # (M,) standard deviation of a scan, volts
        usable: BoolArray,  # (M,) voltages for which there is an expectation
        contrast: float,  # factor by which pressing changes conductivity at most, up or down
        # (pairs,) what a tare has seen of `asymmetry_of` the device; unknown if None
        asymmetry: FloatArray | None = None,
    ) -> None:
        quietest_share = 1e-6  # of the largest voltage, that any converter's noise exceeds
        common_asymmetry = 0.02  # share by which reciprocal voltages differ on a device that serves
        min_asymmetry = 0.001  # likewise beyond what the tare saw, on a good device
        passing_asymmetry = 0.35  # of what the tare saw: may come and go with what is pressed
        silence_seen = 1.2  # as SILENT: noise below it lets silence be told from pressing
        self._wiring = wiring
        self._size = np.where(usable, np.abs(expected), 0.0)
        quietest = quietest_share * float(self._size.max(initial=0.0))
        self._noiseless = float(noise.max(initial=0.0)) < quietest
        noise = np.maximum(noise, quietest)
        self._sign = np.sign(expected)
        self._usable = usable
        self._limit = LARGEST * float(self._size.max(initial=0.0))
        self._first, self._second = wiring.reciprocal.T
        variance = noise**2
        self._pair_variance = variance[self._first] + variance[self._second] + TINY
        if asymmetry is None:
            self._asymmetry = np.zeros_like(self._pair_variance)
            self._tolerance = np.full_like(self._pair_variance, common_asymmetry)
        else:
            self._asymmetry = asymmetry
            own = np.abs(asymmetry)
            typical = float(np.median(own)) if len(own) else 0.0
            self._tolerance = min_asymmetry + passing_asymmetry * np.maximum(own, typical)
        # Against this much the wrong way, a voltage's sign is wrong; elsewhere no sign is known.
        self._wrong_way = np.where(wiring.ordered & usable, -OUTLIER * noise, -np.inf)
        self._pairs = (wiring.pairs & wiring.ordered & usable).astype(float)
        expected_sum = self._pairs @ self._size
        doubt = 2.5 * np.sqrt(self._pairs @ np.where(usable, variance, 0.0))
        told = doubt < (silence_seen - SILENT) / contrast * expected_sum
        self._silence = np.where(told, SILENT / contrast * expected_sum + doubt, -np.inf)

    def examine(
        self,
        scan: FloatArray,  # (M,) volts
        *,
        saturated: bool = False,  # its device says that it clipped
        # (M,) voltages that speak against their electrodes, but no more than that
        suspect: BoolArray | None = None,
    ) -> Verdict:
        """Say what is wrong with a scan."""
        high_noise = 10.0  # times what the tare saw: interference
        size = read = np.abs(scan)
        usable = self._usable & (size <= self._limit)
        flags = Flag(0)
        wrong = usable ^ self._usable
        if not usable.all():
            size = np.where(usable, size, 0.0)
            scan = np.where(usable, scan, 0.0)
            if wrong.any():
                flags |= Flag.INVALID_VOLTAGE
        clipped = self._clipped(size, saturated=saturated)
        if clipped is not None:
            flags |= Flag.SATURATED
            usable &= ~clipped
            wrong |= clipped
        noise, interference, unequal = self._reciprocity(scan, usable)
        if interference > high_noise:
            flags |= Flag.NOISE_HIGH
        along = scan * self._sign
        outlier = unequal | (along < self._wrong_way * noise)
        along = np.where(outlier | ~usable, self._size, along)  # what is not to go by
        silent = self._pairs @ along < self._silence
        if silent.any():
            outlier |= self._wiring.pairs[silent].any(axis=0)
        outlier &= usable
        wrong |= outlier
        if suspect is not None:
            wrong |= suspect
        if not wrong.any():
            return Verdict(usable, flags)
        if (unread := self._usable & ~np.isfinite(read)).any():
            # A drive of which nothing was read is the device's fault, and no lead's.
            whole = (unread | ~self._wiring.drives | ~self._usable).all(axis=1)
            wrong &= ~self._wiring.drives[whole].any(axis=0)
        electrodes = self._wiring.faulty_electrodes(wrong)
        if electrodes:
            flags |= Flag.ELECTRODE_FAULT
            left_out = self._wiring.electrodes[list(electrodes)].any(axis=0)
            usable &= ~left_out
            outlier &= ~left_out
        if outlier.any():
            flags |= Flag.INVALID_VOLTAGE
        return Verdict(usable & ~outlier, flags, electrodes)

    def _clipped(self, size: FloatArray, *, saturated: bool) -> BoolArray | None:
        """Voltages at the converter's limit: many of the same size that should not be alike."""
        rounding = 1e-12  # share by which the mean of equal values may miss them
        same_clipped = 4  # voltages of exactly the same, largest size: beside noise, no chance
        alike = 1.01  # ratio within which they may come out the same by symmetry without noise
        top = size >= size.max() * (1 - rounding)
        if not saturated and np.count_nonzero(top) < same_clipped:
            return None
        if not saturated and not size.any():  # nothing usable: alike, and at no limit
            return None
        expected = self._size[top]
        if not saturated and self._noiseless and expected.max() <= alike * expected.min():
            return None
        return np.asarray(top)

    def _reciprocity(self, scan: FloatArray, usable: BoolArray) -> tuple[float, float, BoolArray]:
        """Noise over the tare's, the same but for gains, and voltages unlike their reciprocals."""
        unequal = np.zeros(len(scan), dtype=bool)
        i, j = self._first, self._second
        one, other = scan[i], scan[j]
        total = one + other
        allowed = self._tolerance * total
        square = (one - other - self._asymmetry * total) ** 2
        both = usable[i] & usable[j]
        if np.count_nonzero(both) < 4:
            return 1.0, 1.0, unequal
        ratio = max(1.0, _typical((square / self._pair_variance)[both]))
        gains = allowed * allowed
        interference = _typical((square / (self._pair_variance + gains))[both])
        bad = both & (square > OUTLIER**2 * (ratio * self._pair_variance + gains))
        unequal[i[bad]] = True
        unequal[j[bad]] = True
        return ratio**0.5, interference**0.5, unequal


def _typical(squares: FloatArray) -> float:
    """Variance of normal noise whose squares (n,) these are, though two thirds may be outliers.

    It goes by a quartile, not by the median: some dead electrodes must not pass for noise.
    """
    quartile = 0.3186  # standard deviations that hold a quarter of a normal distribution
    quarter = len(squares) // 4
    return float(np.partition(squares, quarter)[quarter]) / quartile**2


def examine_reference(
    wiring: Wiring,  # of the sensor
    volts: FloatArray,  # (M,) the reference
    predicted: FloatArray,  # (M,) by the model
    noise: FloatArray,  # (M,) standard deviation of the reference, volts
    contrast: float,  # factor by which pressing changes conductivity at most, up or down
    # (M,) voltages that are to be used; the others are nobody's fault
    sought: BoolArray | bool = True,
) -> Verdict:
    """Say what is wrong with a reference (M,): hold it against the model of the unloaded sheet.

    The model may be off by a common factor: the sheet's resistance, the current and the gain are
    not known well, and whatever unit the voltages have divides out.
    """
    smallest = (
        1e-6  # of the voltage expected: less in a reference is none to measure changes against
    )
    max_asymmetry = 0.2  # share, rms, beyond which nothing can be located
    finite = np.isfinite(volts) & np.isfinite(noise) & (noise >= 0)
    nothing = Verdict(np.zeros_like(finite), Flag.INVALID_VOLTAGE)
    with np.errstate(over="ignore"):
        ratio = np.where(finite, volts, 0.0) / predicted
        known = finite & sought
        scale = float(np.median(ratio[known])) if known.any() else 0.0
        if not 1 / FARTHEST_SCALE < abs(scale) < FARTHEST_SCALE:
            return nothing
        size = np.abs(ratio / scale)
        noise = np.where(finite, noise, 0.0) / abs(scale)
    usable = finite & (size > smallest) & (size < LARGEST)
    usable &= noise < LARGEST * np.abs(predicted).max()
    lost = sought & ~usable
    usable &= sought
    if not usable.any():
        return nothing
    volts, noise = np.where(usable, volts, 0.0) / scale, np.where(usable, noise, 0.0)
    check = ScanCheck(wiring, predicted, noise, usable, contrast)
    # A lead that picks up interference at rest: by itself noisy, and maybe right on average.
    noisy = usable & (noise > OUTLIER * np.median(noise[usable]))
    verdict = check.examine(volts, suspect=noisy | lost)
    flags = verdict.flags | Flag.INVALID_VOLTAGE if lost.any() else verdict.flags
    is_rewired = _rewired(wiring, volts * np.sign(predicted), noise)
    if is_rewired or deviation(volts, predicted, noise, verdict.usable) > MAX_DEVIATION:
        flags |= Flag.REFERENCE_MISMATCH
    if _asymmetry(wiring, volts) > max_asymmetry:
        flags |= Flag.NOISE_HIGH
    return Verdict(verdict.usable, flags, verdict.electrodes)


def _rewired(wiring: Wiring, along: FloatArray, noise: FloatArray) -> bool:
    """Tell whether reciprocal voltages agree on a wrong sign: leads that changed places."""
    against = wiring.ordered & (along < -OUTLIER * noise)
    i, j = wiring.reciprocal.T
    agree = np.abs(along[i] - along[j]) < 0.5 * np.abs(along[i] + along[j])
    return int(np.count_nonzero(against[i] & against[j] & agree)) >= MIN_FAULTY_VOLTAGES


def deviation(
    volts: FloatArray, predicted: FloatArray, noise: FloatArray, usable: BoolArray
) -> float:
    """How far a reference (M,) is from the model, rms: 1 is what an uneven sheet leads to."""
    uneven = 0.05  # standard deviation of a good reference about the model
    error = (volts - predicted) / np.hypot(noise, uneven * np.abs(predicted))
    return float(np.sqrt(np.mean(error[usable] ** 2))) if usable.any() else np.inf


def _asymmetry(wiring: Wiring, volts: FloatArray) -> float:
    """Typical difference of reciprocal voltages as a share of the voltages' root mean square."""
    if len(wiring.reciprocal) == 0:
        return 0.0
    i, j = wiring.reciprocal.T
    spread = robust_sigma(volts[i] - volts[j])
    return spread / max(float(np.sqrt(2 * np.mean(volts**2))), TINY)


def asymmetry_of(wiring: Wiring, reference: FloatArray) -> FloatArray:
    """Difference of a device's reciprocal voltages over their sum, (pairs,): unequal gains."""
    i, j = wiring.reciprocal.T
    difference, total = reference[i] - reference[j], reference[i] + reference[j]
    share = np.divide(difference, total, out=np.zeros_like(total), where=total != 0)
    return np.asarray(np.clip(share, -1, 1))

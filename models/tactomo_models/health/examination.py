"""What many scans of a skin at rest show together: noise, what moves, and each electrode's state.

What is a fault of a scan is defined in `plausibility`. Many scans tell more: how noisy each voltage
is, a lead that is loose now and then, two leads that changed places.
"""

from __future__ import annotations

import itertools

import numpy as np

from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.health.lead_order import Order, find_order
from tactomo_models.physics.bare_sheet import scan_voltages
from tactomo_models.scans.plausibility import (
    TINY,
    Flag,
    Layout,
    ScanCheck,
    Wiring,
    asymmetry_of,
    examine_reference,
)
from tactomo_models.scans.polarity import Polarity
from tactomo_models.scans.reference import variance_about_line
from tactomo_models.sensor.description import SensorDescription

MIN_SCANS_FOR_NOISE = 5  # a standard deviation to a third
STILLEST = 20  # scans that are looked at where the others move: those of a tare
STILL = 1e-3  # movement over the voltages, rms, that a skin at rest does not reach in a second
SIGNIFICANT = 4.0  # standard deviations, or times the noise that is usual
DEAD_SHARE = 0.1  # of the size expected: less is next to nothing
BROKEN_SHARE = 1 / 3  # of the electrodes: so many are not broken one by one


class Examination:
    """All that is worked out from the scans of one channel, before it is put into words."""

    def __init__(
        self,
        wiring: Wiring,  # of the layout
        layout: Layout,  # the sensor's description, or its pattern alone
        scans: FloatArray,  # (T, M) volts
        still: slice,  # those in which nothing moves; loose leads are looked for in all
        # (L, L) transfer resistances of the sheet's model, if there is one
        transfer: FloatArray | None,
        contrast: float,  # factor by which pressing changes conductivity at most
    ) -> None:
        self.wiring = wiring
        self.pairs = layout.pairs
        at_rest = scans[still]
        self.count = len(at_rest)  # scans at rest
        self.mean = at_rest.mean(axis=0)  # (M,) of the scans at rest, volts
        self.noise = noise_about_line(at_rest)  # (M,) standard deviation of a scan; 0 where unknown
        # whether something moves even in the stillest scans
        self.is_moving = moves(wiring, at_rest)
        # whether the noise is known
        self.has_noise = self.count >= MIN_SCANS_FOR_NOISE and not self.is_moving
        # whether scan after scan is the same to the last bit
        self.is_frozen = self.count >= 3 and not self.noise.any()
        # (M,) of each voltage; NaN where unknown
        self.snr_db = _decibels(np.abs(self.mean), self.noise)
        excess = _excess_noise(self.mean, self.noise)
        # (L,) how many times noisier than the others the voltages of each are
        self.electrode_noise = np.array([np.median(excess[t]) for t in self.wiring.electrodes])
        of_mean = self.noise / np.sqrt(self.count)
        # (M,) voltages that the instrument reads at all
        self.sought = np.ones(len(layout.pairs.drive), dtype=bool)
        if isinstance(layout, SensorDescription) and transfer is not None:
            self.sought = Polarity(layout, wiring, scan_voltages(layout, transfer)).certain
            # which leads are not where they belong
            self.order = find_order(layout, transfer, self.mean, of_mean, self.sought)
        else:
            self.order = Order((), 0, _likes(layout, self.mean))
        expected = self.order.expected
        if (scans >= 0).all():  # a device that reports sizes alone
            expected = np.abs(expected)
        # what is wrong with the mean scan
        self.verdict = examine_reference(
            self.wiring, self.mean, expected, of_mean, contrast, self.sought
        )
        self.later = self._each(scans, contrast)  # flags and bad electrodes of every single scan
        # of each electrode: good, dead, loose, misread or swapped
        self.states = self._states(layout.electrode_count, excess, expected)
        # (M,) voltages that no bad electrode has part in; all where most are bad
        self.good = self._good()

    def _each(self, scans: FloatArray, contrast: float) -> list[tuple[Flag, tuple[int, ...]]]:
        """What is wrong with each single scan, by laws that hold whatever presses."""
        bad = list(self.verdict.electrodes)
        usable = (self.mean != 0) & self.sought & ~self.wiring.electrodes[bad].any(axis=0)
        own = asymmetry_of(self.wiring, self.mean)
        check = ScanCheck(self.wiring, self.mean, self.noise, usable, contrast, own)
        verdicts = [check.examine(scan) for scan in scans]
        return [(verdict.flags, verdict.electrodes) for verdict in verdicts]

    def _states(self, count: int, excess: FloatArray, expected: FloatArray) -> list[str]:
        if not self.verdict.usable.any():
            return ["dead"] * count
        states = ["good"] * count
        noisy = (
            set(self.wiring.faulty_electrodes(excess > SIGNIFICANT)) if self.has_noise else set()
        )
        hits = np.bincount([e for _, found in self.later for e in found] or [0], minlength=count)
        loose = noisy | set(np.flatnonzero(hits > 1).tolist() if any(hits) else [])
        scale = _scale(self.mean, expected)
        for electrode in {*self.verdict.electrodes, *loose}:
            touched = self.wiring.electrodes[electrode]
            share = np.abs(self.mean[touched]) / np.maximum(scale * np.abs(expected[touched]), TINY)
            is_dead = float(np.median(share)) < DEAD_SHARE
            states[electrode] = "dead" if is_dead else "loose" if electrode in loose else "misread"
        for electrode in itertools.chain(*self.order.exchanged):
            states[electrode] = "swapped"
        return states

    def _good(self) -> BoolArray:
        """Voltages (M,) that no bad electrode has part in; all where most electrodes are bad."""
        bad = [n for n, state in enumerate(self.states) if state not in ("good", "swapped")]
        good = self.sought & ~self.wiring.electrodes[bad].any(axis=0)
        few = len(bad) > BROKEN_SHARE * len(self.states)
        return self.sought if few or not good.any() else good


def noise_about_line(scans: FloatArray) -> FloatArray:
    """Standard deviation (M,) of scans (n, M) about a straight line in time; 0 where unknown."""
    if len(scans) < 3:
        return np.zeros(scans.shape[1])
    noise = np.sqrt(variance_about_line(scans))
    return np.asarray(np.where(noise > 1e-12 * np.abs(scans).max(), noise, 0.0))


def _decibels(signal: FloatArray, noise: FloatArray) -> FloatArray:
    known = (noise > 0) & (signal > 0)
    ratio = np.divide(signal, noise, out=np.ones_like(signal), where=known)
    return np.where(known, 20 * np.log10(ratio), np.nan)


def rms(values: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def _scale(volts: FloatArray, expected: FloatArray) -> float:
    """Factor from what is expected to what is read, whatever the units."""
    known = expected != 0
    return float(np.median(np.abs(volts[known] / expected[known]))) if known.any() else 1.0


def stillest(wiring: Wiring, scans: FloatArray) -> slice:
    """The scans to look at: all of them, or the stillest few where the others move."""
    if len(scans) <= STILLEST or not moves(wiring, scans):
        return slice(0, len(scans))
    starts = range(0, len(scans) - STILLEST + 1, STILLEST // 2)
    sigmas = [rms(scans[n : n + STILLEST].std(axis=0)) for n in starts]
    first = starts[int(np.argmin(sigmas))]
    return slice(first, first + STILLEST)


def moves(wiring: Wiring, scans: FloatArray) -> bool:
    """Tell what changes on the sheet from noise.

    Noise differs from scan to scan, and in both of two reciprocal voltages. What presses goes on
    from scan to scan and changes both alike, as do small unsteady gains, which are let pass.
    """
    if len(scans) < MIN_SCANS_FOR_NOISE:
        return False
    sigma, size = rms(noise_about_line(scans)), rms(scans)

    def is_beyond(noise: float, still: float) -> bool:
        return sigma**2 - noise**2 > max(still * size, SIGNIFICANT * noise) ** 2

    i, j = wiring.reciprocal.T
    unequal = rms(noise_about_line(scans[:, i] - scans[:, j])) if len(i) else sigma
    return is_beyond(rms(np.diff(scans, axis=0)) / np.sqrt(2), STILL) or is_beyond(
        unequal / np.sqrt(2), 10 * STILL
    )


def _likes(layout: Layout, volts: FloatArray) -> FloatArray:
    """Voltages (M,) as the median of those that lie alike to their drive, further round the rim."""
    drive, measure = layout.pairs.drive, layout.pairs.measure
    turned = (np.column_stack([drive[:, 1], measure]) - drive[:, :1]) % layout.electrode_count
    expected = np.empty_like(volts)
    for kind in np.unique(turned, axis=0):
        alike = (turned == kind).all(axis=1)
        expected[alike] = np.median(volts[alike])
    return np.where(expected == 0, np.median(np.abs(volts)) or 1.0, expected)


def _excess_noise(volts: FloatArray, noise: FloatArray) -> FloatArray:
    """Noise (M,) over what is usual at a voltage's size: a floor, and a share of the voltage."""
    size = np.abs(volts)
    small = size <= np.median(size)
    floor = float(np.median(noise[small]))
    share = float(np.median(noise[~small] / size[~small])) if not small.all() else 0.0
    usual = np.hypot(floor, share * size)
    return np.divide(noise, usual, out=np.ones_like(noise), where=usual > 0)

"""One channel's baseline: how far it is from the tare, as far as skins drift and no further.

When it follows, and how, is decided in `baseline`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.drift.drift_model import OUT_OF_BOUNDS, DriftSubspace, Explained
from tactomo_models.robust import robust_sigma
from tactomo_models.scans.changes import Changes

BLOCK_S: Final = 5.0  # frames are averaged over so long before they count
GAIN_PER_S: Final = 0.01 / 60  # standard deviation of what temperature does to a sheet
GAIN_SHARE: Final = 1 / 6  # of the time constant, for a gain: it holds no contact
SMOOTH_PER_S: Final = 0.0002 / 60  # likewise, of conductivity that wanders smoothly
MAX_GAIN: Final = 0.5  # since the tare: beyond, something else has happened
MAX_SMOOTH: Final = 0.1
MAX_RESIDUAL: Final = 1.0  # rms of what no drift explains, in standard deviations of one scan


@dataclass(frozen=True)
class Drift:
    """How far a channel's baseline has moved since the tare."""

    gain: float  # common relative change of its voltages
    uneven: float  # root mean square of their relative changes beyond that


class ChannelBaseline:
    """One channel's baseline: logarithms of factors on its tare, split into modes and a residual.

    Args:
        subspace: the modes of the sensor's drift.
        tare: (M,) volts.
        usable: (M,) voltages that it is right about; nothing is learned from the others.
    """

    def __init__(self, subspace: DriftSubspace, tare: FloatArray, usable: BoolArray) -> None:
        self._subspace = subspace
        usable = usable & (tare != 0)
        self._per_tare = np.divide(1.0, tare, out=np.zeros_like(tare), where=usable)
        self._now = np.zeros(len(tare))  # as it is known; what is in force follows in steps
        self._in_force = self._now
        # whether what is in force is behind what is known by more than is worth a change
        self.has_moved = False
        self._amounts = np.zeros(subspace.modes.shape[1])
        self._most = np.full_like(self._amounts, np.inf)  # that skins reach since the tare
        self._most[0], self._most[subspace.smooth] = MAX_GAIN, MAX_SMOOTH
        self._residual = np.zeros(len(tare))
        self._jumped = np.zeros(len(tare))  # beside creep, since something was let go that creeps
        self._precision = self._noise_variance = np.zeros(len(tare))
        self._seen_s = self._gain_seen_s = self._jumped_s = 0.0
        self._begun_s: float | None = None
        self.drop_block()

    def begin(self, time_s: float) -> None:
        """The baseline is right at this time."""
        self._seen_s = self._gain_seen_s = time_s

    def drop_block(self) -> None:
        """Forget the frames that are being averaged, and what a gain is measured from."""
        self._sum, self._frames = np.zeros_like(self._now), 0
        self._begun_s = None
        self._anchor: FloatArray | None = None
        self._anchor_amounts, self._anchored_s = np.zeros_like(self._amounts), 0.0

    def add(self, time_s: float, scan: FloatArray | None, measured: Changes) -> bool:
        """Take a scan (M,), volts, into the block; returns whether it is full."""
        assert scan is not None
        if self._begun_s is None:
            self._begun_s = time_s
        self._sum += scan
        self._frames += 1
        self._precision, self._noise_variance = measured.precision, measured.noise_variance
        return abs(time_s - self._begun_s) >= BLOCK_S

    def _take_block(self, time_s: float) -> FloatArray:
        """Mean (M,) of the block over the tare; the next block begins."""
        mean = self._sum * self._per_tare / self._frames
        self._sum, self._frames, self._begun_s = np.zeros_like(mean), 0, time_s
        return mean

    def follow(self, time_s: float, creep: FloatArray, time_constant_s: float) -> bool:
        """Move towards the block's mean; returns whether all of the move is like drift."""
        elapsed_s = max(0.0, time_s - self._seen_s)
        share = -np.expm1(-elapsed_s / time_constant_s)
        ahead = -np.expm1(-elapsed_s / (GAIN_SHARE * time_constant_s)) - share
        sigma = self._prior(time_s, creep, time_constant_s)
        change = self._since(self._take_block(time_s))
        found = self._explain(change + self._residual, self._precision, sigma)
        bounds = OUT_OF_BOUNDS * sigma
        wanted = self._kept() + np.clip(found.amounts, -bounds, bounds)
        missing = np.clip(wanted, -self._most, self._most) - self._amounts
        self._amounts = self._amounts + share * missing
        self._amounts[0] += ahead * missing[0]
        drift = self._subspace.modes @ self._amounts
        residual = self._now + share * change + ahead * missing[0] - drift
        size = float(np.sqrt(np.mean(self._precision * residual**2)))
        self._residual = residual * min(1.0, MAX_RESIDUAL / max(size, 1e-12))
        if not creep.any():
            self._jumped = np.zeros_like(drift)
        self._know(drift + self._residual)
        self._seen_s = self._gain_seen_s = time_s
        return size < MAX_RESIDUAL and self._excess(wanted) < 1

    def follow_under_contact(self, time_s: float, creep: FloatArray) -> None:
        """Follow the factor that all voltages of a still contact share since its anchor.

        Beside it what is smooth, as far as skins drift in that time and creep does not explain it.
        """
        frames, mean = self._frames, self._take_block(time_s)
        if self._anchor is None:
            self._drop_anchor(time_s, mean)
            return
        gain, is_common = self._common_factor(mean, self._anchor, frames)
        step = gain - self._anchor_amounts[0]
        reach = OUT_OF_BOUNDS * GAIN_PER_S * max(BLOCK_S, time_s - self._gain_seen_s)
        if not is_common or abs(step) > reach or abs(self._amounts[0] + step) > MAX_GAIN:
            self._drop_anchor(time_s, mean)
            return
        found = self._smooth_since_anchor(time_s, mean, gain, creep)
        step_of_all = found - self._anchor_amounts
        self._anchor_amounts = found
        self._amounts = self._amounts + step_of_all
        self._know(self._now + self._subspace.modes @ step_of_all)
        self._gain_seen_s = time_s

    def _drop_anchor(self, time_s: float, mean: FloatArray) -> None:
        """Measure from here on; what has been followed so far stays."""
        self._anchor, self._anchored_s = mean, time_s
        self._anchor_amounts = np.zeros_like(self._amounts)

    def _smooth_since_anchor(
        self, time_s: float, mean: FloatArray, gain: float, creep: FloatArray
    ) -> FloatArray:
        """Amounts (K,) of the gain and of what is smooth since the anchor; creep takes its part."""
        assert self._anchor is not None
        sigma = creep.copy()
        sigma[self._subspace.smooth] = SMOOTH_PER_S * max(0.0, time_s - self._anchored_s)
        valid = (mean > 0) & (self._anchor > 0)
        ratio = np.divide(mean, self._anchor, out=np.ones_like(mean), where=valid)
        change = np.where(valid, np.log(ratio) - gain, 0.0)
        found = self._subspace.explain(change, self._precision * valid, sigma)
        bounds = OUT_OF_BOUNDS * sigma
        amounts = np.clip(found.amounts, -bounds, bounds)
        amounts[self._subspace.cells] = 0.0
        amounts[0] = gain
        return amounts

    def _common_factor(
        self, mean: FloatArray, anchor: FloatArray, frames: int
    ) -> tuple[float, bool]:
        """Logarithm of the factor between two blocks, and whether the voltages agree on one."""
        uneven_share = 0.25  # of a factor, by which voltages may miss it and still share it
        still = 1e-3  # spread of voltages' changes that a still contact's creep may have
        sure = self._precision >= np.median(self._precision)
        sure &= (mean > 0) & (anchor > 0)
        if not sure.any():
            return 0.0, False
        each = np.log(mean[sure] / anchor[sure])
        gain = float(np.median(each))
        sigma = robust_sigma(each - gain)
        noise = np.sqrt(self._noise_variance[sure]) / mean[sure]
        doubt = float(np.median(noise)) * np.sqrt(2 / frames)
        return gain, sigma < max(uneven_share * abs(gain), 3 * doubt, still)

    def explain(
        self,
        time_s: float,
        scan: FloatArray | None,
        measured: Changes,
        creep: FloatArray,
        time_constant_s: float,
    ) -> Explained:
        """What drift makes of a scan (M,), volts, that is not quiet."""
        assert scan is not None
        change = self._since(scan * self._per_tare)
        sigma = self._prior(time_s, creep, time_constant_s)
        found = self._explain(change, measured.precision, sigma)
        excess = max(found.excess, self._excess(self._kept() + found.amounts))
        return replace(found, excess=excess)

    def jump(self, time_s: float, found: Explained, creep: FloatArray) -> None:
        """The baseline is where a scan was explained to be, beside or without creep."""
        before, self._amounts = self._kept(), self._kept() + found.amounts
        if creep.any():
            self._jumped = self._jumped + self._subspace.modes @ (self._kept() - before)
        self._know(self._subspace.modes @ self._amounts + self._residual)
        self._seen_s = self._gain_seen_s = self._jumped_s = time_s

    def _since(self, over_tare: FloatArray) -> FloatArray:
        """Logarithms (M,) of voltages over the baseline; 0 where there is none."""
        farthest = (0.3, 3.0)  # factors between which a voltage is taken as what it is
        ratio = np.where(self._per_tare != 0, over_tare * np.exp(-self._now), 1.0)
        return np.asarray(np.log(np.clip(ratio, *farthest)))

    def _kept(self) -> FloatArray:
        """What drift of a gain and of smooth fields adds to; creep is told as a whole."""
        kept = self._amounts.copy()
        kept[self._subspace.cells] = 0.0
        return kept

    def _explain(self, change: FloatArray, precision: FloatArray, sigma: FloatArray) -> Explained:
        return self._subspace.explain(change + self._crept(), precision, sigma)

    def _crept(self) -> FloatArray:
        """Logarithms (M,) of the factors that creep has on the tare."""
        cells = self._subspace.cells
        return np.asarray(self._subspace.modes[:, cells] @ self._amounts[cells])

    def _prior(self, time_s: float, creep: FloatArray, lag_s: float) -> FloatArray:
        """Standard deviations (K,) of the modes.

        The reference may lag behind what it saw last; a jump makes up for all of that.
        """
        gain_at_once = 0.1  # ... however long nobody looked
        smooth_at_once = 0.02
        sigma = creep.copy()
        lag_s = min(lag_s, max(0.0, time_s - self._jumped_s))
        gain_s = max(0.0, time_s - self._gain_seen_s) + GAIN_SHARE * lag_s
        sigma[0] = min(GAIN_PER_S * gain_s, gain_at_once)
        smooth = SMOOTH_PER_S * (max(0.0, time_s - self._seen_s) + lag_s)
        sigma[self._subspace.smooth] = min(smooth, smooth_at_once)
        return sigma

    def _excess(self, amounts: FloatArray) -> float:
        """How far beyond all that skins reach amounts (K,) since the tare are; good below 1."""
        return float((np.abs(amounts) / self._most).max())

    def _know(self, baseline: FloatArray) -> None:
        min_move = 0.05  # rms, in standard deviations of one scan, that is worth a new one
        self._now = baseline
        behind = self._precision * (baseline - self._in_force) ** 2
        self.has_moved = bool(behind.mean() > min_move**2)

    def put_in_force(self) -> tuple[FloatArray, FloatArray]:
        """The baseline (M,) as it is known, and the part that may be a touch: in force from now."""
        self._in_force, self.has_moved = self._now, False
        return self._now, self._residual + self._crept() + self._jumped

    def drift(self) -> Drift:
        """How far what is in force is from the tare."""
        weight = self._precision / max(float(self._precision.sum()), 1e-300)
        gain = float(weight @ self._in_force)
        uneven = float(np.sqrt(weight @ (self._in_force - gain) ** 2))
        return Drift(float(np.expm1(gain)), uneven)

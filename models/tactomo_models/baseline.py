"""Baseline tracking: a reference that follows a skin's drift, and never what presses on it.

Temperature scales a whole sheet, conductivity wanders smoothly across it, and what was pressed
stays a little more conductive for a while (creep, logarithmic in time). Against a reference of
this morning that is a ghost by noon.

*Nothing presses*: the reference follows what is seen, by a first-order low pass. What it has
followed is split into what skins do (see `drift`) and an unexplained rest. Both are bounded, so
that a touch that comes up slowly is not learned.

*Something presses*: nothing is followed but a common gain, seen as a factor that all voltages
share between two times of a contact that is still. A factor cannot hold a contact.

*Something was let go*: what is left is held against what drift may have done since. If it explains
the data to their noise, by amounts that skins reach in that time, the reference is there at once.
Only a signal that has just dropped is asked so: a contact that stays is none.

What passes as neither is shown as it is, and `refusal` says so. Time is the frames' own: equal
frames lead to equal references.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from tactomo_models.artifact import MODEL_ERROR
from tactomo_models.changes import Changes
from tactomo_models.description import Modality, SensorDescription
from tactomo_models.drift import OUT_OF_BOUNDS, DriftSubspace, Explained
from tactomo_models.plausibility import Flag
from tactomo_models.reconstruct import Look, Reconstruction, Reconstructor
from tactomo_models.reference import Reference

FloatArray = NDArray[np.float64]
State = Literal["waiting", "following", "held", "refused"]
Scans = dict[Modality, FloatArray | None]

TIME_CONSTANT_S: Final = 60.0  # by which the reference follows while nothing presses
BLOCK_S: Final = 5.0  # frames are averaged over so long before they count
MOVE_S: Final = 10.0  # least time between two references, unless something was let go
LEAST_MOVE: Final = 0.05  # rms, in standard deviations of one scan, that is worth a new one

GAIN_PER_S: Final = 0.01 / 60  # standard deviation of what temperature does to a sheet
GAIN_SHARE: Final = 1 / 6  # of the time constant, for a gain: it holds no contact
GAIN_AT_ONCE: Final = 0.1  # ... however long nobody looked
SMOOTH_PER_S: Final = 0.0002 / 60  # likewise, of conductivity that wanders smoothly
SMOOTH_AT_ONCE: Final = 0.02
CREEP: Final = 0.01  # of the bare conductivity that a decade of time under pressure leaves
CREEP_BEGIN_S: Final = 1.0
FORGOTTEN: Final = 0.1  # decades of it that are worth no memory
COVERED: Final = 0.05  # share pressed from which a cell counts as pressed
MOST_GAIN: Final = 0.5  # since the tare: beyond, something else has happened
MOST_SMOOTH: Final = 0.1
MOST_REST: Final = 1.0  # rms of what no drift explains, in standard deviations of one scan

DROPPED: Final = 0.5  # of its usual signal, below which something was let go
USUAL_S: Final = 10.0  # over which "usual" is taken
SETTLING_S: Final = 30.0  # after that, in which what is left may be drift
DOUBTFUL: Final = 1.5  # times the bounds, from which what is left is certainly a contact
DISTRUSTED_S: Final = 30.0  # of frames that nothing explains, before that is said
UNEVEN_SHARE: Final = 0.25  # of a factor, by which voltages may miss it and still share it
FARTHEST: Final = (0.3, 3.0)  # factors between which a voltage is taken as what it is
STILL: Final = 1e-3  # spread of voltages' changes that a still contact's creep may have
NORMAL_MEDIAN: Final = 0.6745  # standard deviations that hold half of a normal distribution
DISTRUST: Final = Flag.MISFIT_HIGH | Flag.REFERENCE_MISMATCH | Flag.LOW_CONFIDENCE

STRAY = "the {} channel moves at rest as no skin drifts: maybe a touch that comes up slowly"
FAINT = "what a contact left behind is a faint touch, or a skin that has drifted"
NEITHER = "what is seen is no contact that explains it, and no drift that skins reach"


@dataclass(frozen=True)
class Drift:
    """How far a channel's baseline has moved since the tare.

    Attributes:
        gain: common relative change of its voltages.
        uneven: root mean square of their relative changes beyond that.
    """

    gain: float
    uneven: float


class BaselineTracker:
    """Reconstructs frames against a reference that follows the skin.

    Args:
        reconstructor: is given the references, from `begin` on by nobody else.
        time_constant_s: by which the reference follows while nothing presses.

    Attributes:
        reference: the one in force; None before the first tare.
        moves: how often the reference has moved since the tare.
        refusal: why what is seen is not followed; empty while it is, or may be a contact.

    Not thread-safe: one thread owns it.
    """

    def __init__(
        self, reconstructor: Reconstructor, time_constant_s: float = TIME_CONSTANT_S
    ) -> None:
        self.reference: Reference | None = None
        self.moves = 0
        self.refusal = ""
        self._reconstructor = reconstructor
        self._time_constant_s = time_constant_s
        self._subspace = DriftSubspace(reconstructor.description, reconstructor.artifact)
        self._memory = PressMemory(reconstructor.description, self._subspace)
        self._channels: dict[Modality, _Channel] = {}
        self._release = _Release()
        self._is_ready = self._is_held = False
        self._moved_s = self._last_s = 0.0
        self._distrusted_s: float | None = None

    def begin(self, reference: Reference) -> Reference:
        """Measure against a reference, and follow from there; returns it as it is in force.

        Where it had drifted itself, that is as good as a tare.
        """
        self.reference = reference = reference.taken_as_it_is()
        self._reconstructor.set_reference(reference)
        self._channels = {
            name: _Channel(self._subspace, tare)
            for name in self._reconstructor.description.modalities
            if (tare := getattr(reference, name)) is not None
        }
        self._memory.clear()
        self._release = _Release()
        self._is_ready = self._is_held = False
        self.refusal, self._distrusted_s, self.moves = "", None, 0
        return reference

    @property
    def state(self) -> State:
        """What it does: wait for a first good frame, follow, hold under contact, or refuse."""
        if not self._is_ready:
            return "waiting"
        if self.refusal:
            return "refused"
        return "held" if self._is_held else "following"

    @property
    def drift(self) -> dict[Modality, Drift]:
        """How far each channel's baseline has moved since the tare."""
        return {name: channel.drift() for name, channel in self._channels.items()}

    def reconstruct(
        self,
        time_s: float,
        magnitude: FloatArray | None,
        structure: FloatArray | None,
        *,
        saturated: Collection[Modality] = (),
    ) -> Reconstruction:
        """Reconstruct one frame; before, the reference moves if need be.

        Args:
            time_s: when it was acquired, on any steady clock.
            magnitude: (M,) volts; None if that scan is missing.
            structure: (M,) volts; None if that scan is missing.
            saturated: channels whose device says that its converter clipped this scan.

        Raises:
            DataError: a scan has another number of voltages than the sensor.
        """
        scans: Scans = {"magnitude": magnitude, "structure": structure}
        if time_s - self._moved_s >= MOVE_S and any(c.has_moved for c in self._channels.values()):
            self._move(time_s)
        look = self._reconstructor.look(magnitude, structure, saturated=saturated)
        if self._settles(time_s, look, scans):
            self._move(time_s)
            look = self._reconstructor.look(magnitude, structure, saturated=saturated)
        frame = self._reconstructor.image(look)
        if self.reference is not None:
            self._take_note(time_s, look, frame, scans)
        return frame

    def _move(self, time_s: float) -> None:
        """Put the baseline as it is now in force."""
        assert self.reference is not None
        drift = {name: channel.put_in_force() for name, channel in self._channels.items()}
        self.reference = replace(
            self.reference,
            magnitude_drift=drift.get("magnitude"),
            structure_drift=drift.get("structure"),
        )
        self._reconstructor.set_reference(self.reference)
        self._moved_s = time_s
        self.moves += 1

    def _settles(self, time_s: float, look: Look, scans: Scans) -> bool:
        """Whether what is seen is nothing but drift; if so, the baseline is there now."""
        if not self._is_ready or look.is_quiet or look.flags & ~Flag.REFERENCE_MISMATCH:
            return False
        if look.data.keys() != self._channels.keys():
            return False
        if self._is_held and not self._release.is_on(time_s, _signal(look)):
            return False
        found = {
            name: channel.explain(
                time_s,
                scans[name],
                look.data[name],
                self._memory.creep(time_s, name),
                self._time_constant_s,
            )
            for name, channel in self._channels.items()
        }
        if all(each.misfit < 1 and each.excess < 1 for each in found.values()):
            for name, channel in self._channels.items():
                channel.jump(time_s, found[name])
            self._let_go()
            return True
        if self._is_held and all(max(e.misfit, e.excess) < DOUBTFUL for e in found.values()):
            self.refusal = FAINT
        return False

    def _let_go(self) -> None:
        self._is_held, self.refusal, self._distrusted_s = False, "", None
        self._release = _Release()
        self._drop_blocks()

    def _take_note(self, time_s: float, look: Look, frame: Reconstruction, scans: Scans) -> None:
        """Learn from a frame; what follows from it is in force from the next one on."""
        elapsed_s = max(0.0, time_s - self._last_s) if self._is_ready else 0.0
        self._last_s = time_s
        self._memory.add(time_s, elapsed_s, frame)
        if look.is_quiet and not frame.flags:
            self._follow(time_s, look, scans)
        elif look.is_quiet or not look.data:
            self._drop_blocks()  # it says nothing of the baseline
        elif self._is_ready:
            self._hold(time_s, elapsed_s, look, frame, scans)

    def _follow(self, time_s: float, look: Look, scans: Scans) -> None:
        if self._is_held or not self._is_ready:
            if not self._is_ready:
                for channel in self._channels.values():
                    channel.begin(time_s)
            self._let_go()
            self._is_ready = True
        self._distrusted_s = None
        for name, channel in self._channels.items():
            if not channel.add(time_s, scans[name], look.data[name]):
                continue
            creep = self._memory.creep(time_s, name)
            if channel.follow(time_s, creep, self._time_constant_s):
                self.refusal = ""
            else:
                self.refusal = STRAY.format(name)

    def _hold(
        self, time_s: float, elapsed_s: float, look: Look, frame: Reconstruction, scans: Scans
    ) -> None:
        if not self._is_held:
            self._drop_blocks()
            self._is_held = True
        self._release.add(time_s, elapsed_s, _signal(look))
        self._note_distrust(time_s, frame)
        for name, channel in self._channels.items():
            if name not in look.data or look.flags & ~DISTRUST:
                channel.drop_block()
            elif channel.add(time_s, scans[name], look.data[name]):
                channel.follow_under_contact(time_s, self._memory.creep(time_s, name))

    def _note_distrust(self, time_s: float, frame: Reconstruction) -> None:
        if not frame.flags & DISTRUST:
            self._distrusted_s = None
        elif self._distrusted_s is None:
            self._distrusted_s = time_s
        elif time_s - self._distrusted_s > DISTRUSTED_S:
            self.refusal = NEITHER

    def _drop_blocks(self) -> None:
        for channel in self._channels.values():
            channel.drop_block()


def _signal(look: Look) -> float:
    return max(taken.signal for taken in look.data.values())


class _Release:
    """Notices when something is let go: the signal falls far below what it was a moment ago."""

    def __init__(self) -> None:
        self._usual = 0.0
        self._until_s: float | None = None

    def is_on(self, time_s: float, signal: float) -> bool:
        """Whether something is being let go, or was so a moment ago."""
        if self._usual and signal < DROPPED * self._usual:
            return True
        return self._until_s is not None and time_s < self._until_s

    def add(self, time_s: float, elapsed_s: float, signal: float) -> None:
        """Take note of a frame in which something presses."""
        if self._usual and signal < DROPPED * self._usual:
            self._until_s, self._usual = time_s + SETTLING_S, signal
        share = -np.expm1(-elapsed_s / USUAL_S)
        self._usual = self._usual + share * (signal - self._usual) if self._usual else signal


class PressMemory:
    """Which cells of the sheet were pressed, for how long, and how long ago."""

    def __init__(self, description: SensorDescription, subspace: DriftSubspace) -> None:
        self._strength = {
            name: min(1.0, description.contrast(name) - 1) for name in description.modalities
        }
        self._cell_of_map = subspace.cell_of_map.ravel()
        self._sigma = np.zeros(subspace.modes.shape[1])
        self._cells = subspace.cells
        self._count = np.maximum(np.bincount(self._cell_of_map, minlength=self._number), 1)
        self.clear()

    @property
    def _number(self) -> int:
        return int(self._cells.stop - self._cells.start)

    def clear(self) -> None:
        """Forget all."""
        self._pressed_s = np.zeros(self._number)
        self._left_s = np.zeros(self._number)  # when each cell was last pressed

    def add(self, time_s: float, elapsed_s: float, frame: Reconstruction) -> None:
        """Take note of what a frame shows as pressed."""
        image = frame.map if frame.structure is None else frame.structure
        if not frame.contacts or image is None:
            return
        share = np.abs(image.ravel())
        if frame.structure is None:
            share = share / max(float(share.max()), 1e-12)
        cells = np.bincount(self._cell_of_map, share, minlength=self._number) / self._count
        pressed = cells > COVERED
        self._pressed_s[pressed] += max(elapsed_s, CREEP_BEGIN_S)
        self._left_s[pressed] = time_s

    def creep(self, time_s: float, name: Modality) -> FloatArray:
        """Standard deviations (K,) of what may be left of it now; 0 for all other modes."""
        ago_s = np.maximum(time_s - self._left_s, 0.0) + CREEP_BEGIN_S
        decades = np.log10(1 + self._pressed_s / ago_s)
        self._pressed_s[decades < FORGOTTEN] = 0.0
        sigma = np.zeros_like(self._sigma)
        sigma[self._cells] = CREEP * self._strength[name] * decades * (decades >= FORGOTTEN)
        return sigma


class _Channel:
    """One channel's baseline: logarithms of factors on its tare, split into modes and a rest.

    Attributes:
        has_moved: whether what is in force is behind what is known by more than is worth a change.
    """

    def __init__(self, subspace: DriftSubspace, tare: FloatArray) -> None:
        self._subspace = subspace
        self._per_tare = np.divide(1.0, tare, out=np.zeros_like(tare), where=tare != 0)
        self._now = np.zeros(len(tare))  # as it is known; what is in force follows in steps
        self._in_force = self._now
        self.has_moved = False
        self._amounts = np.zeros(subspace.modes.shape[1])
        self._rest = np.zeros(len(tare))
        self._certainty = np.zeros(len(tare))
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

    def add(self, time_s: float, scan: FloatArray | None, taken: Changes) -> bool:
        """Take a scan (M,), volts, into the block; returns whether it is full."""
        assert scan is not None
        if self._begun_s is None:
            self._begun_s = time_s
        self._sum += scan
        self._frames += 1
        self._certainty = taken.certainty
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
        found = self._explain(change + self._rest, self._certainty, sigma)
        bounds = OUT_OF_BOUNDS * sigma
        wanted = self._kept() + np.clip(found.amounts, -bounds, bounds)
        missing = self._limited(wanted) - self._amounts
        self._amounts = self._amounts + share * missing
        self._amounts[0] += ahead * missing[0]
        drift = self._subspace.modes @ self._amounts
        rest = self._now + share * change + ahead * missing[0] - drift
        size = float(np.sqrt(np.mean(self._certainty * rest**2)))
        self._rest = rest * min(1.0, MOST_REST / max(size, 1e-12))
        self._know(drift + self._rest)
        self._seen_s = self._gain_seen_s = time_s
        return size < MOST_REST and self._excess(wanted) < 1

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
        if not is_common or abs(step) > reach or abs(self._amounts[0] + step) > MOST_GAIN:
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
        found = self._subspace.explain(change, self._certainty * valid, sigma)
        bounds = OUT_OF_BOUNDS * sigma
        amounts = np.clip(found.amounts, -bounds, bounds)
        amounts[self._subspace.cells] = 0.0
        amounts[0] = gain
        return amounts

    def _common_factor(
        self, mean: FloatArray, anchor: FloatArray, frames: int
    ) -> tuple[float, bool]:
        """Logarithm of the factor between two blocks, and whether the voltages agree on one."""
        sure = self._certainty >= np.median(self._certainty)
        sure &= (mean > 0) & (anchor > 0)
        if not sure.any():
            return 0.0, False
        each = np.log(mean[sure] / anchor[sure])
        gain = float(np.median(each))
        spread = float(np.median(np.abs(each - gain))) / NORMAL_MEDIAN
        noise = np.sqrt(np.maximum(1 / self._certainty[sure] - MODEL_ERROR**2, 0)) / mean[sure]
        doubt = float(np.median(noise)) * np.sqrt(2 / frames)
        return gain, spread < max(UNEVEN_SHARE * abs(gain), 3 * doubt, STILL)

    def explain(
        self,
        time_s: float,
        scan: FloatArray | None,
        taken: Changes,
        creep: FloatArray,
        time_constant_s: float,
    ) -> Explained:
        """What drift makes of a scan (M,), volts, that is not quiet."""
        assert scan is not None
        change = self._since(scan * self._per_tare)
        sigma = self._prior(time_s, creep, time_constant_s)
        found = self._explain(change, taken.certainty, sigma)
        excess = max(found.excess, self._excess(self._kept() + found.amounts))
        return replace(found, excess=excess)

    def jump(self, time_s: float, found: Explained) -> None:
        """The baseline is where a scan was explained to be."""
        self._amounts = self._kept() + found.amounts
        self._know(self._subspace.modes @ self._amounts + self._rest)
        self._seen_s = self._gain_seen_s = self._jumped_s = time_s

    def _since(self, over_tare: FloatArray) -> FloatArray:
        """Logarithms (M,) of voltages over the baseline; 0 where there is none."""
        ratio = np.where(self._per_tare != 0, over_tare * np.exp(-self._now), 1.0)
        return np.asarray(np.log(np.clip(ratio, *FARTHEST)))

    def _kept(self) -> FloatArray:
        """What drift of a gain and of smooth fields adds to; creep is told as a whole."""
        kept = self._amounts.copy()
        kept[self._subspace.cells] = 0.0
        return kept

    def _explain(self, change: FloatArray, certainty: FloatArray, sigma: FloatArray) -> Explained:
        cells = self._subspace.cells
        crept = self._subspace.modes[:, cells] @ self._amounts[cells]
        return self._subspace.explain(change + crept, certainty, sigma)

    def _prior(self, time_s: float, creep: FloatArray, lag_s: float) -> FloatArray:
        """Standard deviations (K,) of the modes.

        The reference may lag behind what it saw last; a jump makes up for all of that.
        """
        sigma = creep.copy()
        lag_s = min(lag_s, max(0.0, time_s - self._jumped_s))
        gain_s = max(0.0, time_s - self._gain_seen_s) + GAIN_SHARE * lag_s
        sigma[0] = min(GAIN_PER_S * gain_s, GAIN_AT_ONCE)
        smooth = SMOOTH_PER_S * (max(0.0, time_s - self._seen_s) + lag_s)
        sigma[self._subspace.smooth] = min(smooth, SMOOTH_AT_ONCE)
        return sigma

    def _excess(self, amounts: FloatArray) -> float:
        """How far beyond all that skins reach amounts (K,) since the tare are; good below 1."""
        smooth = float(np.abs(amounts[self._subspace.smooth]).max(initial=0.0))
        return max(abs(float(amounts[0])) / MOST_GAIN, smooth / MOST_SMOOTH)

    def _limited(self, amounts: FloatArray) -> FloatArray:
        limited = amounts.copy()
        limited[0] = np.clip(limited[0], -MOST_GAIN, MOST_GAIN)
        smooth = self._subspace.smooth
        limited[smooth] = np.clip(limited[smooth], -MOST_SMOOTH, MOST_SMOOTH)
        return limited

    def _know(self, baseline: FloatArray) -> None:
        self._now = baseline
        behind = self._certainty * (baseline - self._in_force) ** 2
        self.has_moved = bool(behind.mean() > LEAST_MOVE**2)

    def put_in_force(self) -> FloatArray:
        """The baseline (M,) as it is known; from now on it is in force."""
        self._in_force, self.has_moved = self._now, False
        return self._now

    def drift(self) -> Drift:
        """How far what is in force is from the tare."""
        weight = self._certainty / max(float(self._certainty.sum()), 1e-300)
        gain = float(weight @ self._in_force)
        uneven = float(np.sqrt(weight @ (self._in_force - gain) ** 2))
        return Drift(float(np.expm1(gain)), uneven)

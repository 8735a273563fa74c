"""Baseline tracking: a reference that follows a skin's drift, and never what presses on it.

Temperature scales a whole sheet, conductivity wanders smoothly across it, and what was pressed
stays a little more conductive for a while (creep, logarithmic in time). Against a reference of
this morning that is a ghost by noon.

*Nothing presses*: the reference follows what is seen, by a first-order low pass. What it has
followed is split into what skins do (see `drift`) and an unexplained residual. Both are bounded, so
that a touch that comes up slowly is not learned.

*Something presses*: nothing is followed but a common gain, seen as a factor that all voltages
share between two times of a contact that is still. A factor cannot hold a contact.

*Something was let go*: what is left is held against what drift may have done since. If it explains
the data to their noise, by amounts that skins reach in that time, the reference is there at once.
Only a signal that has just dropped is asked so: a contact that stays is none. Something lighter
that lay there before the release is followed with it. A frame that would show something if creep
had not been followed is flagged for that.

A lead that was broken at the tare is left out of all that: what is flagged since then and explained
does not keep the rest from being followed. A fault that comes later does, until the next tare.

What passes as neither is shown as it is, and `refusal` says so. Time is the frames' own: equal
frames lead to equal references.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any, Final, Literal

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.drift.channel_baseline import ChannelBaseline, Drift
from tactomo_models.drift.drift_model import DriftSubspace, PressMemory
from tactomo_models.reconstruct import Reconstructor
from tactomo_models.scans.companion_forces import CompanionReading
from tactomo_models.scans.measurement import Measurement
from tactomo_models.scans.plausibility import Flag
from tactomo_models.scans.reference import Reference
from tactomo_models.scans.tare import Tare
from tactomo_models.scene.reconstruction import Reconstruction

State = Literal["waiting", "following", "held", "refused"]
Scans = dict[Channel, FloatArray | None]

MOVE_S: Final = 10.0  # least time between two references, unless something was let go
DISTRUSTED_S: Final = 30.0  # of frames that nothing explains, before that is said
TIME_CONSTANT_S: Final = 60.0  # by which the reference follows while nothing presses

DROPPED: Final = 0.5  # of its usual signal, below which something was let go
DISTRUST: Final = Flag.MISFIT_HIGH | Flag.REFERENCE_MISMATCH | Flag.LOW_CONFIDENCE

STRAY = "the {} channel moves at rest as no skin drifts: maybe a touch that comes up slowly"
FAINT = "what a contact left behind is a faint touch, or a skin that has drifted"
NEITHER = "what is seen is no contact that explains it, and no drift that skins reach"


class BaselineTracker:
    """Reconstructs frames against a reference that follows the skin.

    Args:
        reconstructor: is given the references, from `begin` on by nobody else.
        time_constant_s: by which the reference follows while nothing presses.

    Not thread-safe: one thread owns it.
    """

    def __init__(
        self, reconstructor: Reconstructor, time_constant_s: float = TIME_CONSTANT_S
    ) -> None:
        self.reference: Reference | None = None  #: the one in force; None before the first tare
        self.moves = 0  #: how often the reference has moved since the tare
        #: why what is seen is not followed; empty while it is, or may be a contact
        self.refusal = ""
        self._reconstructor = reconstructor
        self._time_constant_s = time_constant_s
        self._subspace = DriftSubspace(reconstructor.sensor)
        self._memory = PressMemory(reconstructor.description, self._subspace)
        self._channels: dict[Channel, ChannelBaseline] = {}
        self._release = _Release()
        self._is_ready = self._is_held = False
        self._moved_s = self._last_s = 0.0
        self._distrusted_s: float | None = None

    def begin(self, tare: Tare) -> None:
        """Measure against a tare, and follow from there."""
        self.reference = tare.reference
        self._reconstructor.use(tare)
        self._channels = {
            name: ChannelBaseline(self._subspace, getattr(tare.reference, name), channel.usable)
            for name, channel in tare.channels.items()
        }
        self._memory.clear()
        self._release = _Release()
        self._is_ready = self._is_held = False
        self.refusal, self._distrusted_s, self.moves = "", None, 0

    @property
    def state(self) -> State:
        """What it does: wait for a first good frame, follow, hold under contact, or refuse."""
        if not self._is_ready:
            return "waiting"
        if self.refusal:
            return "refused"
        return "held" if self._is_held else "following"

    @property
    def drift(self) -> dict[Channel, Drift]:
        """How far each channel's baseline has moved since the tare."""
        return {name: channel.drift() for name, channel in self._channels.items()}

    def reconstruct(
        self,
        time_s: float,  # when it was acquired, on any steady clock
        magnitude: FloatArray | None,  # (M,) volts; None if that scan is missing
        structure: FloatArray | None,  # (M,) volts; None if that scan is missing
        *,
        # channels whose device says that its converter clipped this scan
        saturated: Collection[Channel] = (),
        companions: Collection[tuple[str, float] | CompanionReading] | None = None,
    ) -> Reconstruction:
        """Reconstruct one frame; before, the reference moves if need be.

        Raises DataError where a scan has another number of voltages than the sensor.
        """
        scans: Scans = {Channel.MAGNITUDE: magnitude, Channel.STRUCTURE: structure}
        if time_s - self._moved_s >= MOVE_S and any(c.has_moved for c in self._channels.values()):
            self._move(time_s)

        def compare() -> Measurement:
            return self._reconstructor.compare(
                magnitude, structure, saturated=saturated, companions=companions
            )

        measurement = compare()
        if self._settles(time_s, measurement, scans):
            self._move(time_s)
            measurement = compare()
        frame = self._reconstructor.solve(measurement)
        if self.reference is not None:
            self._take_note(time_s, measurement, frame, scans)
        return frame

    def explains_as_drift(self, seen: Reference, elapsed_s: float) -> bool:
        """Whether a mean of scans is the reference, drifted for so long; or nothing can be told.

        For a tracker that has just begun.
        """
        measurement = self._reconstructor.compare(seen.magnitude, seen.structure)
        if measurement.is_quiet:
            return True
        for name, changes in measurement.changes.items():
            channel = self._channels[name]
            channel.begin(0.0)
            creep = self._memory.creep(elapsed_s, name)
            scan = getattr(seen, name)
            found = channel.explain(elapsed_s, scan, changes, creep, self._time_constant_s)
            if found.misfit >= 1 or found.excess >= 1:
                return False
        return True

    def _move(self, time_s: float) -> None:
        """Put the baseline as it is now in force."""
        assert self.reference is not None
        moved: dict[str, Any] = {}
        for name, channel in self._channels.items():
            moved[f"{name}_drift"], moved[f"{name}_creep"] = channel.put_in_force()
        self.reference = replace(self.reference, **moved)
        self._reconstructor.set_reference(self.reference)
        self._moved_s = time_s
        self.moves += 1

    def _settles(self, time_s: float, measurement: Measurement, scans: Scans) -> bool:
        """Whether what is seen is nothing but drift; if so, the baseline is there now."""
        doubtful = 1.5  # times the bounds, from which what is left is certainly a contact
        known = Flag.REFERENCE_MISMATCH | measurement.standing_flags
        if not self._is_ready or measurement.is_quiet or measurement.flags & ~known:
            return False
        if measurement.changes.keys() != self._channels.keys():
            return False
        if self._is_held and not self._release.is_on(time_s, _signal(measurement)):
            return False
        creep = {name: self._memory.creep(time_s, name) for name in self._channels}
        found = {
            name: channel.explain(
                time_s,
                scans[name],
                measurement.changes[name],
                creep[name],
                self._time_constant_s,
            )
            for name, channel in self._channels.items()
        }
        if all(each.misfit < 1 and each.excess < 1 for each in found.values()):
            for name, channel in self._channels.items():
                channel.jump(time_s, found[name], creep[name])
            self._let_go()
            return True
        if self._is_held and all(max(e.misfit, e.excess) < doubtful for e in found.values()):
            self.refusal = FAINT
        return False

    def _let_go(self) -> None:
        self._is_held, self.refusal, self._distrusted_s = False, "", None
        self._release = _Release()
        self._drop_blocks()

    def _take_note(
        self, time_s: float, measurement: Measurement, frame: Reconstruction, scans: Scans
    ) -> None:
        """Learn from a frame; what follows from it is in force from the next one on."""
        elapsed_s = max(0.0, time_s - self._last_s) if self._is_ready else 0.0
        self._last_s = time_s
        self._memory.add(time_s, elapsed_s, frame)
        if measurement.is_quiet and not frame.flags & ~measurement.standing_flags:
            self._follow(time_s, measurement, scans)
        elif measurement.is_quiet or not measurement.changes:
            self._drop_blocks()  # it says nothing of the baseline
        elif self._is_ready:
            self._hold(time_s, elapsed_s, measurement, frame, scans)

    def _follow(self, time_s: float, measurement: Measurement, scans: Scans) -> None:
        if self._is_held or not self._is_ready:
            if not self._is_ready:
                for channel in self._channels.values():
                    channel.begin(time_s)
            self._let_go()
            self._is_ready = True
        self._distrusted_s = None
        for name, channel in self._channels.items():
            if not channel.add(time_s, scans[name], measurement.changes[name]):
                continue
            creep = self._memory.creep(time_s, name)
            if channel.follow(time_s, creep, self._time_constant_s):
                self.refusal = ""
            else:
                self.refusal = STRAY.format(name)

    def _hold(
        self,
        time_s: float,
        elapsed_s: float,
        measurement: Measurement,
        frame: Reconstruction,
        scans: Scans,
    ) -> None:
        if not self._is_held:
            self._drop_blocks()
            self._is_held = True
        self._release.add(time_s, elapsed_s, _signal(measurement))
        self._note_distrust(time_s, frame)
        for name, channel in self._channels.items():
            if name not in measurement.changes or measurement.flags & ~(
                DISTRUST | measurement.standing_flags
            ):
                channel.drop_block()
            elif channel.add(time_s, scans[name], measurement.changes[name]):
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


def _signal(measurement: Measurement) -> float:
    return max(taken.signal for taken in measurement.changes.values())


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
        usual_s = 10.0  # over which "usual" is taken
        settling_s = 30.0  # after that, in which what is left may be drift
        if self._usual and signal < DROPPED * self._usual:
            self._until_s, self._usual = time_s + settling_s, signal
        share = -np.expm1(-elapsed_s / usual_s)
        self._usual = self._usual + share * (signal - self._usual) if self._usual else signal

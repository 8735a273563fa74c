"""A frame's scans against the reference: what every method is given."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.physics.artifact import Artifact
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scans.changes import Changes, MeasuredChannel, missing
from tactomo_models.scans.plausibility import Flag, Wiring
from tactomo_models.scans.reference import Reference
from tactomo_models.sensor.description import SensorDescription

LEFT_OUT: Final = Flag.ELECTRODE_FAULT | Flag.INVALID_VOLTAGE  # what is known to be missing


@dataclass(frozen=True)
class Measurement:
    """One frame's relative voltage changes."""

    #: of each channel that has a usable scan; the others are absent
    changes: Mapping[Channel, Changes]
    flags: Flag = field(default_factory=lambda: Flag(0))  #: what stands in the way of trusting them
    #: those of `flags` that the reference brings along: these scans have nothing to add
    standing_flags: Flag = field(default_factory=lambda: Flag(0))
    faults: tuple[str, ...] = ()  #: in words, which electrodes are left out
    #: seconds spent in each stage of this frame so far
    stage_s: dict[str, float] = field(default_factory=dict)
    may_drift: bool = True  #: whether a drift since the tare may explain what contacts do not

    @property
    def is_quiet(self) -> bool:
        """Whether there is something to see, and nothing presses."""
        return bool(self.changes) and all(each.quiet for each in self.changes.values())

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time spent inside to a stage's seconds."""
        start_s = time.perf_counter()
        yield
        self.stage_s[stage] = self.stage_s.get(stage, 0.0) + time.perf_counter() - start_s


class Comparator:
    """Holds scans against a reference."""

    def __init__(
        self,
        description: SensorDescription,  # the sensor
        artifact: Artifact,  # what is precomputed for it
        forward: ForwardModel,  # the model of its sheet
    ) -> None:
        much_more = 5.0  # ratio of the channels' contrasts (logarithms) for that
        # those that the reference has; others after a tare
        self.channels: dict[Channel, MeasuredChannel] = {}
        self._description, self._artifact, self._forward = description, artifact, forward
        self._wiring = Wiring(description)
        self._reference: Reference | None = None
        self._asks_noise = False
        self._structure_answers_more = len(description.channels) == 2 and bool(
            np.log(description.contrast(Channel.STRUCTURE))
            > much_more * np.log(description.contrast(Channel.MAGNITUDE))
        )

    def set_reference(self, reference: Reference) -> bool:
        """Measure changes against a reference; whether it is another than the last one, drifted.

        Raises DataError where a channel has another number of voltages than the sensor.
        """
        is_new = self._reference is None or not reference.is_followed_from(self._reference)
        if is_new:
            self._tare(reference)
            self._asks_noise = reference.lacks_noise
        self._reference = reference
        self._follow(reference)
        return is_new

    def _tare(self, reference: Reference) -> None:
        self.channels = self.channels_of(reference)

    def channels_of(self, reference: Reference) -> dict[Channel, MeasuredChannel]:
        """The channels of a reference, with nothing put in force; for any thread.

        Raises:
            DataError: a channel has another number of voltages than the sensor.
        """
        volts = {Channel.MAGNITUDE: reference.magnitude, Channel.STRUCTURE: reference.structure}
        noise = {
            Channel.MAGNITUDE: reference.magnitude_noise,
            Channel.STRUCTURE: reference.structure_noise,
        }
        return {
            name: MeasuredChannel(
                self._description,
                self._artifact,
                self._forward,
                self._wiring,
                name,
                scan,
                noise[name],
                reference.scans,
                reference.is_noise_measured,
            )
            for name in self._description.channels
            if (scan := volts[name]) is not None
        }

    def _follow(self, reference: Reference) -> None:
        for name, channel in self.channels.items():
            drift, creep = (getattr(reference, f"{name}_{what}") for what in ("drift", "creep"))
            channel.follow(drift, creep)

    def ask_noise(self, *scans: FloatArray | None) -> None:
        """Take the noise of the first frame's scans, where a reference of one scan told none.

        A reference is often the mean of many scans, and so much quieter than the scans to come; and
        it breaks reciprocity not by noise alone, but also by what is the same in every scan.
        """
        if not self._asks_noise:
            return
        self._asks_noise = False
        if self._reference is None or any(
            scan is not None and scan.shape != (self._description.measurements,) for scan in scans
        ):
            return
        seen = self._reference.with_noise_of(self._description, *scans)
        if not seen.lacks_noise:
            self._tare(seen)
            self._follow(seen)

    def compare(
        self,
        magnitude: FloatArray | None,
        structure: FloatArray | None,
        saturated: Collection[Channel] = (),
    ) -> Measurement:
        """Relative changes of one frame's scans; see `Reconstructor.reconstruct`."""
        start_s = time.perf_counter()
        changes: dict[Channel, Changes] = {}
        flags = own_flags = Flag(0)
        faults: list[str] = []
        for name, scan in ((Channel.MAGNITUDE, magnitude), (Channel.STRUCTURE, structure)):
            if name not in self._description.channels:
                continue
            if scan is None or name not in self.channels:
                absent = missing(name) if scan is None else Flag.NO_REFERENCE
                flags, own_flags = flags | absent, own_flags | absent
                continue
            result = self.channels[name].compare(scan, saturated=name in saturated)
            flags, own_flags = flags | result.flags, own_flags | result.own_flags
            if result.electrodes:
                faults.append(_named(name, result.electrodes))
            if result.changes is not None:
                changes[name] = result.changes
        if self._are_swapped(changes):
            flags |= Flag.CHANNELS_SWAPPED
        standing_flags = flags & (LEFT_OUT & ~own_flags | Flag.CREEPING)
        stage_s = {"data": time.perf_counter() - start_s}
        return Measurement(changes, flags, standing_flags, tuple(faults), stage_s)

    def _are_swapped(self, changes: Mapping[Channel, Changes]) -> bool:
        """Tell whether the magnitude channel answers more than the structure channel.

        The structure channel's contrast is far the larger, so that no pressing does that.
        """
        swapped = 2.0  # times the structure channel's signal, that the magnitude channel's is below
        if len(changes) < 2 or not self._structure_answers_more:
            return False
        magnitude, structure = changes[Channel.MAGNITUDE], changes[Channel.STRUCTURE]
        return not magnitude.quiet and magnitude.signal > swapped * structure.signal


def _named(name: Channel, electrodes: list[int]) -> str:
    """Say in words which electrodes are left out; they are counted from 0."""
    word = "electrode" if len(electrodes) == 1 else "electrodes"
    return f"{name} {word} {', '.join(map(str, electrodes))} left out"

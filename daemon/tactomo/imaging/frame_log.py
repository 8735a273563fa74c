"""What a recording is told of frames: of which scans they were made, and against what.

Frames depend on those before them. From the first dual scan that a recording holds whole, it is
told all that a replay needs to come to the same frames: what is in force, and a mark of each dual
scan that was reconstructed. For use by the pipeline thread.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

from tactomo_models import Reference

from tactomo.imaging.kept_reference import KnownSkin
from tactomo.recordings.recorder import Recorder
from tactomo.recordings.recording_writer import (
    ActiveRecording,
    Entry,
    calibration_entry,
    pack_frame,
    reference_entry,
)
from tactomo.scans import DualScan, FrameRecord, Timing
from tactomo.timing import wall_clock_ns

REPEAT_S: Final = 60.0
"""How often reference and calibration are said again: damage to a file costs a minute of frames."""


@dataclass(frozen=True)
class InForce:
    """What a frame is made with, beside the frames before it."""

    rest: KnownSkin | None  # what changes are measured against; None before the first tare
    method: str
    budget_ms: float | None  # of modelled work; None for the method's own
    calibration: str  # the text of the pressure calibration; empty for the description's curve
    is_disputed: bool  # whether it is open what lay on the skin at the tare


class FrameLog:
    """Marks frames in the recording that runs."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._recording: ActiveRecording | None = None  # the one that gets marks
        self._reference: Reference | None = None  # that it was told last, as is _calibration
        self._calibration = ""
        self._repeat_s = 0.0

    def follow(self, dual: DualScan) -> bool:
        """Go over to the recording that runs, if it holds the dual scan whole.

        Returns whether the dual scan is the first one of a recording: a replay knows nothing of
        the shapes before it.
        """
        active = self._recorder.active
        if active is None:
            self._recording = None
        if active is None or active is self._recording or dual.recording != active.number:
            return False
        self._recording = active
        self._reference, self._calibration = None, active.calibration
        active.come_over.set()
        return True

    def mark(self, dual: DualScan, timing: Timing, in_force: InForce) -> None:
        """Say that a frame was made of a dual scan, and what with."""
        recording = self._recording
        if recording is None or dual.recording != recording.number:
            return
        self._tell(recording, in_force)
        done = FrameRecord(
            tuple(scan.key for scan in dual.scans),
            in_force.method,
            in_force.budget_ms,
            is_disputed=in_force.is_disputed,
            timing=timing,
            reference_number=recording.references or None,
            calibration_number=recording.calibrations,
        )
        recording.add(Entry("frame", pack_frame(done), time.monotonic_ns(), wall_clock_ns()))

    def _tell(self, recording: ActiveRecording, in_force: InForce) -> None:
        """Say reference and calibration, where they are new to the recording, or now and then."""
        rest, now_ns = in_force.rest, time.monotonic_ns()
        reference = None if rest is None else rest.reference
        is_due, is_new = time.monotonic() >= self._repeat_s, reference is not self._reference
        self._reference = reference
        recording.references += is_new
        if rest is not None and (is_new or is_due):
            self._repeat_s = time.monotonic() + REPEAT_S
            number = recording.references
            recording.add(reference_entry(rest.reference, number, now_ns, rest.realtime_ns))
        text = in_force.calibration
        is_new, self._calibration = text != self._calibration, text
        recording.calibrations += is_new
        if is_new or (is_due and recording.calibrations):
            recording.add(calibration_entry(text, recording.calibrations, now_ns, wall_clock_ns()))

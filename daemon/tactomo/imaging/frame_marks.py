"""What a recording is told of frames: of which scans they were made, and against what.

Frames depend on those before them. From the first dual scan that a recording holds whole, it is
told all that a replay needs to come to the same frames: the reference and the pressure calibration
in force, and a mark of each dual scan that was reconstructed. For use by the pipeline thread.
"""

from __future__ import annotations

import time
from typing import Final

from tactomo_models import Reference

from tactomo.recordings.active_recording import ActiveRecording
from tactomo.recordings.recorder import Recorder
from tactomo.recordings.recording_writer import calibration_entry, mark_entry, reference_entry
from tactomo.scans import DualScan, Mark, Timing

REPEAT_S: Final = 60.0
"""How often reference and calibration are said again: damage to a file costs a minute of frames."""


class FrameMarks:
    """Marks frames in the recording that runs."""

    def __init__(self, recorder: Recorder, calibration: str) -> None:
        self.calibration = calibration  # the text of the pressure calibration in force
        self._recorder = recorder
        self._recording: ActiveRecording | None = None  # the one that gets marks
        self._reference: tuple[Reference, int] | None = None  # and when it was taken
        self._repeat_s = 0.0

    def note_reference(self, reference: Reference, realtime_ns: int) -> None:
        """Take note of the reference from the next dual scan on, taken at `realtime_ns`."""
        self._reference = (reference, realtime_ns)
        if self._recording is not None:
            self._recording.references += 1
            self._record_reference(self._recording)

    def note_calibration(self, text: str) -> None:
        """Take note of the pressure calibration from the next dual scan on."""
        self.calibration = text
        self._recorder.set_calibration(text)
        if self._recording is not None:
            self._recording.calibrations += 1
            self._record_calibration(self._recording)

    def follow(self, dual: DualScan) -> bool:
        """Go over to the recording that runs, if it holds the dual scan whole.

        Returns whether the dual scan is the first one of a recording: a replay knows nothing of
        the shapes before it.
        """
        active, marked = self._recorder.active, self._recording
        if active is marked:
            if marked is not None and time.monotonic() >= self._repeat_s:
                self._record_reference(marked)
                self._record_calibration(marked)
            return False
        if active is None:
            self._recording = None
            return False
        if dual.recording != active.number:
            return False
        self._recording = active
        active.come_over.set()
        if self._reference is not None:
            active.references += 1
            self._record_reference(active)
        if active.calibration != self.calibration:
            active.calibrations += 1
            self._record_calibration(active)
        return True

    def mark(self, dual: DualScan, timing: Timing, method: str, budget_ms: float | None) -> None:
        """Say that a frame was made of a dual scan, by a method with so much modelled work."""
        recording = self._recording
        if recording is None or dual.recording != recording.number:
            return
        done = Mark(
            tuple(scan.key for scan in dual.scans),
            method,
            budget_ms,
            timing=timing,
            reference_number=recording.references or None,
            calibration_number=recording.calibrations,
        )
        recording.add(mark_entry(done, time.monotonic_ns(), time.time_ns()))

    def _record_reference(self, recording: ActiveRecording) -> None:
        self._repeat_s = time.monotonic() + REPEAT_S
        if self._reference is not None:
            reference, taken_ns = self._reference
            times = (time.monotonic_ns(), taken_ns)
            recording.add(reference_entry(reference, recording.references, *times))

    def _record_calibration(self, recording: ActiveRecording) -> None:
        """Say the calibration, where it is another one than the recording began with."""
        if recording.calibrations:
            times = (time.monotonic_ns(), time.time_ns())
            recording.add(calibration_entry(self.calibration, recording.calibrations, *times))

"""Which pressure calibration frames go by: the sensor's own, if it is of the devices that speak.

For use by the pipeline thread; others may read `in_force`.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

from tactomo_models import Reconstructor, SensorDescription
from tactomo_models.calibration.calibration_file import PressureCalibration
from tactomo_models.scene.pressure import described_curve

from tactomo.errors import CommandError
from tactomo.events import OnEvent
from tactomo.imaging.frame_marks import FrameMarks
from tactomo.recordings.recording import calibration_text, recorded_calibration


class _Foreign(NamedTuple):
    """That a calibration was made with other devices than those that speak, for people."""

    cause: str
    command: str
    """What makes another one."""


class CalibrationInForce:
    """The pressure calibration in force; the reconstructor's curve and the recording follow it.

    Args:
        description: the sensor, whose own curve is used where there is no calibration.
        reconstructor: is given the curve.
        marks: told of each new calibration.
        on_event: told of a calibration that is another device's.
        calibration: the sensor's own; None where there is none.

    Attributes:
        in_force: the calibration that is used; None for the description's curve.
        device_ids: of those that have spoken.
    """

    def __init__(
        self,
        description: SensorDescription,
        reconstructor: Reconstructor,
        marks: FrameMarks,
        on_event: OnEvent,
        calibration: PressureCalibration | None,
    ) -> None:
        self.in_force: PressureCalibration | None = None
        self._description = description
        self._reconstructor = reconstructor
        self._marks = marks
        self._on_event = on_event
        self._own = calibration
        self.device_ids: frozenset[str] = frozenset()
        self._refused: _Foreign | None = None
        self._judge()

    def meet(self, device_ids: Collection[str]) -> None:
        """Take note of who speaks: a calibration holds for the devices that it was made with."""
        self.device_ids = frozenset(device_ids)
        self._judge()

    def replace(self, calibration: PressureCalibration | None) -> None:
        """Put another calibration in force, None for the description's curve.

        Raises:
            CommandError: it is another device's; what was in force stays so.
        """
        foreign = self._foreign(calibration)
        if foreign is not None:
            step = f"what was in force stays so; run: {foreign.command}"
            self._on_event("calibration_refused", "warning", foreign.cause, step)
            raise CommandError(foreign.cause, step, "calibration_refused")
        self._use(calibration, calibration_text(calibration))
        words = "none is kept: pressures are the description's"
        detail = words if calibration is None else calibration.words
        self._on_event("calibration_reloaded", "info", detail)

    def obey(self, text: str | None) -> None:
        """Put in force what a mark brings: a calibration's text, empty for none, None for no news.

        In an exact replay.
        """
        if text is None or text == self._marks.calibration:
            return
        source = "the calibration that was read again while this was recorded"
        self._use(recorded_calibration(text, source, self._description), text)

    def _use(self, calibration: PressureCalibration | None, text: str) -> None:
        """Go by another calibration from the next dual scan on, and say so in the recording."""
        self._own = calibration
        self._judge()
        self._marks.note_calibration(text)

    def _judge(self) -> None:
        """Put the sensor's own calibration in force, if it was made with the devices that speak."""
        foreign = self._foreign(self._own)
        self.in_force = None if foreign else self._own
        self._reconstructor.curve = (
            described_curve(self._description) if self.in_force is None else self.in_force.curve
        )
        if foreign is not None and foreign != self._refused:
            self._on_event(
                "calibration_refused",
                "warning",
                foreign.cause,
                f"until you run `{foreign.command}`, pressures are the description's",
            )
        self._refused = foreign

    def _foreign(self, calibration: PressureCalibration | None) -> _Foreign | None:
        """Return that a calibration is another device's; None where it is not."""
        if calibration is None:
            return None
        subject = calibration.subject
        why = subject.foreign(self.device_ids)
        if not why:
            return None
        return _Foreign(
            f"the pressure calibration of {subject.sensor} {why}",
            f"tactomo calibrate live --sensor {subject.sensor}",
        )

"""Which pressure calibration and teaching frames go by: the sensor's own, of what is connected.

For use by the pipeline thread; others may read `in_force`.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple

from tactomo_models import Reconstructor, Reference, SensorDescription
from tactomo_models.calibration.calibration_file import PressureCalibration
from tactomo_models.calibration.taught_skin import TaughtSkin
from tactomo_models.scene.pressure import described_curve

from tactomo.errors import CommandError
from tactomo.events import OnEvent
from tactomo.recordings.recorder import Recorder
from tactomo.recordings.records import calibration_text, recorded_calibration


class _Foreign(NamedTuple):
    """That a calibration or a teaching is of other devices, or of another skin, for people."""

    cause: str
    command: str  # what makes another one
    until: str  # what holds until then


@dataclass(eq=False)
class CalibrationInForce:
    """The pressure calibration in force; the reconstructor's curve and the recording follow it."""

    # the sensor, whose own curve is used where there is no calibration
    _description: SensorDescription
    _reconstructor: Reconstructor  # is given the curve
    _recorder: Recorder  # told of each new calibration
    _on_event: OnEvent  # told of a calibration that is another device's
    _own: PressureCalibration | None  # the sensor's own; None where there is none
    _own_taught: TaughtSkin | None  # what the sensor was taught; None where nothing was

    def __post_init__(self) -> None:
        # the calibration that is used; None for the description's curve
        self.in_force: PressureCalibration | None = None
        # the teaching that is used; None where the physics alone locates
        self.taught: TaughtSkin | None = None
        self.text = calibration_text(self._own)  # of the sensor's own, in force or not
        self._reference: Reference | None = None
        self.device_ids: frozenset[str] = frozenset()  # of those that have spoken
        self._refused: list[_Foreign] = []
        self._judge()

    def meet(self, device_ids: Collection[str]) -> None:
        """Take note of who speaks: a calibration holds for the devices that it was made with."""
        self.device_ids = frozenset(device_ids)
        self._judge()

    def meet_skin(self, reference: Reference) -> None:
        """Take note of the unpressed skin: what was taught holds for the skin that was taught."""
        self._reference = reference
        self._judge()

    def replace(self, calibration: PressureCalibration | None, taught: TaughtSkin | None) -> None:
        """Put another calibration and teaching in force; None for what the description says.

        Raises CommandError where one is another device's or skin's; what was in force stays so.
        """
        for foreign in self._foreign(calibration, taught):
            step = f"what was in force stays so; run: {foreign.command}"
            self._on_event("calibration_refused", foreign.cause, step)
            raise CommandError(foreign.cause, step, "calibration_refused")
        self._own_taught = taught
        self._use(calibration, calibration_text(calibration))
        words = "none is kept: pressures are the description's"
        detail = words if calibration is None else calibration.words
        detail += "" if taught is None else f"; taught by {taught.words}"
        self._on_event("calibration_reloaded", detail)

    def obey(self, text: str | None) -> None:
        """Put in force what a mark brings: a calibration's text, empty for none, None for no news.

        In an exact replay.
        """
        if text is None or text == self.text:
            return
        source = "the calibration that was read again while this was recorded"
        self._use(recorded_calibration(text, source, self._description), text)

    def _use(self, calibration: PressureCalibration | None, text: str) -> None:
        """Go by another calibration from the next dual scan on, and say so in the recording."""
        self._own = calibration
        self._judge()
        self.text = text
        self._recorder.set_calibration(text)

    def _judge(self) -> None:
        """Put the sensor's own in force, as far as they are of what is connected."""
        refused = self._foreign(self._own, self._own_taught)
        of_curve = self._foreign(self._own, None)
        self.in_force = None if of_curve else self._own
        self.taught = None if len(refused) > len(of_curve) else self._own_taught
        self._reconstructor.curve = (
            described_curve(self._description) if self.in_force is None else self.in_force.curve
        )
        self._reconstructor.taught = self.taught
        for foreign in refused:
            if foreign not in self._refused:
                step = f"until you run `{foreign.command}`, {foreign.until}"
                self._on_event("calibration_refused", foreign.cause, step)
        self._refused = refused

    def _foreign(
        self, calibration: PressureCalibration | None, taught: TaughtSkin | None
    ) -> list[_Foreign]:
        """Return what is of other devices than those that speak, or of another skin."""
        found = []
        if calibration is not None and (why := calibration.subject.foreign(self.device_ids)):
            sensor = calibration.subject.sensor
            cause = f"the pressure calibration of {sensor} {why}"
            command = f"tactomo calibrate live --sensor {sensor}"
            found.append(_Foreign(cause, command, "pressures are the description's"))
        if taught is not None:
            sensor, why = taught.subject.sensor, taught.subject.foreign(self.device_ids)
            if not why and self._reference is not None and (off := taught.changed(self._reference)):
                why = f"does not fit the skin any more: {off}"
            if why:
                cause, command = (
                    f"the teaching of {sensor} {why}",
                    f"tactomo teach live -s {sensor}",
                )
                found.append(_Foreign(cause, command, "the physics alone locates"))
        return found

"""One dual scan to one frame: check, reconstruct, publish, and mark it in the recording.

For use by the pipeline thread; nothing in here waits. What others may read (`reference`, `stages`,
...) is written by that thread alone.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from concurrent.futures import Future
from typing import Any, Final

import numpy as np
import structlog
from numpy.typing import NDArray
from tactomo_client.messages import CONTACTS, MAP, SCAN
from tactomo_models import (
    BaselineTracker,
    CalibrationError,
    Modality,
    ModelError,
    Reconstruction,
    Reconstructor,
    Reference,
    SensorDescription,
    Tier,
)
from tactomo_models.calibration_file import PressureCalibration, parse_calibration
from tactomo_models.machine_speed import MachineSpeed
from tactomo_models.pressure import described_curve
from tactomo_protocol import Channel, ScanFlag

from tactomo.active_recording import ActiveRecording
from tactomo.config import BaselineConfig
from tactomo.errors import CommandError
from tactomo.events import OnEvent, RateLimit
from tactomo.frames import (
    calibration_fields,
    contacts_fields,
    frame_header,
    map_fields,
    scan_fields,
    scan_header,
)
from tactomo.publisher import Publisher
from tactomo.recorder import Recorder
from tactomo.recording import Mark, ScanKey, Timing, calibration_text
from tactomo.recording_writer import calibration_entry, mark_entry, reference_entry
from tactomo.sync import DualScan
from tactomo.tare import Tare
from tactomo.timing import Durations, Rate

REPEAT_S: Final = 60.0
REFUSAL_PERIOD_S: Final = 600.0
NO_DATA_S: Final = 3.0
"""How long a tare on command waits for usable dual scans before it gives up; where they come more
slowly, a few of their periods."""

MODALITIES: Final[tuple[tuple[Modality, Channel], ...]] = (
    ("magnitude", Channel.MAGNITUDE),
    ("structure", Channel.STRUCTURE),
)

Volts = dict[Channel, NDArray[np.float64]]

log = structlog.get_logger()


class Imaging:
    """Reconstructs dual scans against a reference that it takes itself.

    The tier and the time budget that are asked for become what the reconstructor is given by the
    machine's speed, before they are recorded: marks hold what was given, so that a replay gives the
    same on any machine.

    Attributes:
        machine_speed: what turns a budget of time into one of work.
        calibration: of pressure, that is in force; None for the description's own curve.
        given: the tier that frames are given, and the milliseconds of modelled work.
        reference: what changes are measured against; None before the first tare.
        reference_realtime_ns: when it was taken.
        stages: how long each stage takes.
        frame_rate: how often a frame is published.
        acquired_monotonic_ns: when the newest dual scan was acquired; 0 before the first.

    """

    def __init__(
        self,
        description: SensorDescription,
        reconstructor: Reconstructor,
        machine_speed: MachineSpeed,
        calibration: PressureCalibration | None,
        tare_scans: int,
        baseline: BaselineConfig,
        recorder: Recorder,
        publisher: Publisher,
        on_event: OnEvent,
    ) -> None:
        self.machine_speed = machine_speed
        self.calibration: PressureCalibration | None = None
        self.given: tuple[Tier, float | None]
        self.reference: Reference | None = None
        self.reference_realtime_ns = 0
        self.stages: dict[str, Durations] = {}
        self.frame_rate = Rate()
        self.acquired_monotonic_ns = 0
        self._description = description
        self._channels = tuple(c for c in Channel if c.name.lower() in description.modalities)
        self._reconstructor = reconstructor
        self._tracker = (
            BaselineTracker(reconstructor, baseline.time_constant_s) if baseline.track else None
        )
        self._tare_scans = tare_scans
        self._recorder = recorder
        self._publisher = publisher
        self._on_event = on_event
        self._tare: Tare | None = None
        self._tare_deadline_s = 0.0
        self._contacts = 0  # in the last frame
        self._marked: ActiveRecording | None = None  # the recording that gets marks
        self._repeat_s = 0.0
        self._failure_limit = RateLimit()
        self._own_calibration = calibration
        self._calibration_text = calibration_text(calibration)
        self._device_ids: frozenset[str] = frozenset()  # of those that have spoken
        self._foreign = ""  # why it is not in force
        self._use_calibration(calibration)
        self._refusal_limit = RateLimit(REFUSAL_PERIOD_S)
        budget_s = reconstructor.budget_s
        self._ask(reconstructor.tier, None if budget_s is None else budget_s * 1e3)

    @property
    def baseline(self) -> dict[str, Any]:
        """What `status` says of how the reference follows the skin; for any thread."""
        tracker = self._tracker
        if tracker is None:
            return {"state": "off", "moves": 0, "refusal": None, "drift": {}}
        drift = {
            name: {"gain": each.gain, "uneven": each.uneven} for name, each in tracker.drift.items()
        }
        refusal = tracker.refusal or None
        return {"state": tracker.state, "moves": tracker.moves, "refusal": refusal, "drift": drift}

    @property
    def is_taring(self) -> bool:
        """Whether a reference is being taken."""
        return self._tare is not None

    def meet(self, device_ids: Collection[str]) -> None:
        """Take note of who speaks: a calibration holds for the devices that it was made with."""
        self._device_ids = frozenset(device_ids)
        self._judge_calibration()

    def reload_calibration(
        self, calibration: PressureCalibration | None, answer: Future[Mapping[str, Any]]
    ) -> None:
        """Put in force what was read again, None for the description's curve, or refuse it.

        `answer` gets what became of it.
        """
        subject = None if calibration is None else calibration.subject
        if subject is not None and (foreign := subject.foreign(self._device_ids)):
            cause = f"the pressure calibration of {subject.sensor} {foreign}"
            step = f"what was in force stays so; run: tactomo calibrate {subject.sensor}"
            self._on_event("calibration_refused", "warning", cause, step)
            answer.set_exception(CommandError(cause, step, "calibration_refused"))
            return
        self._take_calibration(calibration, calibration_text(calibration))
        words = "none is kept: pressures are the description's"
        detail = words if calibration is None else calibration.words
        self._on_event("calibration_reloaded", "info", detail)
        self._publisher.tell_status()
        answer.set_result({"calibration": calibration and calibration_fields(calibration)})

    def _take_calibration(self, calibration: PressureCalibration | None, text: str) -> None:
        """Go by another calibration from the next dual scan on, and say so in the recording."""
        self._own_calibration, self._calibration_text = calibration, text
        self._judge_calibration()
        self._recorder.set_calibration(text)
        if self._marked is not None:
            self._marked.calibrations += 1
            self._record_calibration()

    def _judge_calibration(self) -> None:
        """Put this sensor's calibration in force, if it was made with the devices that speak."""
        own = self._own_calibration
        foreign = "" if own is None else own.subject.foreign(self._device_ids)
        self._use_calibration(None if foreign else own)
        if own is not None and foreign and foreign != self._foreign:
            self._on_event(
                "calibration_refused",
                "warning",
                f"the pressure calibration of {own.subject.sensor} {foreign}",
                f"until you run `tactomo calibrate {own.subject.sensor}`, pressures are the "
                "description's",
            )
        self._foreign = foreign

    def _use_calibration(self, calibration: PressureCalibration | None) -> None:
        self.calibration = calibration
        curve = described_curve(self._description) if calibration is None else calibration.curve
        self._reconstructor.curve = curve

    def has_reference(self, channel: Channel) -> bool:
        """Whether there is something to measure this channel's changes against."""
        return getattr(self.reference, channel.name.lower(), None) is not None

    @property
    def tier(self) -> Tier:
        """The tier that is asked for."""
        return self._asked[0]

    @tier.setter
    def tier(self, tier: Tier) -> None:
        self._ask(tier, self.budget_ms)

    @property
    def budget_ms(self) -> float | None:
        """The time that a frame may take; None for the tier's own."""
        return self._asked[1]

    @budget_ms.setter
    def budget_ms(self, budget_ms: float | None) -> None:
        self._ask(self.tier, budget_ms)

    def _ask(self, tier: Tier, budget_ms: float | None) -> None:
        self._asked = (tier, budget_ms)
        plan = self.machine_speed.plan(tier, None if budget_ms is None else budget_ms * 1e-3)
        self._give(plan.tier, None if plan.budget_s is None else plan.budget_s * 1e3)

    def _give(self, tier: Tier, budget_ms: float | None) -> None:
        # Milliseconds are what is recorded: live and replay must come to the same seconds.
        self.given = (tier, budget_ms)
        self._reconstructor.tier = tier
        self._reconstructor.budget_s = None if budget_ms is None else budget_ms * 1e-3

    def use_reference(self, reference: Reference, realtime_ns: int) -> None:
        """Measure changes against `reference` from the next dual scan on, and follow from it."""
        self.reference_realtime_ns = realtime_ns
        if self._tracker is None:
            self._reconstructor.set_reference(reference)
            self._note_reference(reference)
        else:
            self._note_reference(self._tracker.begin(reference))

    def _note_reference(self, reference: Reference) -> None:
        """Say, and record, that this reference is in force."""
        self.reference = reference
        if self._marked is not None:
            self._marked.references += 1
            self._record_reference()

    def start_tare(self, answer: Future[Mapping[str, Any]] | None = None) -> None:
        """Take a reference from the dual scans to come; `answer` gets what it became, or why."""
        self._tare = self._tare or Tare(self._tare_scans)
        self._tare_deadline_s = time.monotonic() + self._no_data_s
        if answer is not None:
            self._tare.answers.append(answer)

    @property
    def _no_data_s(self) -> float:
        return max(NO_DATA_S, self.frame_rate.pace.few_s)

    def check_tare(self) -> None:
        """Give up a tare on command for which nothing comes."""
        if self._tare and self._tare.answers and time.monotonic() > self._tare_deadline_s:
            self._refuse_tare(
                self._tare,
                CommandError(
                    f"no usable dual scan for {self._no_data_s:.3g} s",
                    "`tactomo status` shows what the ports say",
                    "no_data",
                ),
            )

    def process(self, dual: DualScan, timing: Timing, lost: set[Channel]) -> None:
        """Turn one dual scan into a frame; `lost` are the channels that are not to be expected."""
        mark = dual.mark
        if mark is not None:
            self._obey(mark)
        self._follow_recording(dual)
        volts = {scan.channel: scan.volts for scan in dual.scans}
        self._publish_scan(dual, timing, volts)
        frame = self._reconstruct(volts, _saturated(dual), is_exact=mark is not None)
        self._record_mark(dual, timing)  # first: whatever was seen is in the recording
        if frame is not None:
            self._contacts = len(frame.contacts)
            self._publish_frame(dual, timing, frame)
        self._go_on_taring(volts, lost)

    def _record_mark(self, dual: DualScan, timing: Timing) -> None:
        """Put into the recording that a frame was made of these scans, and how."""
        if self._marked is None or dual.recording != self._marked.number:
            return
        keys = tuple(ScanKey(s.channel, s.counter, s.device_us) for s in dual.scans)
        tier, budget_ms = self.given
        done = Mark(
            keys,
            str(tier),
            budget_ms,
            timing=timing,
            reference_number=self._marked.references or None,
            calibration_number=self._marked.calibrations,
        )
        self._marked.add(mark_entry(done, time.monotonic_ns(), time.time_ns()))

    def _obey(self, mark: Mark) -> None:
        """Put in force what was in force when this dual scan was recorded."""
        if self.given != (mark.tier, mark.budget_ms):
            self._asked = (Tier(mark.tier), mark.budget_ms)
            self._give(*self._asked)
        if mark.is_cold:
            self._reconstructor.reset()
        if mark.is_cut:
            self._reconstructor.forget_shape()
        if mark.calibration is not None and mark.calibration != self._calibration_text:
            source = "the calibration that was read again while this was recorded"
            recorded = recorded_calibration(mark.calibration, source, self._description)
            self._take_calibration(recorded, mark.calibration)
        if mark.reference is not None:
            self.reference_realtime_ns = time.time_ns()
            self._reconstructor.set_reference(mark.reference)
            self._note_reference(mark.reference)

    def _follow_recording(self, dual: DualScan) -> None:
        """Begin to mark frames with the first dual scan that a recording holds whole.

        Frames depend on those before them; from here on, a replay can do the same from the start.
        Which contacts are which is not forgotten: whoever follows one need not know of recordings.
        """
        active = self._recorder.active
        if active is self._marked:
            if time.monotonic() >= self._repeat_s:
                self._record_reference()
                self._record_calibration()
            return
        if active is None:
            self._marked = None
        elif dual.recording == active.number:
            self._marked = active
            active.previous = None
            self._reconstructor.forget_shape()
            if self.reference is not None:
                active.references += 1
                self._record_reference()
            if active.calibration != self._calibration_text:
                active.calibrations += 1
                self._record_calibration()

    def _record_reference(self) -> None:
        """Put the reference into the recording, and again every minute: some of it may be lost."""
        self._repeat_s = time.monotonic() + REPEAT_S
        if self.reference is not None and self._marked is not None:
            number = self._marked.references
            times = (time.monotonic_ns(), self.reference_realtime_ns)
            self._marked.add(reference_entry(self.reference, number, *times))

    def _record_calibration(self) -> None:
        """Likewise the calibration, where it is another one than the recording began with."""
        if self._marked is not None and self._marked.calibrations:
            number, text = self._marked.calibrations, self._calibration_text
            self._marked.add(calibration_entry(text, number, time.monotonic_ns(), time.time_ns()))

    def _reconstruct(
        self, volts: Volts, saturated: list[Modality], *, is_exact: bool
    ) -> Reconstruction | None:
        """Make a frame; where it is exact, against the reference that the recording had then."""
        started_s = time.perf_counter()
        scans = (volts.get(Channel.MAGNITUDE), volts.get(Channel.STRUCTURE))
        try:
            if self._tracker is None or is_exact:
                frame = self._reconstructor.reconstruct(*scans, saturated=saturated)
            else:
                acquired_s = self.acquired_monotonic_ns * 1e-9
                frame = self._tracker.reconstruct(acquired_s, *scans, saturated=saturated)
                self._follow(self._tracker)
        except Exception as error:  # a robot is better off with the next frame than with none
            self._reconstructor.reset()
            if self._failure_limit.allows():
                log.exception("reconstruction_failed")
                self._on_event(
                    "reconstruction_failed",
                    "error",
                    f"{type(error).__name__}: {error}",
                    "this is a mistake in tactomo: please report it with a recording",
                )
            return None
        self._time("reconstruct", time.perf_counter() - started_s)
        for stage, seconds in frame.stage_s.items():
            self._time(stage, seconds)
        return frame

    def _follow(self, tracker: BaselineTracker) -> None:
        """Take over the reference that the tracker has put in force, and tell where it refuses."""
        if tracker.reference is not None and tracker.reference is not self.reference:
            self._note_reference(tracker.reference)
        if tracker.refusal and self._refusal_limit.allows():
            self._on_event(
                "baseline_refused",
                "warning",
                tracker.refusal,
                "take off what presses, and away what heats or cools the skin; once it is steady: "
                "`tactomo tare`",
            )

    def _publish_scan(self, dual: DualScan, timing: Timing, volts: Volts) -> None:
        header = scan_header(dual, timing)
        self.acquired_monotonic_ns = header["acquired_monotonic_ns"]
        if self._publisher.wants(SCAN):
            self._publisher.publish(SCAN, scan_fields(dual.counter, volts), header)

    def _publish_frame(self, dual: DualScan, timing: Timing, frame: Reconstruction) -> None:
        started_s = time.perf_counter()
        header = frame_header(dual, timing, frame)
        self._publisher.header = header
        self._publisher.publish(CONTACTS, contacts_fields(dual.counter, frame), header)
        active = self._recorder.active
        if self._publisher.wants(MAP) or (active is not None and active.with_maps):
            fields = map_fields(dual.counter, frame, self._description)
            self._publisher.publish(MAP, fields, header)
        self.frame_rate.add(time.monotonic_ns())
        self._time("publish", time.perf_counter() - started_s)

    def _go_on_taring(self, volts: Volts, lost: set[Channel]) -> None:
        tare = self._tare
        if tare is None:
            return
        needed = {channel for channel in self._channels if channel not in lost}
        if not needed or not needed <= volts.keys():
            return
        self._tare_deadline_s = time.monotonic() + self._no_data_s
        if not tare.add(volts, needed):
            return
        try:
            reference = tare.reference()
        except CommandError as refusal:
            self._refuse_tare(tare, refusal)
            return
        except ModelError as error:
            self._refuse_tare(tare, CommandError(str(error), "", "tare_refused"))
            return
        self._tare = None
        self.use_reference(reference, time.time_ns())
        shown = f", while {self._contacts} contact(s) were shown" if self._contacts else ""
        self._on_event("tared", "info", f"{reference.scans} dual scans{shown}")
        for answer in tare.answers:  # when all is in force: a status asked for now shows it
            answer.set_result({"scans": reference.scans, "contacts": self._contacts})

    def _refuse_tare(self, tare: Tare, refusal: CommandError) -> None:
        self._tare = None
        self._on_event("tare_refused", "warning", refusal.cause, refusal.next_step)
        if self.reference is None:
            self.start_tare()  # without a reference there is nothing else to do
        for answer in tare.answers:
            answer.set_exception(refusal)

    def _time(self, stage: str, seconds: float) -> None:
        if stage not in self.stages:  # a new dictionary, for those who iterate over the old one
            self.stages = {**self.stages, stage: Durations()}
        self.stages[stage].add(seconds)


def recorded_calibration(
    text: str, source: str, description: SensorDescription
) -> PressureCalibration | None:
    """Return a pressure calibration that a recording holds; None where it does not fit here.

    `source` names it in the log.
    """
    if not text:
        return None
    try:
        found = parse_calibration(text, source)
    except CalibrationError as error:
        log.warning("calibration_unused", detail=str(error))
        return None
    return None if found.subject.mismatch(found.subject.sensor, description) else found


def _saturated(dual: DualScan) -> list[Modality]:
    """Return the channels whose device says that its converter clipped."""
    clipped = {scan.channel for scan in dual.scans if scan.flags & ScanFlag.SATURATED}
    return [name for name, channel in MODALITIES if channel in clipped]

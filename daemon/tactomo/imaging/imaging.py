"""One dual scan to one frame: check, reconstruct, publish, and mark it in the recording.

For use by the pipeline thread; nothing in here waits. What others may read (`rest`, `stages`,
...) is written by that thread alone.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any, Final

import structlog
from tactomo_client.messages import CONTACTS, MAP, SCAN
from tactomo_client.schema import TOUCHES_SEEN
from tactomo_models import (
    BaselineTracker,
    Flag,
    Reconstruction,
    Reconstructor,
    Reference,
    SensorDescription,
)
from tactomo_models.calibration.calibration_file import PressureCalibration
from tactomo_models.calibration.taught_skin import TaughtSkin
from tactomo_models.commissioning.known_skin import SkinAtStart, skin_at_start
from tactomo_models.scans.companion_forces import CompanionReading
from tactomo_models.scans.tare import Tare
from tactomo_protocol import Channel, ScanFlag

from tactomo.config import BaselineConfig
from tactomo.events import OnEvent
from tactomo.imaging import frames
from tactomo.imaging.calibration_in_force import CalibrationInForce
from tactomo.imaging.companions import Companions, FrozenConverters
from tactomo.imaging.frame_log import FrameLog, InForce
from tactomo.imaging.kept_reference import KeptReference, KnownSkin
from tactomo.imaging.method_in_force import Effort, MethodInForce, ProcessorShare
from tactomo.imaging.tare import Taring
from tactomo.plain import counted
from tactomo.recordings.recorder import Recorder
from tactomo.scans import DualScan, FrameRecord, Timing, Volts
from tactomo.stream.publisher import Publisher
from tactomo.timing import Durations, Rate, wall_clock_ns

log = structlog.get_logger()

# Of the first frame after a replay was moved, which is often the only one that is looked at: more
# than 99 % of cold starts with up to four contacts take (docs/accuracy.md), in modelled work.
MOVED_BUDGET_MS: Final = 1000.0


@dataclass(frozen=True)
class Doubt:
    """Why frames are flagged `reference_disputed`: something may have lain on the tared skin."""

    ends_at_rest: bool = False  # whether a quiet frame ends it: an older reference is in force
    before: KnownSkin | None = None  # by which the skin may be at rest: that of before the tare
    was_touched: bool = False  # whether contacts were shown since
    is_quiet: bool = True  # whether the last frame showed nothing

    @property
    def is_settled_by_hand(self) -> bool:
        """Whether whoever tares now has touched the skin and let go: what still lies there stays.

        That skin is the one that is meant: nothing else can tell it from a loaded one.
        """
        return self.was_touched and self.is_quiet


class Imaging:
    """Reconstructs dual scans against the reference in force, and publishes the frames."""

    def __init__(
        self,
        description: SensorDescription,  # the sensor
        reconstructor: Reconstructor,  # belongs to this class from now on
        # of pressure, the sensor's own; None for the description's curve
        calibration: PressureCalibration | None,
        taught: TaughtSkin | None,  # what the sensor was taught; None where nothing was
        tare_scans: int,  # dual scans for a reference
        waits: bool,  # whether frames wait while it is found how a reference's sheets are
        baseline: BaselineConfig,  # whether and how fast the reference follows the skin
        # the sensor's last reference; None where it is neither used nor kept
        kept: KeptReference | None,
        recorder: Recorder,  # is told of which scans frames were made
        publisher: Publisher,  # gets the frames
        on_event: OnEvent,  # told what people should know
    ) -> None:
        # what changes are measured against, and since when; None before the first tare
        self.rest: KnownSkin | None = None
        self.stages: dict[str, Durations] = {}  # how long each stage takes
        self.frame_rate = Rate()  # how often a frame is published
        self.acquired_monotonic_ns = 0  # when the newest dual scan was acquired; 0 before the first
        self._description = description
        self._reconstructor = reconstructor
        self._tracker = (
            BaselineTracker(reconstructor, baseline.time_constant_s) if baseline.track else None
        )
        self._marks = FrameLog(recorder)
        self.method = MethodInForce(reconstructor)  # requested and effective
        # of pressure, the one in force
        self.calibration = CalibrationInForce(
            description, reconstructor, recorder, on_event, calibration, taught
        )
        # takes references
        self.taring = Taring(
            tare_scans,
            description.channels,
            self.frame_rate,
            reconstructor.take,
            waits,
            self._take,
            self._fall_back,
            on_event,
        )
        self._frozen = FrozenConverters(description.pairs, on_event)
        self._companions = Companions(description, on_event)
        self._kept = kept
        self._doubt: Doubt | None = None  # about the reference in force
        self._recorder = recorder
        self._publisher = publisher
        self._on_event = on_event
        self._contacts = 0  # in the last frame
        self.companions: dict[str, Any] = {}  # what `status` says of them; swapped
        self._has_moved = False  # a replay; the next frame is found anew
        self._took_s: tuple[float, float] | None = None  # processor time and time; None if quiet
        self._processor = ProcessorShare()

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
    def in_force(self) -> InForce:
        """What the next frame is made with."""
        is_disputed = self._doubt is not None
        return InForce(self.rest, *self.method.effective, self.calibration.text, is_disputed)

    @property
    def reference(self) -> Reference | None:
        """What changes are measured against; None before the first tare."""
        return None if self.rest is None else self.rest.reference

    @property
    def taken_ns(self) -> int:
        """When the reference was taken, nanoseconds since 1970; 0 before the first tare."""
        return 0 if self.rest is None else self.rest.realtime_ns

    def has_reference(self, channel: Channel) -> bool:
        """Whether there is something to measure this channel's changes against."""
        return getattr(self.reference, channel, None) is not None

    def use_reference(self, reference: Reference, realtime_ns: int) -> None:
        """Measure changes against `reference` from the next dual scan on, and follow from it.

        Where it had drifted itself, that is as good as a tare.
        """
        as_it_is = reference if self._tracker is None else reference.taken_as_it_is()
        self._use(self._reconstructor.take(as_it_is), realtime_ns)

    def _use(self, tare: Tare, realtime_ns: int) -> None:
        (self._reconstructor.use if self._tracker is None else self._tracker.begin)(tare)
        self._note_reference(KnownSkin(tare.reference, realtime_ns))

    def _take(self, tare: Tare, is_asked: bool, contacts: int) -> bool:
        """Use a reference that was taken; at the start only if nothing lies on the skin.

        One that was taken while contacts were shown is disputed, and not kept for the next start;
        so is the next one, if contacts explain how it differs from the one before the dispute.
        What a companion without a reading meanwhile read at rest before stays.
        Returns whether it is in force.
        """
        known = None if is_asked or self.reference is not None else self._known()
        earlier = self.rest or known
        if earlier is not None and earlier.reference.companions:
            felt = dict([*earlier.reference.companions, *(tare.reference.companions or ())])
            tare = replace(tare, reference=replace(tare.reference, companions=tuple(felt.items())))
        reference = tare.reference
        if known is not None:
            found = skin_at_start(self._reconstructor, known.reference, reference, known.age_s)
            if found is SkinAtStart.LOADED:
                self._prefer(known, "something seems to lie on the skin")
                return False
            if found is SkinAtStart.OTHER:
                self._on_event(
                    "skin_changed",
                    f"neither contacts nor drift explain how the skin differs from {known.words}",
                    "if something lies on it, take it off; then `tactomo tare`",
                )
        is_first = not is_asked and self.reference is None
        is_unreadable = is_first and self._kept is not None and self._kept.is_unreadable
        is_still_loaded = not contacts and self._is_still_loaded(reference)
        before = self._known_before() if contacts or is_still_loaded else None
        is_disputed = contacts or is_still_loaded or is_unreadable
        self._doubt = Doubt(before=before) if is_disputed else None
        self._use(tare, wall_clock_ns())
        if contacts:
            self._on_event(
                "reference_disputed",
                f"the reference was taken, and shown meanwhile: {counted(contacts, 'contact')}",
                "take everything off the skin; if contacts are still shown then: `tactomo tare`",
            )
        elif is_still_loaded:
            self._on_event(
                "reference_disputed",
                "the reference was taken, and contacts explain how it differs from the one before "
                "the dispute: something still seems to lie on the skin",
                "take everything off the skin; if something is to stay on it: press beside that, "
                "let go, and `tactomo tare`",
            )
        elif self._kept is not None and self._doubt is None:
            self._kept.keep(reference, self.calibration.device_ids)
        return True

    def _is_still_loaded(self, reference: Reference) -> bool:
        """Whether a tare with nothing shown was taken under what disputed the one before it."""
        doubt = self._doubt
        if doubt is None or doubt.before is None or doubt.is_settled_by_hand:
            return False
        before = doubt.before
        found = skin_at_start(self._reconstructor, before.reference, reference, before.age_s)
        return found is SkinAtStart.LOADED

    def _known_before(self) -> KnownSkin | None:
        """The newest reference that was taken while nothing was shown."""
        if self._doubt is not None and self._doubt.before is not None:
            return self._doubt.before
        if self.rest is None:
            return None
        return replace(self.rest, reference=self.rest.reference.taken_as_it_is())

    def _fall_back(self, why: str) -> bool:
        """Use the reference that is kept, since none can be taken; returns whether there is one."""
        known = self._known()
        if known is not None:
            self._prefer(known, why)
        return known is not None

    def _known(self) -> KnownSkin | None:
        return None if self._kept is None else self._kept.read(self.calibration.device_ids)

    def _prefer(self, known: KnownSkin, why: str) -> None:
        self._doubt = Doubt(ends_at_rest=True)
        self.use_reference(known.reference, known.realtime_ns)
        self._on_event(
            "reference_disputed",
            f"{why}: the reference of {known.words} is used",
            "take everything off the skin; if contacts are still shown then: `tactomo tare`",
        )

    def _note_reference(self, rest: KnownSkin) -> None:
        """Say that this reference is in force."""
        if self.rest is None:
            self._publisher.lift("no_reference")
        self.rest = rest
        self.calibration.meet_skin(rest.reference)
        self.taring.has_reference = True

    @property
    def maps_published(self) -> int:
        """The newest map's number."""
        return int(self._publisher.envelope(MAP)["sequence"])

    def tell_status(self) -> None:
        """Have the status published now."""
        self._publisher.tell_status()

    def forget(self) -> None:
        """Take the next dual scan for the first one: it does not follow on those before."""
        self._reconstructor.reset()
        self._frozen.forget()
        self._has_moved = True
        self._publisher.tell_status()

    def use_calibration(
        self, calibration: PressureCalibration | None, taught: TaughtSkin | None
    ) -> dict[str, Any]:
        """Put both in force, None for what the description says; return what a client gets.

        Raises CommandError where one is another device's or skin's; what was in force stays so.
        """
        self.calibration.replace(calibration, taught)
        self._publisher.tell_status()
        return {
            "calibration": calibration and frames.calibration_fields(calibration),
            "taught": taught and frames.taught_fields(taught),
        }

    def process(self, dual: DualScan, timing: Timing, lost: set[Channel]) -> None:
        """Turn one dual scan into a frame; `lost` are the channels that are not to be expected."""
        mark = dual.mark
        if mark is not None:
            self._obey(mark)
        usual = self.method.effective
        if self._has_moved:
            self.method.lengthen(MOVED_BUDGET_MS)
        if self._marks.follow(dual):
            # Which contacts are which is not forgotten: whoever follows one need not know of this.
            self._reconstructor.forget_shape()
        volts = {scan.channel: scan.volts for scan in dual.scans}
        self._publish_scan(dual, timing, volts)
        volts = self._frozen.without(volts, self.reference, self.taring.is_on)
        before = None if self._doubt is None else self._doubt.before
        if before is not None and before.reference.is_at_rest(volts):
            self._restore(before)
        clipped = [scan.channel for scan in dual.scans if scan.flags & ScanFlag.SATURATED]
        companions = self._companions.read(dual)
        frame = self._reconstruct(volts, clipped, companions, is_exact=mark is not None)
        if frame is not None and self._doubt is not None:
            frame = self._doubted(frame, self._doubt)
        self._marks.mark(dual, timing, self.in_force)  # first: what was seen is recorded
        if self._has_moved:
            self._has_moved = False
            self.method.put_in_force(usual)
        if frame is not None:
            self._contacts = len(frame.contacts)
            self.companions = frames.companion_fields(self._description, frame)
            self._publish_frame(dual, timing, frame)
        self.taring.add(volts, lost, self._contacts, companions)

    def share_processor(self, dropped: int) -> None:
        """Give frames less work where others take the processor, and more where they do no longer.

        To be called after `process`, with how many dual scans were left out since the start.
        """
        if self._took_s is None:
            return
        processor, before = self._processor, self._processor.of_work
        if not processor.note(*self._took_s, dropped, time.monotonic()):
            return
        self.method.give_share(processor.of_work)
        share = processor.of_work
        if share < before:
            self._on_event(
                "processor_shared",
                "other programs use the processor: this skin got "
                f"{processor.of_core:.0%} of a core while it computed, and frames get "
                f"{share:.0%} of their work",
                "give the daemon more of the processor, or fewer skins; frames then get their work "
                "back",
                reason=f"{share}",
            )
        elif share == 1:
            self._on_event("processor_free", "frames get all of their work")

    def _doubted(self, frame: Reconstruction, doubt: Doubt) -> Reconstruction:
        """Flag a frame, unless it ends the doubt: the skin is again as it was known."""
        is_at_rest = frame.tier == "quiet" and TOUCHES_SEEN.issuperset(frame.flags.names())
        if doubt.ends_at_rest and is_at_rest:
            self._doubt = None
            detail = "the skin is at rest by the reference that was kept"
            self._on_event("reference_confirmed", detail)
            return frame
        was_touched = doubt.was_touched or bool(frame.contacts)
        self._doubt = replace(doubt, was_touched=was_touched, is_quiet=frame.tier == "quiet")
        return replace(frame, flags=frame.flags | Flag.REFERENCE_DISPUTED)

    def _restore(self, known: KnownSkin) -> None:
        """Settle the dispute about a tare: the skin is at rest by the reference before it."""
        self._doubt = None
        self.use_reference(known.reference, known.realtime_ns)
        self._on_event(
            "reference_confirmed",
            "the skin is at rest by the reference before the tare, which is used again",
        )

    def _obey(self, mark: FrameRecord) -> None:
        """Put in force what was in force when this dual scan was recorded."""
        self.method.obey(Effort(mark.tier, mark.budget_ms))
        if mark.is_cold:
            self._reconstructor.reset()
        self.calibration.obey(mark.calibration)
        self._doubt = Doubt() if mark.is_disputed else None
        if mark.reference is not None and mark.reference is not self.reference:
            self._reconstructor.set_reference(mark.reference)
            self._note_reference(KnownSkin(mark.reference, wall_clock_ns()))

    def _reconstruct(
        self,
        volts: Volts,
        saturated: list[Channel],
        companions: list[CompanionReading],
        *,
        is_exact: bool,
    ) -> Reconstruction | None:
        """Make a frame; where it is exact, against the reference that the recording had then."""
        started_s, cpu_s = time.perf_counter(), time.thread_time()
        self._took_s = None
        scans = (volts.get(Channel.MAGNITUDE), volts.get(Channel.STRUCTURE))
        try:
            if self._tracker is None or is_exact:
                measurement = self._reconstructor.compare(
                    *scans, saturated=saturated, companions=companions
                )
                frame = self._reconstructor.solve(measurement)
            else:
                acquired_s = self.acquired_monotonic_ns * 1e-9
                frame = self._tracker.reconstruct(
                    acquired_s, *scans, saturated=saturated, companions=companions
                )
                self._follow(self._tracker)
        except Exception as error:  # a robot is better off with the next frame than with none
            self._reconstructor.reset()
            words = f"{type(error).__name__}: {error}"
            step = "this is a mistake in tactomo: please report it with a recording"
            if self._on_event("reconstruction_failed", words, step):
                log.exception("reconstruction_failed")
            return None
        took_s = time.perf_counter() - started_s
        if frame.tier != "quiet":
            self._took_s = time.thread_time() - cpu_s, took_s
        self._time("reconstruct", took_s)
        for stage, seconds in frame.stage_s.items():
            self._time(stage, seconds)
        if frame.failure:
            step = (
                "frames are tikhonov's until the method works: correct it, or choose another method"
            )
            self._on_event("method_failed", frame.failure, step)
        return frame

    def _follow(self, tracker: BaselineTracker) -> None:
        """Take over the reference that the tracker has put in force, and tell where it refuses."""
        if tracker.reference is not None and tracker.reference is not self.reference:
            self._note_reference(KnownSkin(tracker.reference, self.taken_ns))
            if self._kept is not None and (self._doubt is None or self._doubt.ends_at_rest):
                self._kept.follow(tracker.reference, self.calibration.device_ids)
        if tracker.refusal:
            self._on_event(
                "baseline_refused",
                tracker.refusal,
                "remove whatever presses, heats or cools the skin; once the skin is steady: "
                "`tactomo tare`",
            )

    def _publish_scan(self, dual: DualScan, timing: Timing, volts: Volts) -> None:
        header = frames.scan_header(dual, timing)
        self.acquired_monotonic_ns = header["acquired_monotonic_ns"]
        if self._publisher.wants(SCAN):
            self._publisher.publish(SCAN, frames.scan_fields(dual.counter, volts), header)

    def _publish_frame(self, dual: DualScan, timing: Timing, frame: Reconstruction) -> None:
        started_s = time.perf_counter()
        self.frame_rate.add(time.monotonic_ns())  # first: what was seen is counted
        header = frames.frame_header(dual, timing, frame)
        active = self._recorder.active
        # before the contacts: who hears them and then asks for maps gets the next one's
        wants_map = self._publisher.wants(MAP) or (active is not None and active.with_maps)
        self._publisher.publish(CONTACTS, frames.contacts_fields(dual.counter, frame), header)
        if wants_map:
            fields = frames.map_fields(dual.counter, frame, self._description)
            self._publisher.publish(MAP, fields, header)
        self._time("publish", time.perf_counter() - started_s)

    def _time(self, stage: str, seconds: float) -> None:
        if stage not in self.stages:  # a new dictionary, for those who iterate over the old one
            self.stages = {**self.stages, stage: Durations()}
        self.stages[stage].add(seconds)

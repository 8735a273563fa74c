"""The frames of a recording, for commands that draw or write them; made first where it has none."""

from __future__ import annotations

import contextlib
import heapq
import math
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal, NamedTuple

import typer

from tactomo.cli.children import interrupt_at_end
from tactomo.cli.output import progress_bar, say
from tactomo.errors import RecordingError, TactomoError

if TYPE_CHECKING:
    from tactomo_client import Frame
    from tactomo_client.recording import Recording
    from tactomo_models import SensorDescription

MARGIN_S = 30.0  # how much earlier or later than it was acquired a frame may have been published


FromOption = Annotated[
    float, typer.Option("--from", min=0.0, metavar="SECONDS", help="Leave out everything before.")
]
ToOption = Annotated[
    float | None,
    typer.Option("--to", min=0.0, metavar="SECONDS", help="Leave out everything after. [the end]"),
]


class TimedFrame(NamedTuple):
    """A frame and its time in the recording."""

    time_s: float  # when it was acquired, seconds from the recording's beginning
    frame: Frame
    age_s: float | None
    """How old it was when it was published; None where it was made of the recording just now."""


@dataclass(frozen=True)
class RecordedFrames:
    """The frames of a recording between two times."""

    path: Path  # the recording that was given
    sensor: str  # the sensor's name
    # what the sensor is made of; None where the recording does not say it
    description: SensorDescription | None
    start_ns: int  # when the recording begins, nanoseconds since 1970
    start_s: float  # the first frames that are wanted, seconds from there
    end_s: float  # where the frames end that are wanted
    _given: Recording
    _remade: Sequence[Recording]  # of each file, if it had to be made; otherwise none

    def moments(self, kind: Literal["map", "contacts"] = "map") -> Iterator[TimedFrame]:
        """Yield the frames in the order of their times, one at a time."""
        every = self._made_moments(kind) if self._remade else self._kept_moments(kind)
        # A frame may have been acquired just before the recording's first message.
        start_s = self.start_s or -float("inf")
        return (moment for moment in every if start_s <= moment.time_s < self.end_s)

    def _kept_moments(self, kind: Literal["map", "contacts"]) -> Iterator[TimedFrame]:
        """Yield recorded frames, by the monotonic clock: the wall clock jumps."""
        window = {"start_s": max(0.0, self.start_s - MARGIN_S), "end_s": self.end_s + MARGIN_S}
        session, zero_ns = "", 0
        for frame in self._given.frames(kind, **window):
            if frame.session != session:  # another run of the daemon, maybe after a reboot
                session = frame.session
                since_start_ns = frame.acquired_realtime_ns - self.start_ns
                zero_ns = frame.acquired_monotonic_ns - since_start_ns
            yield TimedFrame((frame.acquired_monotonic_ns - zero_ns) * 1e-9, frame, frame.age_s)

    def _made_moments(self, kind: Literal["map", "contacts"]) -> Iterator[TimedFrame]:
        """Yield frames that were made of a replay, which knows its own times only."""
        for file, made in zip(self._given.files, self._remade, strict=True):
            arrivals = _arrivals(file)
            # Their ages are of this replay: whether a frame was stale live, nobody knows.
            every = made.frames(kind, stale_after_s=math.inf) if made.has_frames else ()
            for frame in every:
                found = (
                    clock_ns for counter, clock_ns in arrivals if counter == frame.scan_counter
                )
                clock_ns = next(found, None)
                if clock_ns is None:
                    break  # cannot be: a frame is made of scans
                at_that_time = replace(
                    frame, acquired_realtime_ns=clock_ns, acquired_monotonic_ns=clock_ns
                )
                yield TimedFrame((clock_ns - self.start_ns) * 1e-9, at_that_time, None)

    def with_progress(self, moments: Iterator[TimedFrame], doing: str) -> Iterator[TimedFrame]:
        """Yield the moments, with a bar on standard error that shows how far this has come."""
        length_s = min(self.end_s, self._given.duration_s) - self.start_s
        with progress_bar(doing) as show:
            for moment in moments:
                show(moment.time_s - self.start_s, max(length_s, 1e-9))
                yield moment


def _arrivals(path: Path) -> Iterator[tuple[int, int]]:
    """Yield the counter of every scan in a recording, and when it came, on its steady clock."""
    from tactomo_protocol import Scan

    from tactomo.recordings.recording import open_recording

    recording = open_recording(path)
    ports = map(recording.packets, range(len(recording.origin.ports)))
    for clock_ns, packet in heapq.merge(*ports, key=lambda arrival: arrival[0]):
        if isinstance(packet, Scan):
            yield packet.counter, clock_ns


@contextlib.contextmanager
def recorded_frames(
    path: Path,  # a recording, or the folder of one that was cut into files
    description: str | None,  # what the sensor is made of; None for what the recording says
    # leave out what was acquired before, seconds from the recording's beginning
    start_s: float = 0.0,
    end_s: float | None = None,  # leave out what was acquired from there on
    scratch: Path | None = None,  # a folder with room for the frames, if they have to be made
) -> Iterator[RecordedFrames]:
    """Open a recording's frames; where it has none, reconstruct it first, by the code of live.

    Raises:
        TactomoError: the recording cannot be read or reconstructed, or the times are no times.
    """
    from tactomo_client.recording import open_recording
    from tactomo_models import load_description

    from tactomo.recordings.recording import open_recording as open_bytes

    if end_s is not None and end_s <= start_s:
        raise typer.BadParameter(f"--to {end_s:g} is not after --from {start_s:g}")
    given = open_recording(path)
    known = None
    try:
        origin = open_bytes(given.files[0]).origin
        known = load_description(description) if description else origin.read_description()
    except RecordingError:
        if not given.has_frames:
            raise
    with warnings.catch_warnings(), contextlib.ExitStack() as undo:
        # What a recording lacks is reported on standard error, each thing once.
        warnings.showwarning = lambda message, *_, **__: say(str(message), err=True)
        remade: list[Recording] = []
        if not given.has_frames or description:
            folder = undo.enter_context(
                tempfile.TemporaryDirectory(prefix=".tactomo-", dir=scratch)
            )
            assert known is not None
            remade = _reconstructed(given, known, Path(folder))
        window = start_s, float("inf") if end_s is None else end_s
        yield RecordedFrames(path, given.sensor, known, given.start_ns, *window, given, remade)


def _reconstructed(given: Recording, known: SensorDescription, folder: Path) -> list[Recording]:
    """Replay each file of a recording through a daemon of our own, into one that has frames."""
    from tactomo_client.recording import open_recording

    interrupt_at_end()
    made: list[Recording] = []
    for file in given.files:
        _reconstruct_file(file, given.sensor, known, folder / file.name)
        made.append(open_recording(folder / file.name))
    if not any(recording.has_frames for recording in made):
        raise TactomoError(
            f"{given.path} cannot be reconstructed: no dual scan of {known.name} is in it",
            "look at it with `tactomo info`; it may need another --description",
        )
    return made


def _reconstruct_file(path: Path, sensor: str, known: SensorDescription, target: Path) -> None:
    from rich.text import Text

    from tactomo.cli.console import Console
    from tactomo.config import load_config
    from tactomo.log import configure_logging
    from tactomo.recordings.recording import open_recording
    from tactomo.service.daemon import Daemon

    configure_logging("error")
    recording = open_recording(path)
    with tempfile.TemporaryDirectory(prefix="tactomo-") as sockets:  # their paths must be short
        config = load_config(
            name=sensor or None,
            description=known.name,
            ports=recording.replay_urls(speed=0),
            stream=f"ipc://{sockets}/stream",
            control=f"ipc://{sockets}/control",
            lossless=True,
            exit_at_end=True,
            recording={"file": target, "maps": True},
        )
        with Console(stderr=True).status(Text(f"reconstructing {path.name}")):
            daemon = Daemon(config, description=known)
            daemon.start()
            try:  # not by `run`, for which Ctrl-C is a good end
                status = daemon.wait()
            finally:
                daemon.stop()
    if status != 0:
        raise TactomoError(f"{path} could not be replayed", "`tactomo replay` tells more")
    if daemon.recording_failure:
        raise TactomoError(
            f"cannot reconstruct {path}: {daemon.recording_failure}",
            "make room for its maps, or name a file where there is more",
        )


CLOCK_STEP_S: Final = 0.1
"""A wall clock that leaves the steady one by more between two frames was set: time daemons slew
what is less (ntpd up to 0.128 s, and by at most 0.5 ms a second)."""


class Gaps:
    """Counts what is missing or odd among frames that pass by; nothing is filled in."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._first_s: dict[str, float] = {}
        self._flags: Counter[str] = Counter()
        self.first_step_s = 0.0  # by how much the wall clock was set first, s; 0 where it was not
        self._last: TimedFrame | None = None

    def watch(self, moments: Iterator[TimedFrame]) -> Iterator[TimedFrame]:
        """Yield the moments as they are."""
        for moment in moments:
            self._add(moment)
            self._last = moment
            yield moment

    def lines(self) -> list[str]:
        """Return what there was, a sentence each."""
        flags = ", ".join(f"{flag} {count}" for flag, count in sorted(self._flags.items()))
        sentences = {
            "lost": "frames were published that the recording does not hold",
            "left out": "dual scans were taken but not reconstructed",
            "set": f"steps of the wall clock, the first by {self.first_step_s:+.3f} s; times here "
            "go by the steady clock",
            "back": "frames are not later than the one before",
            "restart": "restarts of the daemon: contact identities begin anew",
            "no map": "frames have no map",
            "unknown": f"frames where a press may be missing: {flags or 'stale'}",
        }
        return [
            f"{self._counts[what]} {sentence} (the first at {self._first_s[what]:.3f} s)"
            for what, sentence in sentences.items()
            if self._counts[what]
        ]

    def _count(self, what: str, moment: TimedFrame, count: int = 1) -> None:
        if count > 0:
            self._counts[what] += count
            self._first_s.setdefault(what, moment.time_s)

    def _add(self, moment: TimedFrame) -> None:
        frame, last = moment.frame, self._last
        lost = missing(last, moment, "sequence")
        self._count("lost", moment, lost)
        self._count("left out", moment, missing(last, moment, "scan_counter") - lost)
        if frame.x_mm is not None and frame.map is None and frame.structure is None:
            self._count("no map", moment)
        if not frame.is_known:
            self._count("unknown", moment)
            self._flags.update(frame.flags)
        if last is None:
            return
        self._count("back", moment, moment.time_s <= last.time_s)
        if frame.session != last.frame.session:
            self._count("restart", moment)
        elif abs(step_s := _wall_less_steady_s(moment) - _wall_less_steady_s(last)) > CLOCK_STEP_S:
            self.first_step_s = self.first_step_s or step_s
            self._count("set", moment)


def missing(last: TimedFrame | None, moment: TimedFrame, counter: str) -> int:
    """Return how many a frame's counter has left out since the frame before of the same run."""
    if last is None or last.frame.session != moment.frame.session:
        return 0
    step = getattr(moment.frame, counter) - getattr(last.frame, counter)
    return int(max(0, step - 1))


def _wall_less_steady_s(moment: TimedFrame) -> float:
    return (moment.frame.acquired_realtime_ns - moment.frame.acquired_monotonic_ns) * 1e-9

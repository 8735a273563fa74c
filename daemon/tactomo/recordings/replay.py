"""What a recording tells a daemon that replays it, beyond the bytes that its ports say again.

All ports of one replay share a `Playback`: when recorded bytes are due, and who may pause, move and
pace them. Its position is on the recording's steady clock. Moving it begins another *pass*: ports
go on reading elsewhere, and what they read before is left out.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final
from urllib.parse import parse_qsl, unquote, urlsplit

from tactomo_models import Reference, SensorDescription
from tactomo_models.calibration.calibration_file import PressureCalibration

from tactomo.errors import ConfigError, PortError
from tactomo.plain import counted
from tactomo.recordings.recording import REPLAY_SCHEME, Recording, open_recording
from tactomo.recordings.records import calibration_text, recorded_calibration
from tactomo.scans import FrameRecord, PortRead

MAX_LAG_S: Final = 0.25
"""How late bytes may be read before the replay waits for whoever reads them."""


@dataclass(eq=False)
class Playback:
    """Where a replay is, for any thread; speed 0 is as fast as it is taken."""

    start_ns: int  # of the recording
    _end_ns: int  # likewise
    _speed: float
    _last_ns: int  # from where something still comes
    is_exact: bool = False  # whether it goes by what was recorded of each frame
    passes = 0  # how often it was moved
    maps_before = 0  # how many maps were published before this pass
    loops = False  # whether the end is followed by the beginning
    waits_for_page = False  # whether it is paused until somebody looks
    is_paused = False  # whether it goes on by steps alone, of which every dual scan is to be shown
    _is_stepping = False

    def __post_init__(self) -> None:
        self.begin_ns = self.start_ns  # of this pass
        self.steered_ns = time.monotonic_ns()  # when somebody last steered it
        self._position_ns = self.start_ns  # when it was last paused, moved or paced otherwise
        self._since_ns: int | None = None  # when that was, monotonic; None before anything is read
        self._changed = threading.Condition(threading.RLock())

    @property
    def _stands(self) -> bool:
        return self.is_paused and not self._is_stepping

    @property
    def position_ns(self) -> int:
        """How far it is."""
        with self._changed:
            played_ns = 0
            if self._since_ns is not None and not self._stands:
                played_ns = round((time.monotonic_ns() - self._since_ns) * self._pace)
            return self._position_ns + played_ns

    def fields(self) -> dict[str, Any]:
        """Return what `status` says of it."""
        with self._changed:
            return {
                "position_s": (min(self.position_ns, self._end_ns) - self.start_ns) * 1e-9,
                "duration_s": (self._end_ns - self.start_ns) * 1e-9,
                "speed": self._speed,
                "paused": self.is_paused,
                "loop": self.loops,
                "waits_for_page": self.waits_for_page,
                "exact": self.is_exact,
                "maps_before": self.maps_before,
            }

    def wait_until_due(self, clock_ns: int | None, timeout_s: float, number: int) -> bool:
        """Wait until bytes are due, and return whether they are.

        Args:
            clock_ns: when they came, on the recording's clock; None where there are no more.
            timeout_s: how long to wait at most, seconds.
            number: the pass that they are of; in another one they are not due.
        """
        with self._changed:
            # Counted from the first read on, not from opening, so that two ports of one recording,
            # opened one after the other and then read together, keep time with each other.
            if self._since_ns is None:
                self._since_ns = time.monotonic_ns()
            wait_s = self._due_in_s(clock_ns)
            if wait_s > 0 and number == self.passes:
                self._changed.wait(min(wait_s, timeout_s))
            if number != self.passes or self._due_in_s(clock_ns) > 0:
                return False
            if clock_ns is not None:
                self._keep_up(clock_ns)
            return True

    def steer(self, paused: bool | None, speed: float | None, loop: bool | None) -> None:
        """Change what is given."""
        with self._changed:
            self._settle()
            if paused is not None:
                self.is_paused, self._is_stepping, self.waits_for_page = paused, False, False
            self._speed = self._speed if speed is None else speed
            self.loops = self.loops if loop is None else loop
            self.steered_ns = time.monotonic_ns()
            self._changed.notify_all()

    def step(self) -> None:
        """Go on, paced, until a dual scan is let through."""
        with self._changed:
            self._settle()
            self.is_paused = self._is_stepping = True
            self.waits_for_page = False
            self._changed.notify_all()

    def lets_through(self) -> bool:
        """Return whether a dual scan may be made a frame now; one that may ends a step."""
        with self._changed:
            may = not self._stands
            if self._is_stepping:
                self._settle()
                self._is_stepping = False
            return may

    def move(self, position_s: float) -> dict[str, Any]:
        """Go on `position_s` seconds after the beginning; while paused, by one dual scan.

        Returns the fields as they are before anything goes on.
        """
        with self._changed:
            ahead_ns = min(position_s * 1e9, self._last_ns - self.start_ns)
            self.begin_ns = self._position_ns = self.start_ns + round(ahead_ns)
            self._since_ns = None
            self._is_stepping = self.is_paused
            self.passes += 1
            self._changed.notify_all()
            return self.fields()

    @property
    def _pace(self) -> float:
        """Recorded seconds a second; a step goes at the recorded speed at most."""
        return min(self._speed or 1.0, 1.0) if self._is_stepping else self._speed

    def _keep_up(self, clock_ns: int) -> None:
        """Have the position follow bytes that are read as fast as possible, or late.

        Those that are read late are shown late: the position must not run ahead of the map.
        """
        if not self._pace:
            self._position_ns = max(self._position_ns, clock_ns)
        elif clock_ns >= self.begin_ns and -self._due_in_s(clock_ns) > MAX_LAG_S:
            self._position_ns, self._since_ns = clock_ns, time.monotonic_ns()

    def _settle(self) -> None:
        self._position_ns = self.position_ns
        self._since_ns = None if self._since_ns is None else time.monotonic_ns()

    def _due_in_s(self, clock_ns: int | None) -> float:
        if clock_ns is None or self._stands:
            return math.inf
        ahead_ns = clock_ns - self.position_ns
        return 0.0 if not self._pace else ahead_ns * 1e-9 / self._pace


@dataclass(frozen=True, slots=True)
class Replay:
    """What a recording tells the pipeline beyond the bytes on the ports."""

    # the dual scans to reconstruct; empty where the recording does not say
    marks: list[FrameRecord]
    reference: Reference | None  # the one in force at its beginning
    is_paced: bool  # whether bytes come in their own time rather than as fast as they are taken
    playback: Playback  # its time, which the ports share
    protocol: str  # what the ports speak
    calibration: PressureCalibration | None = None
    """Of pressure, that the daemon had when it began to record."""
    knows_calibration: bool = False
    """Whether it had that one, or none, and no other is to be looked for."""

    @property
    def is_lossless(self) -> bool:
        """Whether every dual scan is reconstructed: those that were, or as fast as they come."""
        return bool(self.marks) or not self.is_paced

    def marks_of_pass(self) -> list[FrameRecord]:
        """Return the marks from where the playback's pass began on.

        Of a pass that is not the first, the first mark brings what was in force.
        """
        if self.playback.passes == 0:
            return self.marks
        begin_ns = self.playback.begin_ns
        index = next((i for i, m in enumerate(self.marks) if m.clock_ns >= begin_ns), None)
        if index is None:
            return []
        known = self.marks[: index + 1]
        references = [mark.reference for mark in known if mark.reference is not None]
        texts = [mark.calibration for mark in known if mark.calibration is not None]
        if any(mark.calibration is not None for mark in self.marks):
            texts.insert(0, calibration_text(self.calibration))
        first = replace(
            self.marks[index],
            reference=references[-1] if references else None,
            calibration=texts[-1] if texts else None,
        )
        return [first, *self.marks[index + 1 :]]


class ReplayClock:
    """How far a replay is, on the recording's own clock. For use by one thread.

    Ports that are read as fast as they are taken, not paced, run ahead of one another: only what
    the slowest one has passed is over.
    """

    def __init__(self, ports: int, is_paced: bool) -> None:
        self._ports = ports
        self._is_paced = is_paced
        self._now_ns: dict[int, int] = {}  # the newest time on each port that goes on
        self._ended: set[int] = set()

    @property
    def has_ended(self) -> bool:
        """Whether every port is at its end."""
        return len(self._ended) == self._ports

    def follow(self, delivery: PortRead) -> int | None:
        """Take note of what a port said; return the time that has passed, None if none is sure."""
        if delivery.has_ended:
            self._ended.add(delivery.port)
            self._now_ns.pop(delivery.port, None)
        else:
            self._now_ns[delivery.port] = delivery.clock_ns
        if self._is_paced:
            return max(self._now_ns.values(), default=None)
        if len(self._now_ns) + len(self._ended) < self._ports:  # one was not heard yet
            return None
        return min(self._now_ns.values(), default=None)


def read_replay(urls: Sequence[str], description: SensorDescription) -> Replay | None:
    """Return what the recording says that the ports replay; None where they are live.

    Raises ConfigError where not all ports replay one recording of this sensor, RecordingError or
    PortError where a URL leads to no recording.
    """
    replayed = [url for url in urls if url.startswith(f"{REPLAY_SCHEME}://")]
    if not replayed:
        return None
    parsed = [parse_replay_url(url) for url in replayed]
    recording, _, speed = parsed[0]
    others = {(other.path, other_speed) for other, _, other_speed in parsed}
    if len(replayed) < len(urls) or len(others) > 1:
        raise ConfigError(
            f"the ports {', '.join(urls)} do not replay one recording",
            "replay all ports from one file at one speed, or none",
        )
    reference = recording.first_reference()
    if reference is not None:
        _check_reference(reference, recording, description)
    # A part of the ports cannot give the dual scans that all of them gave.
    is_whole = len(urls) == len(recording.origin.ports)
    marks = recording.marks() if is_whole else []
    if recording.origin.description_sha256 != description.sha256:
        marks = without_calibrations(marks)
    text = recording.origin.calibration
    calibration = recorded_calibration(text, f"the calibration in {recording.path}", description)
    had_none = not text and any(mark.calibration is not None for mark in marks)
    return Replay(
        marks=marks,
        reference=reference,
        is_paced=speed > 0,
        protocol=recording.origin.protocol,
        playback=Playback(
            recording.start_ns,
            recording.end_ns,
            speed,
            _last_ns(marks) or recording.end_ns,
            is_exact=bool(marks),
        ),
        calibration=calibration,
        knows_calibration=calibration is not None or had_none,
    )


def parse_replay_url(url: str) -> tuple[Recording, int, float]:
    """Return the recording, the port's number and the speed of a URL, or raise PortError."""
    parts = urlsplit(url)
    options = {"port": "0", "speed": "1", **dict(parse_qsl(parts.query))}
    try:
        port, speed = int(options.pop("port")), float(options.pop("speed"))
        if options or not 0 <= speed < float("inf"):
            raise ValueError
    except ValueError as error:
        raise PortError(
            f"{url} is not a replay URL",
            f"use {REPLAY_SCHEME}:///absolute/path.mcap?port=0&speed=1",
        ) from error
    recording = open_recording(unquote(parts.netloc + parts.path))
    ports = len(recording.origin.ports)
    if not 0 <= port < ports:
        raise PortError(
            f"{url}: the recording has {counted(ports, 'port')}, numbered from 0",
            "`tactomo info` shows what is in it",
        )
    return recording, port, speed


def without_calibrations(marks: Sequence[FrameRecord]) -> list[FrameRecord]:
    """Return marks that leave the pressure calibration as it is."""
    return [replace(mark, calibration=None) for mark in marks]


def _last_ns(marks: Sequence[FrameRecord]) -> int | None:
    """Return from when on the bytes of the last dual scan came: after those of the one before."""
    before = [mark.clock_ns for mark in marks if mark.clock_ns < marks[-1].clock_ns]
    return max(before) + 1 if before else None


def _check_reference(
    reference: Reference, recording: Recording, description: SensorDescription
) -> None:
    lengths = {len(v) for v in (reference.magnitude, reference.structure) if v is not None}
    if lengths != {description.measurements}:
        raise ConfigError(
            f"{recording.path} has {' or '.join(map(str, sorted(lengths)))} voltages a scan, "
            f"{description.name} has {description.measurements}",
            f"replay it with the description it was recorded with, {recording.origin.description}",
        )

"""What a recording tells a daemon that replays it, beyond the bytes that its ports say again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from urllib.parse import parse_qsl, unquote, urlsplit

from tactomo_models import Reference, SensorDescription
from tactomo_models.calibration.calibration_file import PressureCalibration

from tactomo.errors import ConfigError, PortError
from tactomo.plain import counted
from tactomo.recordings.playback import Playback
from tactomo.recordings.recording import REPLAY_SCHEME, Recording, open_recording
from tactomo.recordings.records import calibration_text, recorded_calibration
from tactomo.scans import Delivery, Mark


@dataclass(frozen=True, slots=True)
class Replay:
    """What a recording tells the pipeline beyond the bytes on the ports."""

    marks: list[Mark]  # the dual scans to reconstruct; empty where the recording does not say
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

    def marks_of_pass(self) -> list[Mark]:
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

    def follow(self, delivery: Delivery) -> int | None:
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


def without_calibrations(marks: Sequence[Mark]) -> list[Mark]:
    """Return marks that leave the pressure calibration as it is."""
    return [replace(mark, calibration=None) for mark in marks]


def _last_ns(marks: Sequence[Mark]) -> int | None:
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

"""What a recording tells a daemon that replays it, beyond the bytes that its ports say again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from tactomo_models import Reference, SensorDescription
from tactomo_models.calibration_file import PressureCalibration

from tactomo.errors import ConfigError
from tactomo.imaging import recorded_calibration
from tactomo.protocol_replay import parse_replay_url
from tactomo.recording import REPLAY_SCHEME, Mark, Recording


@dataclass(frozen=True, slots=True)
class Replay:
    """What a recording tells the pipeline beyond the bytes on the ports."""

    marks: list[Mark]
    """The dual scans to reconstruct; empty where the recording does not say."""
    reference: Reference | None
    """The one in force at its beginning."""
    is_paced: bool
    """Whether bytes come in their own time rather than as fast as they are taken."""
    calibration: PressureCalibration | None = None
    """Of pressure, that the daemon had when it began to record."""
    knows_calibration: bool = False
    """Whether it had that one, or none, and no other is to be looked for."""


def read_replay(urls: Sequence[str], description: SensorDescription) -> Replay | None:
    """Return what the recording says that the ports replay; None where they are live.

    Raises:
        ConfigError: only some of the ports are replayed, or not all from one recording, or that
            is of another sensor.
        RecordingError, PortError: a URL leads to no recording.

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
        calibration=calibration,
        knows_calibration=calibration is not None or had_none,
    )


def without_calibrations(marks: Sequence[Mark]) -> list[Mark]:
    """Return marks that leave the pressure calibration as it is."""
    return [replace(mark, calibration=None) for mark in marks]


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

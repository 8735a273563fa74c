"""`tactomo calibrate fit`: readings of a load cell, with the magnitudes that the sensor showed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tactomo_client.recording import open_recording
from tactomo_models import CalibrationError, load_description
from tactomo_models.calibration import load_cell
from tactomo_models.calibration.calibration_file import PressureCalibration, Subject, subject_of
from tactomo_models.calibration.outliers import find_outliers

from tactomo.cli.calibrate.live import distrusted
from tactomo.cli.files.recorded_frames import recorded_frames
from tactomo.cli.options import DEFAULT_DESCRIPTION
from tactomo.cli.output import say
from tactomo.recordings.recording import open_recording as open_bytes

if TYPE_CHECKING:
    from tactomo_client import Frame


def fitted(
    sensor: str,
    readings: Path,
    recording: Path | None,
    area_mm2: float | None,
    offset_s: float,
    description: str | None,
    device_ids: tuple[str, ...],
) -> tuple[PressureCalibration, list[str]]:
    """Fit what a load cell says, with the magnitudes in it or in a recording; and its odd lines."""
    cell = load_cell.read_load_cell(readings, area_mm2)
    if recording is None:
        _need(cell, readings, "magnitude")
        subject = subject_of(sensor, load_description(description or DEFAULT_DESCRIPTION))
        joined = load_cell.direct_readings(cell)
    else:
        _need(cell, readings, "time")
        subject, joined = _with_recording(sensor, cell, recording, offset_s, description)
    if device_ids:
        subject = subject.model_copy(update={"device_ids": device_ids})
    odd = _odd_lines(joined)
    for note in (*joined.notes, *(f"{line} disagrees with the others" for line in odd)):
        say(note, err=True)
    return PressureCalibration.of_readings(subject, joined.readings), odd


def _odd_lines(joined: load_cell.Joined) -> list[str]:
    odd = [(joined.lines[i], joined.readings[i]) for i in find_outliers(joined.readings)]
    return [
        f"line {line} ({reading.pressure_kpa:.0f} kPa, |Δσ|/σ₀ {reading.magnitude:.3f})"
        for line, reading in odd
    ]


def _need(cell: load_cell.LoadCell, path: Path, what: str) -> None:
    if what == "magnitude" and not (cell.magnitude >= 0).any():
        raise CalibrationError(
            f"{path} tells times and no magnitude; give the recording of that time by --recording"
        )
    if what == "time" and not cell.clock:
        raise CalibrationError(
            f"{path} has no column time_s or realtime_s, by which to find its lines in the "
            "recording; leave --recording out if its magnitudes are to be taken"
        )


def _with_recording(
    sensor: str, cell: load_cell.LoadCell, path: Path, offset_s: float, description: str | None
) -> tuple[Subject, load_cell.Joined]:
    recorded = open_recording(path).sensor
    if recorded and recorded != sensor:
        raise CalibrationError(
            f"{path} is a recording of {recorded}, not of {sensor}; give --sensor {recorded}"
        )
    with recorded_frames(path, description) as frames:
        if frames.description is None:
            raise CalibrationError(
                f"the sensor description that {path} was recorded with is not in it; give it by "
                "--description"
            )
        subject = subject_of(sensor, frames.description, _devices_in(path))
        moments = frames.with_progress(frames.moments("contacts"), "reading contacts")
        by_start = cell.clock == "time_s"
        seen = seen_of(
            [
                (m.time_s if by_start else m.frame.acquired_realtime_ns * 1e-9, m.frame)
                for m in moments
            ]
        )
    return subject, load_cell.joined_readings(replace(cell, times_s=cell.times_s + offset_s), seen)


def _devices_in(path: Path) -> tuple[str, ...]:
    (first, *_) = open_recording(path).files
    hellos = open_bytes(first).summary.hellos
    return tuple(sorted({hello.device_id for hello in hellos}))


def seen_of(frames: Sequence[tuple[float, Frame]]) -> load_cell.Seen:
    """What a sensor showed in frames with their times; untrustworthy ones are left out.

    Raises CalibrationError where there is none to be trusted.
    """
    trusted = [(time_s, frame) for time_s, frame in frames if not distrusted(frame)]
    if not trusted:
        raise CalibrationError(
            f"none of the {len(frames)} frames can be trusted; `tactomo doctor` says why"
        )
    single = [frame.contacts[0] if len(frame.contacts) == 1 else None for _, frame in trusted]
    return load_cell.Seen(
        times_s=np.array([time_s for time_s, _ in trusted]),
        magnitude=np.array([_number(c.magnitude if c else None) for c in single]),
        magnitude_sigma=np.array([_number(c.magnitude_sigma if c else None) for c in single]),
        contact_mm2=np.array([_number(c.area_mm2 if c else None) for c in single]),
        contacts=np.array([len(frame.contacts) for _, frame in trusted]),
    )


def _number(value: float | None) -> float:
    return math.nan if value is None else value

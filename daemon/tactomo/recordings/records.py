"""What the records of a recording say: references, calibrations, and the marks of frames.

Apart from `recording`, which reads files without: who asks what is in one need not wait for this.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, TypeVar

import structlog
from pydantic import BaseModel, Field, Strict, StrictBool, StrictInt, StrictStr
from tactomo_client import MessageError
from tactomo_client.messages import array_from_wire
from tactomo_models import CalibrationError, Reference, SensorDescription
from tactomo_models.calibration.calibration_file import PressureCalibration, parse_calibration
from tactomo_protocol import Channel

from tactomo.recordings.record_fields import malformed, record_fields
from tactomo.scans import FrameRecord, ScanKey, Timing

REFERENCE_ARRAYS: Final = ("magnitude", "structure", "magnitude_noise", "structure_noise")
DRIFT_ARRAYS: Final = tuple(f"{c}_{what}" for what in ("drift", "creep") for c in Channel)
"""Missing in recordings of daemons that did not follow drift."""
OLD_METHODS: Final = {"hybrid": "auto"}
"""Methods that marks of earlier versions name, and what they are called now."""
_Record = TypeVar("_Record", bound=BaseModel)


def read_reference(data: bytes) -> Reference:
    """Read a message of the topic ``reference``; raise RecordingError where it is none."""
    fields = record_fields(data)
    record = _checked(_Reference, fields)
    if not fields.keys() >= set(REFERENCE_ARRAYS):
        raise malformed()
    try:
        arrays = {
            name: None if fields.get(name) is None else array_from_wire(fields[name])
            for name in REFERENCE_ARRAYS + DRIFT_ARRAYS
        }
    except MessageError as error:
        raise malformed() from error
    at_rest = None if record.companions is None else tuple(record.companions.items())
    return Reference(scans=record.scans, is_noise_measured=True, companions=at_rest, **arrays)


class _Reference(BaseModel):
    number: StrictInt | None = None
    scans: StrictInt
    companions: (
        dict[StrictStr, Annotated[float, Field(strict=True, allow_inf_nan=False)]] | None
    ) = None


class KeptCalibration(BaseModel):
    """A pressure calibration that was put in force during a recording."""

    number: StrictInt  # which of its recording's, from 1
    text: StrictStr  # of its file; empty for none


def read_calibration(data: bytes) -> KeptCalibration:
    """Read a message of the topic ``calibration``; raise RecordingError where it is none."""
    return _checked(KeptCalibration, record_fields(data))


def calibration_text(calibration: PressureCalibration | None) -> str:
    """Return a pressure calibration as recordings have it; empty for none."""
    return "" if calibration is None else calibration.model_dump_json()


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
        structlog.get_logger().warning("calibration_unused", detail=str(error))
        return None
    return None if found.subject.mismatch(found.subject.sensor, description) else found


def read_frame(data: bytes) -> FrameRecord:
    """Read a message of the topic ``frame``; raise RecordingError where it is none."""
    mark = _checked(_FrameRecord, record_fields(data))
    try:
        keys = [ScanKey(Channel.of_number(c), counter, device) for c, counter, device in mark.scans]
    except ValueError as error:
        raise malformed() from error
    timing = None if mark.timing is None else Timing(*mark.timing)
    return FrameRecord(
        tuple(keys),
        OLD_METHODS.get(mark.tier, mark.tier),
        mark.budget_ms,
        None,
        mark.reference,
        mark.cold,
        mark.disputed,
        timing,
        calibration_number=mark.calibration,
    )


class _FrameRecord(BaseModel):
    scans: list[tuple[StrictInt, StrictInt, StrictInt]]
    tier: StrictStr
    budget_ms: Annotated[float, Strict()] | None
    reference: StrictInt | None = None
    calibration: StrictInt = 0
    cold: StrictBool = False
    disputed: StrictBool = False
    timing: tuple[StrictInt, StrictBool, StrictInt | None, StrictBool] | None = None


def _checked(kind: type[_Record], fields: dict[str, Any]) -> _Record:
    try:
        return kind.model_validate(fields)
    except ValueError as error:
        raise malformed() from error

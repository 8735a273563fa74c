"""A sensor's pressure calibration as it is kept: one file for each sensor, found by its name.

It holds the readings, too, so that it can be looked at, fitted again and added to. What it was made
for stands in it, and it is refused elsewhere: another name, another description (by its hash) or
another device would have another curve.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import IO, Annotated, Final, Generic, Literal, Protocol, Self, TypeVar

import numpy as np
from platformdirs import user_data_path
from pydantic import BaseModel, Field, ValidationError, model_validator

from tactomo_models.archive import write_whole
from tactomo_models.calibration.curve import MAX_KPA, MAX_MAGNITUDE, Fit, Reading, fit_curve
from tactomo_models.errors import CalibrationError, explain, os_errors_as
from tactomo_models.foreign_file import MAX_TEXT_BYTES, read_regular
from tactomo_models.scene.pressure import PressureCurve
from tactomo_models.sensor.description import SensorDescription

SUFFIX: Final = ".pressure.json"
Kpa = Annotated[float, Field(ge=-MAX_KPA, le=MAX_KPA)]  # as any skin's
Points = Field(min_length=2, max_length=256)
PointsKpa = Annotated[tuple[Annotated[Kpa, Field(ge=0)], ...], Points]


class Subject(BaseModel, extra="forbid", frozen=True):
    """What a calibration is of."""

    sensor: str  # its name in the stream
    description: str  # name of its description
    sha256: str  # that description's hash
    device_ids: tuple[str, ...] = ()  # the devices that it was read by; empty where nobody knows

    @classmethod
    def of(
        cls, sensor: str, description: SensorDescription, device_ids: Iterable[str] = ()
    ) -> Subject:
        """A sensor of this name, made as described."""
        return cls(
            sensor=sensor,
            description=description.name,
            sha256=description.sha256,
            device_ids=tuple(sorted(set(device_ids))),
        )

    def check(
        self, path: Path, description: SensorDescription, next_step: str, sensor: str = ""
    ) -> None:
        """Raise CalibrationError where what `path` holds is of another sensor, or name if given."""
        if mismatch := self.mismatch(sensor or self.sensor, description):
            raise CalibrationError(f"{path} {mismatch}; {next_step}")

    def mismatch(self, sensor: str, description: SensorDescription) -> str:
        """In words, why this is not of a sensor; empty where it is."""
        if self.sensor != sensor:
            return f"is of the sensor {self.sensor}, not {sensor}"
        if self.sha256 != description.sha256:
            return (
                f"is of a sensor as {self.description} describes it (sha256 {self.sha256[:12]}), "
                f"not as {description.name} does ({description.sha256[:12]})"
            )
        return ""

    def foreign(self, device_ids: Collection[str]) -> str:
        """In words, which of the connected devices it was not made with; empty for none."""
        others = sorted(set(device_ids) - set(self.device_ids))
        if not self.device_ids or not others:
            return ""
        return f"was made with {', '.join(self.device_ids)}, and {', '.join(others)} is connected"


def subject_of(
    sensor: str, description: SensorDescription, device_ids: Iterable[str] = ()
) -> Subject:
    """What a calibration of such a sensor is of.

    Raises CalibrationError where it has no pressure that could be calibrated.
    """
    if description.magnitude is None:
        raise CalibrationError(
            f"{description.name} has no magnitude channel; its structure channel says where it is "
            "touched, and never how hard"
        )
    return Subject.of(sensor, description, device_ids)


class PressureCalibration(BaseModel, extra="forbid", frozen=True, allow_inf_nan=False):
    """What was found for one sensor, and from what."""

    format: Literal[1] = 1  # of the file
    tactomo: str  # the version that made it
    subject: Subject  # what it is of
    taken: str  # when, ISO 8601, UTC
    readings: tuple[Reading, ...]  # what it was fitted to
    # magnitude, pressure_kpa, sigma_kpa: its curve, see `PressureCurve`
    magnitude: Annotated[tuple[Annotated[float, Field(ge=0, le=2 * MAX_MAGNITUDE)], ...], Points]
    pressure_kpa: PointsKpa
    sigma_kpa: PointsKpa
    # onset_kpa, hysteresis_kpa, repeatability_kpa: see `Fit`; None where unknown
    onset_kpa: Kpa | None
    hysteresis_kpa: Kpa | None
    repeatability_kpa: Kpa

    @model_validator(mode="after")
    def _is_a_curve(self) -> Self:
        lengths = {len(self.magnitude), len(self.pressure_kpa), len(self.sigma_kpa)}
        if len(lengths) > 1:
            raise ValueError("magnitude, pressure_kpa and sigma_kpa differ in length")
        if np.any(np.diff(self.magnitude) <= 0) or np.any(np.diff(self.pressure_kpa) < 0):
            raise ValueError("magnitude and pressure_kpa must rise")
        return self

    @classmethod
    def of_readings(cls, subject: Subject, readings: Sequence[Reading]) -> PressureCalibration:
        """Fit readings; raise CalibrationError where they make no curve."""
        return cls.of_fit(subject, readings, fit_curve(readings))

    @classmethod
    def of_fit(cls, subject: Subject, readings: Sequence[Reading], fit: Fit) -> PressureCalibration:
        """Keep what was fitted to readings, as of now."""
        curve = fit.curve
        return cls(
            tactomo=version("tactomo"),
            subject=subject,
            taken=datetime.now(UTC).isoformat(timespec="seconds"),
            readings=tuple(readings),
            magnitude=_rounded(curve.magnitude),
            pressure_kpa=_rounded(curve.pressure_kpa),
            sigma_kpa=_rounded(curve.sigma_kpa),
            onset_kpa=fit.onset_kpa if np.isfinite(fit.onset_kpa) else None,
            hysteresis_kpa=fit.hysteresis_kpa if np.isfinite(fit.hysteresis_kpa) else None,
            repeatability_kpa=fit.repeatability_kpa,
        )

    @cached_property
    def curve(self) -> PressureCurve:
        """By which magnitudes become pressures."""
        parts = (self.magnitude, self.pressure_kpa, self.sigma_kpa)
        return PressureCurve(*(np.array(part) for part in parts))

    @property
    def words(self) -> str:
        """In words, what it rests on."""
        low, high = self.curve.range_kpa
        return f"{len(self.readings)} readings of {self.taken[:10]}, {low:.0f} to {high:.0f} kPa"


def data_folder() -> Path:
    """Where things are kept that cannot be computed again.

    A service finds its own folder in $STATE_DIRECTORY, which systemd sets; else it is the user's.
    """
    state = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    return Path(state) if state else user_data_path("tactomo")


class Kept(Protocol):
    """What is kept of one sensor."""

    @property
    def subject(self) -> Subject:
        """What it is of."""

    @property
    def taken(self) -> str:
        """When it was made, ISO 8601, UTC."""


Made = TypeVar("Made", bound=Kept)


@dataclass(frozen=True)
class KeptFiles(Generic[Made]):
    """The files of one kind that sensors keep, one each: where they are, read and written."""

    suffix: str  # of their names
    command: str  # of `tactomo` that makes one
    missing: str  # that there is none, in words that its path follows
    unreadable: str  # what to do about one that cannot be read
    parse: Callable[[Path], Made]  # reads one; raises OSError, or CalibrationError
    write: Callable[[Made, IO[bytes]], object]

    def path(self, sensor: str) -> Path:
        """Where a sensor's is kept by default."""
        return data_folder() / "calibrations" / f"{sensor}{self.suffix}"

    def again(self, sensor: str) -> str:
        """In words, how to make a sensor's anew."""
        return f"run: tactomo {self.command} live --sensor {sensor}"

    def save(self, made: Made, path: Path) -> None:
        """Write one; a half-written one is never left under that name.

        Raises CalibrationError where the file cannot be written.
        """
        next_step = "name a file that you may write"
        with os_errors_as(CalibrationError, f"cannot write {path}", next_step):
            write_whole(path, lambda file: self.write(made, file))

    def read(self, path: Path, next_step: str = "") -> Made:
        """Read one, whatever it is of.

        Raises:
            CalibrationError: it is damaged, of another format, or cannot be read; or there is none
                and `next_step` says what to do then.
            FileNotFoundError: there is none, and no step.
        """
        try:
            return self.parse(path)
        except FileNotFoundError as error:
            if not next_step:
                raise
            raise CalibrationError(f"{self.missing} {path}; {next_step}") from error
        except OSError as error:
            why = f"cannot read {path}: {error.strerror}; {self.unreadable}"
            raise CalibrationError(why) from error

    def load(
        self, path: Path, sensor: str, description: SensorDescription, next_step: str = ""
    ) -> Made:
        """Read one and make sure that it is of this sensor.

        Raises as `read` does, and CalibrationError where it is of another one.
        """
        found = self.read(path, next_step)
        found.subject.check(path, description, self.again(sensor), sensor)
        return found

    def of(self, description: SensorDescription, path: Path) -> Made:
        """Read one of a sensor of such a description, whatever its name.

        Raises CalibrationError where it cannot be read, is of another one, or there is none.
        """
        found = self.read(path, "give another path")
        found.subject.check(path, description, "give the one of this sensor")
        return found


def parse_calibration(content: bytes | str, source: str) -> PressureCalibration:
    """Read a calibration's text; `source` names it in errors.

    Raises CalibrationError where it is damaged, or of another format.
    """
    try:
        return PressureCalibration.model_validate_json(content)
    except ValidationError as error:
        first = error.errors()[0]
        if first["loc"] == ("format",):
            raise CalibrationError(
                f"{source} is of format {first['input']!r}, and this tactomo reads format 1; "
                "calibrate again, from the same readings"
            ) from error
        complaint = " ".join(explain(first).split())[:200]
        raise CalibrationError(
            f"{source} is damaged ({complaint}); calibrate again, or delete it"
        ) from error


CALIBRATIONS: Final = KeptFiles(
    SUFFIX,
    "calibrate",
    "there is no calibration",
    "put a file there that may be read, or nothing",
    lambda path: parse_calibration(read_regular(path, MAX_TEXT_BYTES), str(path)),
    lambda made, file: file.write((made.model_dump_json(indent=1) + "\n").encode()),
)


def calibration_for(
    sensor: str,  # its name in the stream
    description: SensorDescription,  # what it is made of
    file: Path | None,  # of the description; None for a shipped one
    # called with one line that says why a calibration that is there is not used
    warn: Callable[[str], None],
) -> PressureCalibration | None:
    """The calibration in force for a sensor, or None.

    It is looked for in the data folder by the sensor's name, then beside its description's file.
    """
    beside = [] if file is None else [file.with_suffix(SUFFIX)]
    for path in [CALIBRATIONS.path(sensor), *beside]:
        try:
            return CALIBRATIONS.load(path, sensor, description)
        except FileNotFoundError:
            continue
        except CalibrationError as error:
            warn(str(error))
    return None


def _rounded(values: Sequence[float] | np.ndarray) -> tuple[float, ...]:
    return tuple(float(f"{value:.6g}") for value in values)

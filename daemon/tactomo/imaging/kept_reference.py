"""The last reference of a sensor, kept on disk: what the bare skin looked like before a restart.

A tare at the start takes whatever lies on the skin for bare skin; the reference of before can tell.
"""

from __future__ import annotations

import time
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from tactomo_models import DataError, Reference, SensorDescription
from tactomo_models.archive import check_replaceable, read_arrays, write_arrays
from tactomo_models.calibration.calibration_file import data_folder

from tactomo.errors import RecordingError
from tactomo.events import OnEvent
from tactomo.protocols.interface import TWIN_ID
from tactomo.recordings.recorder import Recorder
from tactomo.recordings.records import REFERENCE_ARRAYS
from tactomo.timing import wall_clock_ns

COMPANION: Final = "companion_"
"""Before the name of each companion whose reading at rest is kept."""
KEEP_S: Final = 60.0
"""How often a reference that follows drift is kept: drift bounds allow for far more than that."""
UNKNOWN_S: Final = 86_400.0
"""How long ago a reference held that is of the future: a computer without a clock of its own."""


def reference_path(sensor: str) -> Path:
    """Where a sensor's last reference is kept."""
    return data_folder() / "references" / f"{sensor}.reference.npz"


@dataclass(frozen=True, slots=True)
class KnownSkin:
    """A reference that held, and when, in nanoseconds since 1970."""

    reference: Reference
    realtime_ns: int

    @property
    def age_s(self) -> float:
        """How long ago it held."""
        age_s = (wall_clock_ns() - self.realtime_ns) * 1e-9
        return age_s if age_s >= 0 else UNKNOWN_S

    @property
    def words(self) -> str:
        """When it held, for people."""
        return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(self.realtime_ns // 1_000_000_000))


@dataclass(eq=False)
class KeptReference:
    """Reads and keeps one sensor's last reference. For use by the pipeline thread."""

    _path: Path  # of its file
    # what the sensor is made of; a reference of another one is not used
    _description: SensorDescription
    _recorder: Recorder  # its thread writes, so that a stuck disk holds up nobody
    _on_event: OnEvent  # told when it cannot be kept
    is_unreadable = False  # whether there is one that could not be read
    _next_s = 0.0

    def read(self, device_ids: Collection[str]) -> KnownSkin | None:
        """Return what is kept, if it is of this description and of these devices.

        Tells where other devices are: as well as a port can, see `device_changed`.
        """
        try:
            arrays = read_arrays(self._path)
            sha256, *before = self._about([str(each) for each in arrays["device_ids"]])
            if str(arrays["description_sha256"]) != sha256:
                return None
            new = sorted(set(device_ids) - set(before))
            # Twins have no cables, and another name where a description of the same sheet has.
            if new and not all(each.startswith(TWIN_ID) for each in (*before, *new)):
                self._on_event(
                    "device_changed",
                    f"at the start, {', '.join(new)} instead of {', '.join(before)}",
                    "exchange the cables or ports back, if those of two skins are exchanged; "
                    "`device_ids` refuses other devices",
                )
            if sorted(device_ids) != before:
                return None
            return KnownSkin(self._reference(arrays), int(arrays["realtime_ns"]))
        except FileNotFoundError:
            return None
        except (OSError, KeyError, TypeError, ValueError, OverflowError) as error:
            why = f"cannot read {self._path}: {getattr(error, 'strerror', None) or error}"
        except DataError as error:
            why = str(error)
        self.is_unreadable = True
        self._tell(why)
        return None

    def keep(self, reference: Reference, device_ids: Collection[str]) -> None:
        """Keep a reference that holds now."""
        self._next_s = time.monotonic() + KEEP_S
        now = reference.taken_as_it_is()
        arrays: dict[str, Any] = {
            name: volts for name in REFERENCE_ARRAYS if (volts := getattr(now, name)) is not None
        }
        arrays |= {f"{COMPANION}{name}": value for name, value in now.companions or ()}
        sha256, *devices = self._about(device_ids)
        about = {"description_sha256": sha256, "device_ids": np.array(devices, "U")}
        arrays |= {**about, "scans": now.scans, "realtime_ns": wall_clock_ns()}
        try:
            self._recorder.ask(lambda: self._write(arrays))
        except RecordingError as error:  # its thread has died, and that was told
            self._tell(error.cause)

    def follow(self, reference: Reference, device_ids: Collection[str]) -> None:
        """Keep a reference that has followed drift, now and then."""
        if time.monotonic() >= self._next_s:
            self.keep(reference, device_ids)

    def _about(self, device_ids: Collection[str]) -> list[str]:
        return [self._description.sha256, *sorted(device_ids)]

    def _reference(self, arrays: dict[str, Any]) -> Reference:
        wanted = (self._description.measurements,)
        volts = {name: arrays[name] for name in REFERENCE_ARRAYS if name in arrays}
        for name, each in volts.items():
            if each.shape != wanted or each.dtype != np.float64 or not np.isfinite(each).all():
                raise ValueError(f"{name} is not {wanted[0]} numbers")
        if not any(name in volts for name in self._description.channels):
            raise ValueError("it holds no channel of this sensor")
        both = {name: volts.get(name) for name in REFERENCE_ARRAYS}
        companions = tuple(
            (key.removeprefix(COMPANION), float(value))
            for key, value in arrays.items()
            if key.startswith(COMPANION)
        )
        if not all(np.isfinite(reading) for _, reading in companions):
            raise ValueError("a companion's reading is no number")
        return Reference(
            scans=max(1, int(arrays["scans"])),
            is_noise_measured=True,
            companions=companions or None,
            **both,
        )

    def _write(self, arrays: dict[str, Any]) -> None:
        try:
            check_replaceable(self._path)
            write_arrays(self._path, arrays)
        except OSError as error:
            self._tell(f"cannot write {self._path}: {error.strerror or error}")

    def _tell(self, why: str) -> None:
        step = "make the folder writable, or remove the file; after a restart nobody can tell "
        step += "a load from the bare skin without it"
        self._on_event("reference_not_kept", why, step)

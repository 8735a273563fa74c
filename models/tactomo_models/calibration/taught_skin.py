"""What a sensor was taught by presses at known places, as it is kept: one file for each sensor.

It holds the presses themselves; what is learnt from them is worked out again when it is read. What
it was taught on stands in it, and it is refused elsewhere, as a pressure calibration is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from pydantic import ValidationError
from tactomo_protocol import Channel

from tactomo_models.archive import read_arrays
from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.calibration.calibration_file import KeptFiles, Subject
from tactomo_models.calibration.press_regression import ForceRegression, PressRegression
from tactomo_models.errors import CalibrationError, DataError
from tactomo_models.scans.measurement import Measurement
from tactomo_models.scans.reference import Reference
from tactomo_models.scene.contacts import Contact

SUFFIX: Final = ".taught.npz"
FORMAT: Final = 1
AGAIN: Final = "teach it again, or delete it"
OTHER_SKIN: Final = 0.06
"""Rms of the logarithms of a reference's voltages over those of teaching, a common factor aside,
from which the skin is another one, or damaged. Simulated: 0.02 where 10 K change a sheet unevenly,
by 2 %; two skins of one make are 0.04 to 0.05 apart, made by hand 0.08 to 0.19."""


@dataclass(frozen=True)
class TaughtSkin:
    """What one sensor was taught."""

    subject: Subject  # what it is of
    taken: str  # when, ISO 8601, UTC
    channels: tuple[Channel, ...]  # whose changes are learnt from, in order
    # (V,) of their changes, one channel after the other, those that all presses have
    usable: BoolArray
    changes: FloatArray  # (N, V) of each press
    xy_mm: FloatArray  # (N, 2) where each was
    # (N, 2) where the physics had it; None where the voltages alone tell
    guess_mm: FloatArray | None
    # loads, force_n: (N,) magnitude times area, m², and newtons of each press; NaN where not known
    loads: FloatArray
    force_n: FloatArray
    tiers: frozenset[str]  # what made the contacts that places were corrected of
    # without_mm, with_mm: median errors on presses held out, by the physics and as taught
    without_mm: float
    with_mm: float
    force_error: float  # likewise of forces, as taught, relative; NaN where they are not learnt
    reference: FloatArray  # (channels, M) volts of the unpressed skin then

    @cached_property
    def regression(self) -> PressRegression:
        """What is learnt: 0.2 s for 200 presses, 4 s for 800."""
        return PressRegression(self.changes, self.xy_mm, self.guess_mm)

    @cached_property
    def forces(self) -> ForceRegression | None:
        """What is learnt of forces; None where nothing is."""
        if not np.isfinite(self.force_error):
            return None
        known = np.isfinite(self.loads * self.force_n)
        return ForceRegression(self.loads[known], self.xy_mm[known], self.force_n[known])

    def corrected(self, contact: Contact, measurement: Measurement, tier: str) -> Contact:
        """A frame's one contact at the place, and with the force, that was taught.

        It is as the physics has it where none like it was taught.
        So it is, too, where voltages are missing, or another method made the contact.
        """
        changes, valid = press_changes(measurement, self.channels)
        if not valid[self.usable].all() or (self.guess_mm is not None and tier not in self.tiers):
            return contact
        guess_mm = 1e3 * np.array([[contact.x_m, contact.y_m]])
        found = self.regression.locate(changes[None, self.usable], guess_mm)
        if not found.is_taught[0]:
            return contact
        x_m, y_m = (1e-3 * found.xy_mm[0]).tolist()
        sigma_m = 1e-3 * float(found.sigma_mm[0])
        placed = replace(
            contact, x_m=x_m, y_m=y_m, x_sigma_m=sigma_m, y_sigma_m=sigma_m, taught=True
        )
        load = load_of(contact)
        if self.forces is None or not np.isfinite(load):
            return placed
        force_n, force_sigma_n = self.forces.force(np.array([load]), found.xy_mm)
        return replace(placed, force_n=float(force_n[0]), force_sigma_n=float(force_sigma_n[0]))

    def changed(self, reference: Reference) -> str:
        """In words, how the unpressed skin is another one than was taught; empty where it is not.

        A factor that all voltages share is none: temperature and gain do that.
        """
        for name, taught in zip(self.channels, self.reference, strict=True):
            now = getattr(reference, name)
            if now is None or not np.any((now != 0) & (taught != 0)):
                continue
            there = (now != 0) & (taught != 0)
            ratio = np.log(np.abs(now[there] / taught[there]))
            off = float(np.sqrt(np.mean((ratio - np.median(ratio)) ** 2)))
            if off > OTHER_SKIN:
                return f"its {name} voltages at rest are {off:.0%} off what they were at teaching"
        return ""

    @property
    def words(self) -> str:
        """In words, what it rests on and what it brings."""
        return (
            f"{len(self.xy_mm)} presses of {self.taken[:10]}; on presses held out "
            f"{self.with_mm:.2f} mm (median), by the physics alone {self.without_mm:.2f} mm"
            + (f"; forces to {self.force_error:.1%}" if self.forces else "")
        )


def load_of(contact: Contact) -> float:
    """Magnitude times area, m²: what a force is told by; NaN where there is none above 0."""
    load = contact.magnitude * contact.area_m2
    return load if load > 0 else float("nan")


def are_forces(force_n: FloatArray) -> BoolArray:
    """Which may be a press's newtons, same shape; NaN may, which is not known."""
    return np.isnan(force_n) | ((force_n > 0) & (force_n < np.inf))


def press_changes(
    measurement: Measurement, channels: Sequence[Channel]
) -> tuple[FloatArray, BoolArray]:
    """Changes (V,) of channels one after the other, and which of them are valid (V,)."""
    count = len(next(iter(measurement.changes.values())).change)
    none = np.zeros(count)
    seen = [measurement.changes.get(name) for name in channels]
    changes = np.concatenate([none if each is None else each.change for each in seen])
    weight = np.concatenate([none if each is None else each.weight for each in seen])
    return changes, weight > 0


def _write(taught: TaughtSkin, file: IO[bytes]) -> None:
    guess = np.zeros((0, 2)) if taught.guess_mm is None else taught.guess_mm
    arrays: dict[str, Any] = {
        "format": np.array(FORMAT),
        "tactomo": np.array(version("tactomo")),
        "subject": np.array(taught.subject.model_dump_json()),
        "taken": np.array(taught.taken),
        "channels": np.array(taught.channels),
        "usable": taught.usable,
        "changes": taught.changes.astype(np.float32),
        "xy_mm": taught.xy_mm,
        "guess_mm": guess,
        "loads": taught.loads,
        "force_n": taught.force_n,
        "force_error": np.array(taught.force_error),
        "tiers": np.array(sorted(taught.tiers)),
        "held_out_mm": np.array([taught.without_mm, taught.with_mm]),
        "reference": taught.reference,
    }
    np.savez_compressed(file, **arrays)


def _read(path: Path) -> TaughtSkin:
    try:
        arrays = read_arrays(path)
        if int(arrays["format"]) != FORMAT:
            raise CalibrationError(
                f"{path} is of format {int(arrays['format'])}, and this tactomo reads format "
                f"{FORMAT}; {AGAIN}"
            )
        taught = _of_arrays(arrays)
        _ = taught.regression, taught.forces  # now, not in the first frame
    except (DataError, KeyError, ValueError, ValidationError) as error:
        raise CalibrationError(f"{path} is damaged, or nothing that was taught; {AGAIN}") from error
    return taught


def _of_arrays(arrays: Mapping[str, Any]) -> TaughtSkin:
    guess = arrays["guess_mm"].astype(np.float64)
    unknown = np.full(len(arrays["xy_mm"]), np.nan)  # older files have no forces
    without_mm, with_mm = arrays["held_out_mm"].tolist()
    return TaughtSkin(
        Subject.model_validate_json(str(arrays["subject"])),
        str(arrays["taken"]),
        tuple(Channel(name) for name in arrays["channels"].tolist()),
        arrays["usable"].astype(bool),
        arrays["changes"].astype(np.float64),
        arrays["xy_mm"].astype(np.float64),
        guess if len(guess) else None,
        arrays.get("loads", unknown).astype(np.float64),
        arrays.get("force_n", unknown).astype(np.float64),
        frozenset(arrays["tiers"].tolist()),
        float(without_mm),
        float(with_mm),
        float(arrays.get("force_error", np.nan)),
        arrays["reference"].astype(np.float64),
    )


TAUGHT: Final = KeptFiles(SUFFIX, "teach", "nothing was taught in", AGAIN, _read, _write)

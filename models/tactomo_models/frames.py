"""From a method's estimate to a frame: contacts with an identity, pressures, flags, and words.

What is kept from frame to frame is which contact is which, and in which range its pressure was.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.calibration.taught_skin import TaughtSkin
from tactomo_models.errors import DataError
from tactomo_models.methods.magnitudes import BAD_MISFIT
from tactomo_models.methods.method import Estimate
from tactomo_models.scans.companion_forces import CompanionForce
from tactomo_models.scans.measurement import Measurement
from tactomo_models.scans.plausibility import Flag
from tactomo_models.scene.areas import AreaFinder, Areas
from tactomo_models.scene.contacts import contacts_of, mounted, pressure_map, total_force
from tactomo_models.scene.pressure import PressureCurve, PressureRange
from tactomo_models.scene.reconstruction import Reconstruction
from tactomo_models.scene.tracking import ContactTracker
from tactomo_models.sensor.description import SensorDescription

STEADY: Final = 5.0  # standard uncertainties that a steady press's magnitude changes by, at most


class FrameMaker:
    """Makes the frames of one sensor, one after the other."""

    def __init__(self, description: SensorDescription, finder: AreaFinder) -> None:
        self._description = description
        self._finder = finder
        self._tracker = ContactTracker()
        self._ranges: dict[int, tuple[PressureRange, float]] = {}  # and magnitude, of each identity
        self._felt: set[str] = set()  # companions that felt something in the last quiet frame

    def forget(self) -> None:
        """Forget which contacts were which."""
        self._tracker.clear()
        self._felt = set()

    def quiet(self, measurement: Measurement) -> Reconstruction:
        """Return the frame of a measurement without a change: all contacts have gone.

        A companion that feels something twice in a row contradicts the sheets; once, its noise may.
        """
        self._tracker.update(np.zeros((0, 2)), np.zeros(0))
        frame = self.nothing(measurement, "no change above the noise")
        felt = {k for k, one in measurement.companions.items() if not one.agrees_with(0.0)}
        disputed, self._felt = sorted(felt & self._felt), felt
        if not disputed:
            return frame
        said = (
            f"companion {name} reads {measurement.companions[name].force_n:.3g} N"
            for name in disputed
        )
        return replace(
            frame,
            flags=frame.flags | Flag.COMPANION_DISPUTED,
            reason="; ".join([frame.reason, *said]),
            companions=_judged(measurement, dict.fromkeys(disputed, False)),
        )

    def nothing(self, measurement: Measurement, reason: str) -> Reconstruction:
        """Return a frame in which nothing presses, as far as the measurement can tell."""
        changes, flags, misfit = measurement.changes, measurement.flags, float("nan")
        if changes:
            # The measure that told quiet; where it is blunt, the changes over noise alone.
            misfit = max(each.signal for each in changes.values())
            if flags & (Flag.NOISE_HIGH | Flag.STRUCTURE_MISSING):
                misfit = max(each.misfit for each in changes.values())
                if misfit > BAD_MISFIT:
                    flags |= Flag.MISFIT_HIGH
            tells = Channel.STRUCTURE if Channel.STRUCTURE in changes else Channel.MAGNITUDE
            if changes[tells].hides:
                flags |= Flag.NOISE_HIGH
        blank = self._description.shown(
            np.zeros((self._description.map.nodes_y, self._description.map.nodes_x))
        )
        magnitude = blank if Channel.MAGNITUDE in changes else None
        return Reconstruction(
            map=magnitude,
            pressure_kpa=magnitude,
            structure=blank if Channel.STRUCTURE in changes else None,
            contacts=(),
            tier="quiet",
            reason="; ".join([reason, *measurement.faults]),
            misfit=misfit,
            flags=flags,
            stage_s=measurement.stage_s,
            force_n=0.0 if changes else float("nan"),
            companions=_judged(measurement, {}),
        )

    def frame(
        self,
        estimate: Estimate,
        measurement: Measurement,
        method: str,
        curve: PressureCurve | None,
        taught: TaughtSkin | None,
    ) -> Reconstruction:
        """Return the frame that a method's estimate makes, with its contacts and pressures."""
        has_magnitude = Channel.MAGNITUDE in measurement.changes
        self._felt = set()
        with measurement.timed("contacts"):
            areas, size, sigma = self._areas_of(estimate)
            ids = self._tracker.update(areas.centres_m, areas.areas_m2)
            account = estimate.account
            field = account.contacts if account else None
            felt, noise = (size, sigma) if field is None else (field.felt, field.felt_sigma)
            # A press that is clearly another one than a frame ago has no range to keep.
            last = {
                known: self._ranges[known][0]
                for known, now, by_chance in zip(ids, felt, STEADY * noise, strict=True)
                if known in self._ranges and abs(now - self._ranges[known][1]) <= by_chance
            }
            contacts = contacts_of(areas, ids, size, sigma, curve, last=last, field=field)
            seen = {
                contact.id: (contact.pressure_range, float(now))
                for contact, now in zip(contacts, felt, strict=True)
            }
            kept = self._ranges | seen
            self._ranges = {known: kept[known] for known in self._tracker.ids if known in kept}
        tier, flags = estimate.made_by or method, measurement.flags | estimate.flags
        if not contacts and not estimate.has_drifted:
            flags |= Flag.MISFIT_HIGH  # something has changed, and nothing explains it
        if contacts and any(each.is_factor for each in measurement.changes.values()):
            flags |= Flag.REFERENCE_MISMATCH  # one gain explains what contacts do
        if taught is not None and len(contacts) == 1:
            with measurement.timed("taught"):
                contacts = (taught.corrected(contacts[0], measurement, tier),)
            if not contacts[0].taught:
                flags |= Flag.UNTAUGHT
        if self._description.mount is not None:
            contacts = mounted(contacts, self._description.mount)
        force_n, force_sigma_n = total_force(contacts, curve, field)
        companions = _judged(measurement, estimate.companions)
        if contacts and np.isnan(force_sigma_n):
            # The sheets tell a least force, or none; what feels all of the sheet tells all of it.
            whole = [
                (one.sigma_n, one.force_n)
                for name, one in companions.items()
                if one.state == "fitted" and self._description.companion[name].region_m is None
            ]
            force_sigma_n, force_n = min(whole, default=(force_sigma_n, force_n))
        pressure = None
        if estimate.tells_pressure and has_magnitude:
            pressure = pressure_map(areas, contacts, account.pressure_kpa if account else None)
        shown = self._description.shown
        return Reconstruction(
            map=shown(estimate.map),
            pressure_kpa=shown(pressure),
            structure=shown(estimate.structure),
            contacts=contacts,
            tier=tier,
            reason="; ".join([estimate.reason, *measurement.faults]),
            misfit=estimate.misfit,
            flags=flags,
            stage_s=measurement.stage_s,
            confidence=estimate.confidence,
            force_n=force_n,
            force_sigma_n=force_sigma_n,
            companions=companions,
        )

    def _areas_of(self, estimate: Estimate) -> tuple[Areas, FloatArray, FloatArray]:
        """The pressed areas of an estimate, their magnitudes (K,) and uncertainties (K,)."""
        areas, finder = estimate.areas, self._finder
        if areas is None:
            if estimate.structure is not None:
                pressed = np.abs(estimate.structure)
            else:
                assert estimate.map is not None
                pressed = estimate.map / max(float(estimate.map.max()), 1e-12)
            areas = finder.find(pressed, finder.on_nodes(pressed))
        size, image = estimate.magnitudes, estimate.map
        if size is None and image is None:
            size = np.full(len(areas), np.nan)
        elif size is None and image is not None:
            share = np.maximum(areas.on_map.sum(axis=(1, 2)), 1e-12)
            size = np.asarray((image * (areas.on_map > 0)).sum(axis=(1, 2)) / share)
        assert size is not None
        return areas, size, np.full(len(areas), estimate.magnitude_sigmas)

    def check(self, estimate: Estimate) -> None:
        """Raise DataError for an estimate that cannot be shown."""
        if not isinstance(estimate, Estimate):
            raise DataError(f"returned {type(estimate).__name__}, not Estimate")
        shape = (self._description.map.nodes_y, self._description.map.nodes_x)
        images = {"map": estimate.map, "structure": estimate.structure}
        if estimate.areas is None and all(image is None for image in images.values()):
            raise DataError("returned neither map nor structure")
        for what, image in images.items():
            if image is None:
                continue
            if not isinstance(image, np.ndarray) or image.dtype.kind != "f":
                raise DataError(f"{what} is no array of floating-point numbers")
            if image.shape != shape:
                raise DataError(f"{what} has shape {image.shape}, not {shape}")
            if not (np.abs(image) < np.finfo(np.float32).max).all():
                raise DataError(f"{what} holds values that are not finite")
        if estimate.areas is None and not (
            estimate.magnitudes is None and np.ndim(estimate.magnitude_sigmas) == 0
        ):
            raise DataError("returned magnitudes without their areas")
        words = (estimate.made_by, estimate.reason)
        if not all(isinstance(each, str) for each in words):
            raise DataError("made_by and reason are not both text")
        numbers = (estimate.misfit, estimate.confidence)
        if not all(isinstance(each, (float, int, np.floating)) for each in numbers):
            raise DataError("misfit and confidence are not both numbers")


def _judged(measurement: Measurement, agrees: Mapping[str, bool]) -> dict[str, CompanionForce]:
    """The companions of a frame, with what became of each."""
    late = {k: replace(one, state="late") for k, one in measurement.late_companions.items()}
    words = {True: "fitted", False: "disputed", None: "unused"}
    in_time = measurement.companions.items()
    return late | {k: replace(one, state=words[agrees.get(k)]) for k, one in in_time}

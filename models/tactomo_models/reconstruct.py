"""From two scans to a frame: changes, a quiet test, the method that was asked for, contacts.

A scene is modelled no further than it needs. Nothing pressed: a chi-square test, and no solve.
Something pressed: the method estimates map and structure, and pressed areas become contacts with
an identity and a pressure. Where a method makes nothing of a measurement, or one of a user's own
fails, the frame is `tikhonov`'s and says so.

The outcome depends on the sequence of frames alone, never on the clock: the compute budget is
counted in modelled work, so that a recording reconstructs exactly as the live stream did.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.calibration.taught_skin import TaughtSkin
from tactomo_models.errors import DataError, ModelError
from tactomo_models.methods.magnitudes import BAD_MISFIT
from tactomo_models.methods.method import Estimate, Method, Skin, UnsolvableError
from tactomo_models.methods.registry import check_method, make_method
from tactomo_models.physics.artifact import Artifact
from tactomo_models.scans.changes import Changes
from tactomo_models.scans.companion_forces import CompanionForce, CompanionReading
from tactomo_models.scans.measurement import Measurement
from tactomo_models.scans.plausibility import Flag
from tactomo_models.scans.reference import Reference
from tactomo_models.scans.repeats import Repeats
from tactomo_models.scans.stillness import are_still
from tactomo_models.scans.tare import Tare
from tactomo_models.scene.areas import Areas
from tactomo_models.scene.contacts import contacts_of, mounted, pressure_map, total_force
from tactomo_models.scene.pressure import PressureCurve, PressureRange, described_curve
from tactomo_models.scene.reconstruction import Reconstruction
from tactomo_models.scene.tracking import ContactTracker
from tactomo_models.sensor.description import SensorDescription

DEFAULT_BUDGET_S: Final = 0.05
FALLBACK: Final = "tikhonov"
STEADY: Final = 5.0  # standard uncertainties that a steady press's magnitude changes by, at most


class Reconstructor:
    """Turns dual scans into maps and contacts, frame after frame.

    Args:
        description: the sensor.
        artifact: what is precomputed for it; read or built if None.
        method: the name of one (see `methods.registry`), or a method that no other reconstructor
            has.
        budget_s: compute time a frame may take, on a machine of the 2.5 GHz class.
        curve: turns magnitudes into pressures; the description's own table if None.
        taught: corrects where single contacts are, see `taught_skin`.

    Raises:
        ArtifactError: the artifact or the method's network cannot be used.
        MethodError: there is no such method, or the sensor lacks a channel that it needs.
        ModelError: the budget is no time.

    Attributes:
        description: the sensor.
        sensor: the same, with its artifact and what is worked out once.
        curve: the one in force; it may be set at any time.
        taught: what presses at known places have taught; likewise. None where nothing.

    Not thread-safe: one thread owns it.
    """

    def __init__(
        self,
        description: SensorDescription,
        artifact: Artifact | None = None,
        *,
        method: str | Method = "auto",
        budget_s: float | None = None,
        curve: PressureCurve | None = None,
        taught: TaughtSkin | None = None,
    ) -> None:
        self.description = description
        self.curve = curve or described_curve(description)
        self.taught = taught
        self.budget_s = budget_s
        skin = Skin.of(description, artifact)
        self.sensor = skin.tare.sensor
        self._skin = replace(skin, regularisation=description.instrument.regularisation)
        self._tare = skin.tare
        self._repeats = Repeats(description.pairs)
        self._methods: dict[str, Method] = {}  # by their names, once they were asked for
        self._failures: dict[str, str] = {}  # of methods prepared since the tare; empty if good
        self._previous: Estimate | None = None
        self._still: _Still | None = None  # since when the sheets have not moved
        self._tracker = ContactTracker()
        self._ranges: dict[int, tuple[PressureRange, float]] = {}  # and magnitude, of each identity
        self._name = method if isinstance(method, str) else type(method).__name__
        if isinstance(method, str):
            check_method(method, description)
        self._methods[self._name] = make_method(method) if isinstance(method, str) else method

    @property
    def budget_s(self) -> float | None:
        """Compute time a frame may take, s; None for `DEFAULT_BUDGET_S`.

        Setting it raises ModelError for what is no finite time above 0.
        """
        return self._budget_s

    @budget_s.setter
    def budget_s(self, budget_s: float | None) -> None:
        is_number = isinstance(budget_s, (float, int)) and not isinstance(budget_s, bool)
        if budget_s is not None and not (is_number and 0 < budget_s < np.inf):
            raise ModelError(
                f"budget_s = {budget_s!r} is no time that a frame may take: give seconds above 0, "
                f"such as {DEFAULT_BUDGET_S}, or None for the usual one"
            )
        self._budget_s = budget_s

    @property
    def method(self) -> str:
        """The name of the method that is asked for.

        A new one starts cold. Setting it raises what making a reconstructor does.
        """
        return self._name

    @method.setter
    def method(self, name: str) -> None:
        if name not in self._methods:
            check_method(name, self.description)
            self._methods[name] = make_method(name)
        if name != self._name:
            self._name = name
            self.forget_shape()
        if self._tare.channels:
            self._prepared(name)

    def set_reference(self, reference: Reference) -> None:
        """Measure changes against this unpressed scan from now on.

        Forgets the warm start, unless it is the last reference, drifted.

        Raises DataError where a channel has another number of voltages than the sensor.
        """
        if reference.is_followed_from(self._tare.reference):
            self._tare = replace(self._tare, reference=reference)
        else:
            self.use(self.take(reference))

    def use(self, tare: Tare) -> None:
        """Measure changes against a tare from now on; forgets the warm start."""
        self._tare = tare
        self._prepare()
        self.reset()

    def take(self, reference: Reference) -> Tare:
        """What a reference tells, with all that the method will ask of it; for any thread.

        Half a second of processor time a sheet, if the method solves presses on sheets as they are.

        Raises DataError where a channel has another number of voltages than the sensor.
        """
        tare = Tare.take(self.sensor, reference)
        if getattr(self._methods[self._name], "uses_sheets", False):
            _ = tare.sheets
        return tare

    def _prepare(self) -> None:
        """Prepare the method with the channels and sheets as they are now."""
        self._skin = replace(self._skin, tare=self._tare)
        self._failures.clear()
        self._prepared(self._name)

    def reset(self) -> None:
        """Forget the warm start, earlier scans, and which contacts were which."""
        self._tracker.clear()
        self._repeats.forget()
        self.forget_shape()

    def forget_shape(self) -> None:
        """Forget the warm start; contacts keep their identities."""
        self._previous = None
        self._still = None

    def reconstruct(
        self,
        magnitude: FloatArray | None,
        structure: FloatArray | None,
        *,
        saturated: Collection[Channel] = (),
        companions: Collection[tuple[str, float] | CompanionReading] | None = None,
    ) -> Reconstruction:
        """Reconstruct one frame, without the drives and measuring pairs that repeat the last one.

        Args:
            magnitude: (M,) volts; None if that scan is missing.
            structure: (M,) volts; None if that scan is missing.
            saturated: channels whose device says that its converter clipped this scan.
            companions: name of each companion and its reading in its own unit, NaN where it has
                none, or `CompanionReading`; None where nobody reads them.

        Raises DataError where a scan has another number of voltages than the sensor.
        """
        scans = (
            self._measured(Channel.MAGNITUDE, magnitude),
            self._measured(Channel.STRUCTURE, structure),
        )
        return self.solve(self.compare(*scans, saturated=saturated, companions=companions))

    def compare(
        self,
        magnitude: FloatArray | None,
        structure: FloatArray | None,
        *,
        saturated: Collection[Channel] = (),
        companions: Collection[tuple[str, float] | CompanionReading] | None = None,
    ) -> Measurement:
        """What has changed: all that `reconstruct` does before it solves, at little cost.

        A scan may be compared again: unlike `reconstruct`, this looks for nothing that repeats.
        """
        if self._tare.asks_noise:
            self._tare = self._tare.with_noise_of(magnitude, structure)
            if self._tare.channels is not self._skin.tare.channels:
                self._prepare()
        measurement = self._tare.changes(magnitude, structure, saturated, companions)
        return self._in_time(measurement, companions or ())

    def _in_time(
        self,
        measurement: Measurement,
        companions: Collection[tuple[str, float] | CompanionReading],
    ) -> Measurement:
        """The same without companions that may have felt the sheets before they moved."""
        readings = [CompanionReading(*each) for each in companions]
        if not readings:
            return measurement
        time_s = readings[0].time_s
        still = self._still
        if (
            still is None
            or time_s < still.since_s
            or not are_still(still.changes, measurement.changes)
        ):
            self._still = still = _Still(time_s, measurement.changes)
        in_time = {each.name for each in readings if each.since_s <= time_s - still.since_s}
        kept, late = (
            {name: one for name, one in measurement.companions.items() if (name in in_time) is are}
            for are in (True, False)
        )
        return replace(measurement, companions=kept, late_companions=late)

    def _measured(self, channel: Channel, scan: FloatArray | None) -> FloatArray | None:
        """A scan less the drives and pairs that repeat the last one; all of it may come again."""
        if scan is None or scan.shape != (self.description.measurements,):
            return scan
        found = self._repeats.find(channel, scan, self._tare.reference)
        return scan if found is None or not found.parts else np.where(found.voltages, np.nan, scan)

    def solve(self, measurement: Measurement) -> Reconstruction:
        """The second half of `reconstruct`: what follows from a measurement."""
        if not measurement.changes and measurement.flags & Flag.NO_REFERENCE:
            return self._nothing(measurement, "no reference yet")
        if not measurement.changes:
            flagged = replace(measurement, flags=measurement.flags | Flag.NO_USABLE_SCAN)
            return self._nothing(flagged, "no usable scan")
        if measurement.is_quiet:
            lasting = None if self._previous is None else self._previous.lasting
            self._previous = None if lasting is None else Estimate(carried=lasting, lasting=lasting)
            self._tracker.update(np.zeros((0, 2)), np.zeros(0))
            return self._nothing(measurement, "no change above the noise")
        previous, self._previous = self._previous, None
        try:
            return self._by_method(self._name, measurement, previous)
        except (UnsolvableError, _MethodFailedError) as error:
            frame = self._by_method(FALLBACK, measurement, None)
            self._previous = None
            failure = str(error) if isinstance(error, _MethodFailedError) else ""
            reason = "; ".join([str(error), *measurement.faults])
            return replace(frame, reason=reason, failure=failure)

    def _by_method(
        self, name: str, measurement: Measurement, previous: Estimate | None
    ) -> Reconstruction:
        """The frame that a method makes of a measurement.

        A fault of ours is raised as it is, one of a user's own method as `_MethodFailedError`.
        """
        method = self._prepared(name)
        budget_s = self.budget_s or DEFAULT_BUDGET_S
        if _is_ours(method):
            self._previous = method.solve(measurement, previous, budget_s)
            return self._frame(self._previous, measurement)
        if self._failures[name]:
            raise _MethodFailedError(self._failures[name])
        try:
            with measurement.timed(name):
                estimate = method.solve(measurement, previous, budget_s)
            self._check(estimate)
            frame = self._frame(estimate, measurement)
        except UnsolvableError:
            raise
        except (Exception, SystemExit) as error:
            raise _MethodFailedError(f"method {name} failed: {_in_words(error)}") from error
        self._previous = estimate
        return frame

    def _prepared(self, name: str) -> Method:
        """The method of a name, prepared with the skin as it was at the tare."""
        method = self._methods.get(name) or make_method(name)
        self._methods[name] = method
        if name not in self._failures:
            self._failures[name] = ""
            try:
                method.prepare(self._skin)
            except (Exception, SystemExit) as error:
                if _is_ours(method) or isinstance(error, ModelError):
                    del self._failures[name]
                    raise
                self._failures[name] = f"method {name} failed to prepare: {_in_words(error)}"
        return method

    def _check(self, estimate: Estimate) -> None:
        """Raise `DataError` for an estimate that cannot be shown."""
        if not isinstance(estimate, Estimate):
            raise DataError(f"returned {type(estimate).__name__}, not Estimate")
        shape = (self.description.map.nodes_y, self.description.map.nodes_x)
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

    def _nothing(self, measurement: Measurement, reason: str) -> Reconstruction:
        """A frame in which nothing presses, as far as the measurement can tell."""
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
        blank = self.description.shown(
            np.zeros((self.description.map.nodes_y, self.description.map.nodes_x))
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

    def _frame(self, estimate: Estimate, measurement: Measurement) -> Reconstruction:
        """The frame that an estimate makes, with its contacts and pressures."""
        has_magnitude = Channel.MAGNITUDE in measurement.changes
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
            contacts = contacts_of(areas, ids, size, sigma, self.curve, last=last, field=field)
            seen = {
                contact.id: (contact.pressure_range, float(now))
                for contact, now in zip(contacts, felt, strict=True)
            }
            kept = self._ranges | seen
            self._ranges = {known: kept[known] for known in self._tracker.ids if known in kept}
        tier, flags = estimate.made_by or self._name, measurement.flags | estimate.flags
        if not contacts and not estimate.has_drifted:
            flags |= Flag.MISFIT_HIGH  # something has changed, and nothing explains it
        if contacts and any(each.is_factor for each in measurement.changes.values()):
            flags |= Flag.REFERENCE_MISMATCH  # one gain explains what contacts do
        if self.taught is not None and len(contacts) == 1:
            with measurement.timed("taught"):
                contacts = (self.taught.corrected(contacts[0], measurement, tier),)
            if not contacts[0].taught:
                flags |= Flag.UNTAUGHT
        if self.description.mount is not None:
            contacts = mounted(contacts, self.description.mount)
        force_n, force_sigma_n = total_force(contacts, self.curve, field)
        companions = _judged(measurement, estimate.companions)
        if contacts and np.isnan(force_sigma_n):
            # The sheets tell a least force, or none; what feels all of the sheet tells all of it.
            whole = [
                (one.sigma_n, one.force_n)
                for name, one in companions.items()
                if one.state == "fitted" and self.description.companion[name].region_m is None
            ]
            force_sigma_n, force_n = min(whole, default=(force_sigma_n, force_n))
        pressure = None
        if estimate.tells_pressure and has_magnitude:
            pressure = pressure_map(areas, contacts, account.pressure_kpa if account else None)
        shown = self.description.shown
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
        areas, finder = estimate.areas, self._skin.areas
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
        return areas, size, np.broadcast_to(estimate.magnitude_sigmas, len(areas))


def _judged(measurement: Measurement, agrees: Mapping[str, bool]) -> dict[str, CompanionForce]:
    """The companions of a frame, with what became of each."""
    late = {k: replace(one, state="late") for k, one in measurement.late_companions.items()}
    words = {True: "fitted", False: "disputed", None: "unused"}
    in_time = measurement.companions.items()
    return late | {k: replace(one, state=words[agrees.get(k)]) for k, one in in_time}


class _Still(NamedTuple):
    """The frame that all since are like."""

    since_s: float
    changes: Mapping[Channel, Changes]


class _MethodFailedError(Exception):
    """A method of the user's own has failed; says how."""


def _is_ours(method: Method) -> bool:
    return type(method).__module__.startswith("tactomo_models.")


def _in_words(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"

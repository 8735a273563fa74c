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
from contextlib import nullcontext
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from tactomo_protocol import Channel
from threadpoolctl import ThreadpoolController

from tactomo_models.arrays import FloatArray
from tactomo_models.calibration.taught_skin import TaughtSkin
from tactomo_models.errors import ModelError
from tactomo_models.frames import FrameMaker
from tactomo_models.methods.method import Estimate, Method, Skin, UnsolvableError
from tactomo_models.methods.registry import check_method, make_method
from tactomo_models.physics.artifact import Artifact
from tactomo_models.scans.changes import Changes
from tactomo_models.scans.companion_forces import CompanionReading
from tactomo_models.scans.measurement import Measurement
from tactomo_models.scans.plausibility import Flag
from tactomo_models.scans.reference import Reference
from tactomo_models.scans.repeats import Repeats
from tactomo_models.scans.stillness import are_still
from tactomo_models.scans.tare import Tare
from tactomo_models.scene.pressure import PressureCurve, described_curve
from tactomo_models.scene.reconstruction import Reconstruction
from tactomo_models.sensor.description import SensorDescription

DEFAULT_BUDGET_S: Final = 0.05
FALLBACK: Final = "tikhonov"


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
        self._frames = FrameMaker(description, skin.areas)
        self._name = method if isinstance(method, str) else type(method).__name__
        if isinstance(method, str):
            check_method(method, description)
        self._methods[self._name] = make_method(method) if isinstance(method, str) else method
        self._blas = ThreadpoolController()  # last: of the libraries that are loaded by now

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
        self._frames.forget()
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
        # More threads wait for each other. The daemon keeps all to one, and to ask is faster.
        is_one = all(library.num_threads == 1 for library in self._blas.lib_controllers)
        with nullcontext() if is_one else self._blas.limit(limits=1):
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
            return self._frames.nothing(measurement, "no reference yet")
        if not measurement.changes:
            flagged = replace(measurement, flags=measurement.flags | Flag.NO_USABLE_SCAN)
            return self._frames.nothing(flagged, "no usable scan")
        if measurement.is_quiet:
            lasting = None if self._previous is None else self._previous.lasting
            self._previous = None if lasting is None else Estimate(carried=lasting, lasting=lasting)
            return self._frames.quiet(measurement)
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
            self._frames.check(estimate)
            frame = self._frame(estimate, measurement)
        except UnsolvableError:
            raise
        except (Exception, SystemExit) as error:
            raise _MethodFailedError(f"method {name} failed: {_in_words(error)}") from error
        self._previous = estimate
        return frame

    def _frame(self, estimate: Estimate, measurement: Measurement) -> Reconstruction:
        return self._frames.frame(estimate, measurement, self._name, self.curve, self.taught)

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

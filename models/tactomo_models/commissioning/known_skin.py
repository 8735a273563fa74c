"""Whether a skin at a start is as it was last known: at rest, loaded, or another one.

A tare takes whatever lies on the skin for the bare skin. What was known of it before can tell.
"""

from __future__ import annotations

from dataclasses import replace
from enum import Enum
from typing import Final

import numpy as np

from tactomo_models.arrays import FloatArray
from tactomo_models.drift.baseline import BaselineTracker
from tactomo_models.reconstruct import DEFAULT_BUDGET_S, Reconstructor
from tactomo_models.scans.reference import Reference
from tactomo_models.scans.tare import Tare

# On simulated sheets of the shipped squares, uneven by 2 to 10 %: contacts leave at most 0.34 of
# the changes unexplained, or make the sheet deviate from its model 1.8 times as much or more (of a
# saturating sheet); most other sheets leave 0.40 or more, and deviate at most 1.32 times as much.
LEFT_BY_CONTACTS: Final = 0.37
LOADED_DEVIATION: Final = 1.5
MIN_DEVIATION: Final = 0.02  # that of a sheet uneven by 4 %: a better one may not stay alone


class SkinAtStart(Enum):
    """What the first scans of a start are, beside a reference of before."""

    KNOWN = "known"  # the same, drifted; or nothing can be compared
    LOADED = "loaded"
    OTHER = "other"  # no contacts explain it, and it is as near to its model as the known one was


def skin_at_start(
    reconstructor: Reconstructor,  # of the sensor
    known: Reference,  # taken of the unloaded skin
    now: Reference,  # what may be loaded
    elapsed_s: float,  # how long ago `known` held
) -> SkinAtStart:
    """Hold what a tare at a start took against a reference that is known to hold.

    Takes some tenths of a second. The reconstructor measures against `known` from then on.
    """
    tracker = BaselineTracker(reconstructor)
    sensor = reconstructor.sensor
    # As even ones the sheets tell well enough, and at once.
    tracker.begin(Tare.take(sensor, known, is_even=True))
    if tracker.explains_as_drift(now, elapsed_s):
        return SkinAtStart.KNOWN
    gained = _without_gain(known, now)
    if reconstructor.compare(gained.magnitude, gained.structure).is_quiet:
        return SkinAtStart.KNOWN  # a factor that all voltages share is no contact
    method, budget_s = reconstructor.method, reconstructor.budget_s
    reconstructor.method, reconstructor.budget_s = "fit", DEFAULT_BUDGET_S
    left = min(_left_by_contacts(reconstructor, each) for each in (now, gained))
    reconstructor.method, reconstructor.budget_s = method, budget_s
    predicted = sensor.forward.bare_voltages
    grown = max(
        _deviation(getattr(now, name), predicted) / _deviation(getattr(known, name), predicted)
        for name in reconstructor.description.channels
        if getattr(now, name) is not None and getattr(known, name) is not None
    )
    is_loaded = left < LEFT_BY_CONTACTS or grown > LOADED_DEVIATION
    return SkinAtStart.LOADED if is_loaded else SkinAtStart.OTHER


def _without_gain(known: Reference, now: Reference) -> Reference:
    """What was taken, each channel over the factor that its voltages share."""

    def scaled(volts: FloatArray | None, before: FloatArray | None) -> FloatArray | None:
        if volts is None or before is None:
            return volts
        return np.asarray(volts / np.exp(np.median(_log_ratio(volts, before))))

    return Reference(scaled(now.magnitude, known.magnitude), scaled(now.structure, known.structure))


def _left_by_contacts(reconstructor: Reconstructor, seen: Reference) -> float:
    """Share of the changes, rms, that contacts leave unexplained."""
    reconstructor.forget_shape()
    measurement = reconstructor.compare(seen.magnitude, seen.structure)
    # An uneven drift looks much like another sheet.
    measurement = replace(measurement, may_drift=False)
    nothing = max(changes.misfit for changes in measurement.changes.values())
    return reconstructor.solve(measurement).misfit / nothing


def _deviation(volts: FloatArray, predicted: FloatArray) -> float:
    """How far voltages are from the model of the unloaded sheet, rms of logarithms, but a gain."""
    error = _log_ratio(volts, predicted)
    return max(float(np.std(error)), MIN_DEVIATION)


def _log_ratio(volts: FloatArray, others: FloatArray) -> FloatArray:
    """Logarithms of |volts / others|, of those voltages alone that are some."""
    there = (volts != 0) & (others != 0)
    return np.asarray(np.log(np.abs(volts[there] / others[there]))) if there.any() else np.zeros(1)

"""Sensors of one and two sheets, contacts on them, and the data that they make."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from measured import measured
from tactomo_models import Channel, SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene.field_fit import Budget, Family, FieldFit, FittedField, Measured
from tactomo_models.scene.parameters import (
    COLUMNS,
    E1,
    EDGE,
    HARMONIC,
    HOLE,
    PEAK,
    SIZE,
    UNIT_M,
    X,
    Y,
)
from tactomo_models.scene.pressure_field import PressureField
from tactomo_models.scene.sheet_response import GradedResponse
from variants import variant

PLENTY_S = 30.0
TABLE_KPA = (0.0, 50.0, 130.0, 200.0)  # no peak and no mean of peaks is on one of its knots
RISING = {"pressure_kpa": TABLE_KPA, "relative_change": (0.0, 0.1, 0.5, 1.0)}
FALLING = {"pressure_kpa": TABLE_KPA, "relative_change": (0.0, -0.05, -0.2, -0.4)}
LATE = {"pressure_kpa": (0.0, 100.0, 200.0), "relative_change": (0.0, 0.0, 0.25)}
SATURATING = {"pressure_kpa": (0.0, 40.0, 220.0), "conductivity_ratio": (1.0, 20.0, 100.0)}
SENSORS: dict[str, tuple[dict[str, Any] | None, dict[str, Any] | None]] = {
    "both": (LATE, {"conductivity_ratio": 100.0}),
    "both falling": (FALLING, {"conductivity_ratio": 0.01}),
    "both graded": (RISING, {"conductivity_ratio": None, "response": SATURATING}),
    "one graded": (RISING, None),
    "one falling": (FALLING, None),
    "structure alone": (None, {"conductivity_ratio": 100.0}),
    "resistive structure alone": (None, {"conductivity_ratio": 0.01}),
}


def contact(
    x_m: float = 0.004,
    y_m: float = 0.0,
    radius_m: float = 0.008,
    *,
    peak: float = 0.8,
    e: tuple[float, float] = (0.0, 0.0),
    waves: tuple[float, ...] = (),
    edge: float = 0.0,
    hole: float = 0.0,
) -> FloatArray:
    """Parameters (COLUMNS,) of a contact; its peak is a share of the table's end."""
    each = np.zeros(COLUMNS)
    each[[X, Y, SIZE]] = x_m / UNIT_M, y_m / UNIT_M, np.log(radius_m)
    each[E1 : E1 + 2] = e
    each[HARMONIC : HARMONIC + len(waves)] = waves
    each[[PEAK, EDGE, HOLE]] = peak, edge, hole
    return each


def contacts(*each: FloatArray) -> FloatArray:
    """Parameters (K, COLUMNS) of all."""
    return np.array(each).reshape(-1, COLUMNS)


@dataclass(frozen=True)
class Sensor:
    """A sensor's fit and field, and the data that contacts on it make."""

    fit: FieldFit
    field: PressureField

    @classmethod
    def of(cls, forward: ForwardModel, description: SensorDescription) -> Sensor:
        magnitude = description.magnitude
        graded = GradedResponse.of(magnitude.response) if magnitude else None
        return cls(FieldFit(forward, description), PressureField.on(forward, graded))

    def family(self, each: FloatArray) -> PressureField:
        return self.field.of(each, fits_peaks=Channel.MAGNITUDE in self.fit.responses)

    def no_data(self) -> Measured:
        none = np.zeros(len(self.fit.forward.bare_voltages))
        return {name: measured(none) for name in self.fit.responses}

    def at(self, each: FloatArray, data: Measured) -> FittedField:
        family = self.family(each)
        return evaluated(self.fit, family, family.join(each), data)

    def changes(self, fitted: FittedField) -> dict[Channel, FloatArray]:
        """Relative changes (M,) of each sheet's voltages."""
        bare = self.fit.forward.bare_voltages
        return {
            name: (solution.voltages - bare) / np.abs(bare)
            for name, solution in fitted.solutions.items()
        }

    def settled(self, start: FittedField, data: Measured) -> FittedField:
        """The minimum below a start, closer than a frame would ever ask for it."""
        for _ in range(100):
            better = self.fit.refine(start, data, Budget(PLENTY_S), 0.0, steps=1)
            if better.cost > start.cost * (1 - 1e-6) and better.damping < 1e3:
                return better
            start = better
        return start


def evaluated(
    fit: FieldFit,
    family: Family,
    parameters: FloatArray,
    data: Measured,
    log_ratio: float | None = None,
) -> FittedField:
    ratio = fit.likely if log_ratio is None else log_ratio
    fitted = fit.evaluate(family, parameters, ratio, data)
    assert fitted is not None
    return fitted


def data_of(
    exact: Mapping[Channel, FloatArray], sigma: float, rng: np.random.Generator | None = None
) -> Measured:
    """Data of a noise, of which there is none without a generator."""
    noise = 0.0 if rng is None else sigma
    rng = rng or np.random.default_rng(0)
    return {
        name: measured(change + noise * rng.standard_normal(len(change)), 1 / sigma)
        for name, change in exact.items()
    }


def described(small: SensorDescription, name: str) -> SensorDescription:
    magnitude, structure = SENSORS[name]
    return variant(
        small, magnitude={"response": magnitude} if magnitude else None, structure=structure
    )


def with_free(field: PressureField, columns: slice) -> PressureField:
    """The same contacts with some parameters of each fitted as well."""
    free = field.free.copy()
    free[:, columns] = True
    return replace(field, free=free)

"""Evaluations, Jacobians and steps in a row by a given library, for sanitizers.

python inner_loop_sequence.py LIBRARY
"""

from __future__ import annotations

import sys
import tomllib
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from measured import measured
from pressed import contact, contacts, described, with_free
from small_sensor import SMALL
from tactomo_models import Channel, SensorDescription, inner_loop
from tactomo_models.physics.bare_sheet import solve_bare_sheet
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.mesh import mesh_sheet
from tactomo_models.scene.field_fit import FieldFit
from tactomo_models.scene.level_set import LevelSet
from tactomo_models.scene.parameters import HARMONIC, HOLE, PEAK, SIZE, X, Y
from tactomo_models.scene.pressure_field import PressureField
from tactomo_models.scene.sheet_response import GradedResponse

SCENES = (
    contacts(),
    contacts(contact(0.0, 0.0, 0.006)),
    contacts(contact(-0.016, 0.0, 0.004, edge=0.5), contact(0.018, 0.01, 0.004, hole=0.6)),
    contacts(contact(-0.028, -0.022, 0.005, waves=(0.03, -0.02, 0.04, 0.05)), contact(0.018, 0.01)),
    contacts(contact(0.0, 0.0, 0.06)),  # all of the sheet
)


def fit_of(kind: str, sensor: SensorDescription) -> FieldFit:
    """A sensor's fit on a coarse mesh, with a Green's function of some kind."""
    dtype = np.float32 if kind == "single precision" else np.float64
    sheet = mesh_sheet(sensor, refinements=1)
    bare = solve_bare_sheet(sensor, sheet, quick=kind == "in pieces", green_dtype=dtype)
    return FieldFit(ForwardModel(sensor, bare))


def run(fit: FieldFit) -> None:
    """Draw, evaluate and differentiate one scene after another, and step to fewer contacts."""
    rng, count = np.random.default_rng(1), len(fit.forward.bare_voltages)
    data = {
        name: replace(measured(rng.normal(size=count), 2.0), drift=rng.normal(size=(count, 2)))
        for name in fit.responses
    }
    graded = fit.responses[Channel.MAGNITUDE]
    assert isinstance(graded, GradedResponse)
    empty = PressureField.on(fit.forward, graded)
    for each in (one for one in SCENES for _ in range(3)):
        each = each.copy()
        each[:, [X, Y, SIZE]] += 0.05 * rng.normal(size=(len(each), 3))
        field = with_free(empty.of(each), slice(HARMONIC, HOLE + 1))
        fitted = fit.evaluate(field, field.join(each), fit.likely, data)
        assert np.isfinite(fit.jacobian(fitted, data)).all()
        field.sampled(each, field.x_m, field.y_m, 1e-3)
        for k in range(len(each)):
            others = with_free(empty.of(np.delete(each, k, axis=0)), slice(PEAK, HOLE))
            fewer = others.draw(others.join(others.fixed))
            [step] = fit.steps_to(fitted, [fewer], data)
            assert all(np.isfinite(one).all() for one in vars(step).values())
    level_set = LevelSet(fit.forward)
    likeness = np.clip(1 - np.hypot(empty.x_m, empty.y_m) / 0.016, 0, 1)
    fitted = fit.evaluate(level_set, level_set.parameters_of(likeness), fit.likely, data)
    assert np.isfinite(fit.jacobian(fitted, data)).all()
    assert np.isfinite(fit.forward.bare_jacobian()).all()
    with suppress(np.linalg.LinAlgError):
        fit.forward.solve(np.full(len(empty.x_m), -2.0))


if __name__ == "__main__":
    inner_loop._PATH = Path(sys.argv[1])
    small = SensorDescription.model_validate(tomllib.loads(SMALL))
    for name in ("both", "both graded"):
        for kind in ("packed", "single precision", "in pieces"):
            run(fit_of(kind, described(small, name)))
    print("all of it ran")

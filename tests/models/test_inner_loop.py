"""The compiled inner loop does what its NumPy form does, to rounding."""

from __future__ import annotations

import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from measured import measured
from numpy_drawing import Contacts
from numpy_forward import NumpyForwardModel
from tactomo_models import Artifact, Channel, SensorDescription, inner_loop
from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.errors import ModelError
from tactomo_models.inner_loop import LIBRARY, at
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene.field_fit import FieldFit
from tactomo_models.scene.parameters import COLUMNS, EDGE, HARMONIC, HOLE, PEAK, SIZE, UNIT_M, X, Y
from tactomo_models.scene.pressure_field import PressureField

PLACES_MM = {
    "nothing": [],
    "one": [(4.0, 10.0)],
    "two apart": [(-40.0, -35.0), (30.0, 20.0)],
    "two in one": [(0.0, 0.0), (11.0, 6.0)],
    "beside electrodes": [(-66.0, -54.0), (66.0, 18.0)],
}


def agree(one: FloatArray | IntArray, other: FloatArray | IntArray) -> None:
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-9 * np.abs(other).max(initial=1e-30))


@pytest.fixture(scope="module")
def model(paper: SensorDescription, artifact: Artifact) -> ForwardModel:
    return ForwardModel(paper, artifact.bare)


@pytest.fixture(scope="module")
def in_numpy(model: ForwardModel) -> NumpyForwardModel:
    """The same sheet."""
    return NumpyForwardModel(model)


def contacts(where: str, kind: str) -> FloatArray:
    rng = np.random.default_rng(len(where))
    each = np.zeros((len(PLACES_MM[where]), COLUMNS))
    each[:, [X, Y]] = np.reshape(PLACES_MM[where], (-1, 2)) * 1e-3 / UNIT_M
    each[:, SIZE], each[:, PEAK] = np.log(rng.uniform(0.006, 0.02, len(each))), 0.6
    if kind != "circles":
        each[:, SIZE + 1 : HARMONIC] = rng.normal(0, 0.2, (len(each), 2))
        each[:, EDGE] = 0.5
    if kind == "rings":
        each[:, HARMONIC:PEAK], each[:, HOLE] = rng.normal(0, 0.05, (len(each), 4)), 0.8
    return each


@pytest.mark.parametrize("kind", ["circles", "ellipses that fall", "rings"])
@pytest.mark.parametrize("where", PLACES_MM)
def test_contacts_are_drawn_alike(model: ForwardModel, where: str, kind: str) -> None:
    each = contacts(where, kind)
    field = PressureField.on(model, None).of(each)
    field = field.with_free(slice(EDGE, COLUMNS))
    x_m, y_m = field.x_m + 0.4e-3, field.y_m + 0.3e-3

    made = field.draw(field.join(each))
    drawn = Contacts(field, each, field.x_m, field.y_m)
    there = (drawn.wide > -1).any(axis=0)
    agree(made.nodes, np.flatnonzero(there))
    shares = made.enclosed, made.enclosed_kpa, made.share, made.pressure_kpa
    others = drawn.enclosed, drawn.enclosed_kpa, drawn.share, drawn.pressure_kpa
    for one, other in zip(shares, others, strict=True):
        agree(one, other[there])
    for one, other in zip(made.slopes(), drawn.slopes(), strict=True):
        agree(one, other[field.free][:, there].T)
    sharp = replace(field, half_width_m=1e-3, blur_m2=0.0)
    drawn = Contacts(sharp, each, x_m, y_m, is_sharp=True)
    for one, other in zip(
        field.sampled(each, x_m, y_m, 1e-3),
        (drawn.enclosed, drawn.share, drawn.pressure_kpa),
        strict=True,
    ):
        agree(one, other)


@pytest.mark.parametrize("mixes", [False, True])
@pytest.mark.parametrize("contrast", [0.2, 100.0])
@pytest.mark.parametrize("where", PLACES_MM)
def test_a_sheet_is_solved_and_differentiated_alike(
    model: ForwardModel, in_numpy: NumpyForwardModel, where: str, contrast: float, mixes: bool
) -> None:
    field = PressureField.on(model, None).of(each := contacts(where, "circles"))
    drawing = field.draw(field.join(each))
    change = np.zeros(len(model.bare.pressable))
    change[drawing.nodes] = contrast**drawing.enclosed - 1
    one = model.solve(change, mix_resistivities=mixes, within=drawing.nodes)
    other = in_numpy.solve(change, mix_resistivities=mixes, within=drawing.nodes)
    agree(one.voltages, other.voltages)
    assert set(one.nodes) == set(other.nodes)
    everywhere = np.arange(len(model.bare.support))
    agree(model.potentials(one, everywhere), in_numpy.potentials(other, everywhere))
    onto = np.random.default_rng(0).normal(size=(len(drawing.nodes), 5))
    agree(model.jacobian(one, drawing.nodes, onto), in_numpy.jacobian(other, drawing.nodes, onto))
    elsewhere = np.arange(100)  # of which only some nodes, or none, belong to the solution
    agree(
        model.jacobian(one, elsewhere, onto := np.ones((100, 1))),
        in_numpy.jacobian(other, elsewhere, onto),
    )


def test_a_sequence_of_evaluations_is_as_in_numpy(
    model: ForwardModel, in_numpy: NumpyForwardModel, paper: SensorDescription
) -> None:
    """Of contacts that come, move, stay and go, with data that may have drifted."""
    rng, fit = np.random.default_rng(7), FieldFit(model, paper)
    bare, empty = model.bare_voltages, PressureField.on(model, None)
    data = {
        name: measured(0.1 * rng.normal(size=len(bare)), 1 + rng.random(len(bare)))
        for name in fit.responses
    }
    data[Channel.STRUCTURE] = data[Channel.STRUCTURE].drifting(rng.normal(size=(len(bare), 3)))
    for where in ("two in one", "two in one", "one", "nothing", "two apart", "beside electrodes"):
        field = empty.of(each := contacts(where, "ellipses that fall"))
        fitted = fit.evaluate(field, field.join(each), fit.likely, data)
        assert fitted is not None
        drawing, slopes = fitted.drawing, fitted.drawing.slopes()
        jacobians = []
        for name, changes in data.items():
            saturates = name == Channel.STRUCTURE
            share, pressure = (
                (drawing.enclosed, drawing.enclosed_kpa)
                if saturates
                else (drawing.share, drawing.pressure_kpa)
            )
            response = fit.responses[name]
            ratio, *by = response.conductivity(share, pressure, fit.likely)
            change = np.zeros(len(model.bare.pressable))
            change[drawing.nodes] = model.at_rest[drawing.nodes] * (ratio - 1)
            mixes = response.rises(fit.likely)
            solved = in_numpy.solve(change, mix_resistivities=mixes, within=drawing.nodes)
            relative = (solved.voltages - bare) / np.abs(bare)
            agree(fitted.residuals[name], changes.weighted(relative - changes.change))
            by_share, by_pressure = slopes[:2] if saturates else slopes[2:]
            onto = by[0][:, None] * by_share + by[1][:, None] * by_pressure
            onto = np.append(onto, by[2][:, None], axis=1) * model.at_rest[drawing.nodes, None]
            by_parameter = in_numpy.jacobian(solved, drawing.nodes, onto)
            jacobians.append(changes.weighted(by_parameter / np.abs(bare)[:, None]))
        agree(fit.jacobian(fitted, data), np.concatenate(jacobians))


def test_what_c_is_given_lives_as_long_as_its_address() -> None:
    """A property's array has nobody else: C once read what was freed."""
    array = np.arange(3)
    alive = weakref.ref(array)
    address = at(array)
    del array
    assert alive() is not None
    del address
    assert alive() is None


@pytest.mark.parametrize("state", ["is missing", "is not of this machine and version"])
def test_a_library_that_cannot_be_used_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, forward: ForwardModel, state: str
) -> None:
    library = tmp_path / "libinner_loop.so"
    if state != "is missing":
        library.write_bytes(b"not of this machine")
    monkeypatch.setattr(inner_loop, "_PATH", library)
    for name in [*vars(LIBRARY)]:
        monkeypatch.delattr(LIBRARY, name)  # as in a process that has not used it yet
    with pytest.raises(ModelError, match=f"{state}.*install tactomo again"):
        ForwardModel(forward.description, forward.bare)

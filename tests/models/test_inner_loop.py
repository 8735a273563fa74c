"""The compiled inner loop does what its NumPy form does, to rounding."""

from __future__ import annotations

import weakref

import numpy as np
import pytest
from tactomo_models import Artifact, SensorDescription
from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.inner_loop import LIBRARY, at
from tactomo_models.physics import forward
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene import pressure_field
from tactomo_models.scene.parameters import COLUMNS, EDGE, HARMONIC, HOLE, PEAK, SIZE, UNIT_M, X, Y
from tactomo_models.scene.pressure_field import PressureField

pytestmark = pytest.mark.skipif(LIBRARY is None, reason="no C compiler built the inner loop")

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


@pytest.fixture
def in_numpy(
    paper: SensorDescription, artifact: Artifact, monkeypatch: pytest.MonkeyPatch
) -> ForwardModel:
    """The same sheet; what is drawn from now on is drawn in NumPy, too."""
    monkeypatch.setattr(forward, "LIBRARY", None)
    monkeypatch.setattr(pressure_field, "LIBRARY", None)
    return ForwardModel(paper, artifact.bare)


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
def test_contacts_are_drawn_alike(
    model: ForwardModel, where: str, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    each = contacts(where, kind)
    field = PressureField.on(model, None).of(each, 0 if kind == "circles" else 2)
    field = field.with_free(slice(EDGE, COLUMNS))
    x_m, y_m = field.x_m + 0.4e-3, field.y_m + 0.3e-3

    def drawn() -> tuple[FloatArray | IntArray, ...]:
        made = field.draw(field.join(each))
        shares = made.enclosed, made.enclosed_kpa, made.share, made.pressure_kpa
        return (made.nodes, *shares, *made.slopes(), *field.sampled(each, x_m, y_m, 1e-3))

    compiled = drawn()
    monkeypatch.setattr(pressure_field, "LIBRARY", None)
    for one, other in zip(compiled, drawn(), strict=True):
        agree(one, other)


@pytest.mark.parametrize("mixes", [False, True])
@pytest.mark.parametrize("contrast", [0.2, 100.0])
@pytest.mark.parametrize("where", PLACES_MM)
def test_a_sheet_is_solved_and_differentiated_alike(
    model: ForwardModel, in_numpy: ForwardModel, where: str, contrast: float, mixes: bool
) -> None:
    field = PressureField.on(model, None).of(each := contacts(where, "circles"), 2)
    drawing = field.draw(field.join(each))
    change = np.zeros(len(model.bare.pressable))
    change[drawing.nodes] = contrast**drawing.enclosed - 1
    one, other = (
        each.solve(change, mix_resistivities=mixes, within=drawing.nodes)
        for each in (model, in_numpy)
    )
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


def test_what_c_is_given_lives_as_long_as_its_address() -> None:
    """A property's array has nobody else: C once read what was freed."""
    array = np.arange(3)
    alive = weakref.ref(array)
    address = at(array)
    del array
    assert alive() is not None
    del address
    assert alive() is None

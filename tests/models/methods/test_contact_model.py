"""The account of a shape: its areas, their magnitudes, and rings that look like discs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from measured import measured
from tactomo_models import Channel
from tactomo_models.arrays import FloatArray
from tactomo_models.methods.contact_model import ContactModel
from tactomo_models.methods.magnitudes import known_magnitudes, leaves_unexplained
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scans.changes import Changes
from tactomo_models.scene.areas import AreaFinder
from tactomo_models.scene.outlines import UNIT_M, outlines_on
from tactomo_models.scene.shape_fit import Budget, Shape, ShapeFit

SIGMA = 2e-5
RADIUS_M = 0.010


@pytest.fixture(scope="module")
def shape(forward: ForwardModel) -> Shape:
    """One circle, as the structure channel explains it."""
    fit = ShapeFit(forward, 100.0)
    family = outlines_on(forward).of(0, 1)
    parameters = np.array([0.002 / UNIT_M, 0.001 / UNIT_M, np.log(RADIUS_M)])
    none = measured(np.zeros(forward.description.measurements))
    there = fit.evaluate(family, parameters, fit.likely, none)
    assert there is not None
    exact = measured(there.residual, 1 / 0.002)
    found = fit.refine(fit.compare(there, exact), exact, Budget(5.0), 1.0)
    assert found.converged
    return found


def model(forward: ForwardModel) -> ContactModel:
    return ContactModel(forward, AreaFinder(forward), ShapeFit(forward, 100.0))


def changes_of(
    forward: ForwardModel, shape: Shape, magnitude: FloatArray
) -> dict[Channel, Changes]:
    """Both channels' changes where nodes (P,) of the magnitude channel change by so much."""
    bare = forward.bare_voltages
    volts = forward.solve(magnitude).voltages
    noise = SIGMA * np.random.default_rng(2).standard_normal(len(bare))
    structure = (shape.solution.voltages - bare) / np.abs(bare)
    return {
        Channel.MAGNITUDE: measured((volts - bare) / np.abs(bare) + noise, 1 / SIGMA),
        Channel.STRUCTURE: measured(structure, 1 / 0.002),
    }


def distance_m(forward: ForwardModel) -> FloatArray:
    x, y = forward.bare.points[:, forward.bare.pressable]
    return np.asarray(np.hypot(x - 0.002, y - 0.001))


def test_an_even_press_is_one_area_with_its_magnitude(forward: ForwardModel, shape: Shape) -> None:
    changes = changes_of(forward, shape, 0.15 * shape.coverage)
    account = model(forward).account(shape, changes, 3)
    assert account.fitted is not None
    assert account.fitted.change == pytest.approx([0.15], abs=3 * account.fitted.sigma[0])
    assert account.map(1.0).max() == pytest.approx(0.15, abs=0.01)
    assert not account.map(-1.0).any(), "what goes the wrong way shows nothing"


def test_the_same_shape_is_not_accounted_for_anew(
    forward: ForwardModel, shape: Shape, monkeypatch: pytest.MonkeyPatch
) -> None:
    contacts, changes = model(forward), changes_of(forward, shape, 0.15 * shape.coverage)
    first = contacts.account(shape, changes, 3)
    monkeypatch.setattr(forward, "solve", None)  # to call it would fail
    assert contacts.account(shape, changes, 3).areas is first.areas
    contacts.forget()
    assert not contacts.has_shape


def test_a_ring_is_hollow(forward: ForwardModel, shape: Shape) -> None:
    """The structure channel sees a disc; the magnitude channel looks inside."""
    inside = distance_m(forward) < 0.5 * RADIUS_M
    changes = changes_of(forward, shape, 0.15 * shape.coverage * ~inside)
    account = model(forward).account(shape, changes, 3)
    disc = model(forward).account(shape, changes_of(forward, shape, 0.15 * shape.coverage), 3)
    assert account.areas.areas_m2[0] < 0.9 * disc.areas.areas_m2[0]
    assert account.pressed.min() >= 0


def test_without_a_magnitude_scan_areas_have_no_magnitude(
    forward: ForwardModel, shape: Shape
) -> None:
    both: Mapping[Channel, Changes] = changes_of(forward, shape, 0.15 * shape.coverage)
    account = model(forward).account(shape, {Channel.STRUCTURE: both[Channel.STRUCTURE]}, 3)
    assert account.fitted is None
    assert len(account.areas) == 1
    size, sigma = known_magnitudes(account.fitted, 1.0, 1)
    assert np.isnan(size).all()
    assert np.isnan(sigma).all()


def test_a_change_against_the_sign_is_explained_by_no_press(
    forward: ForwardModel, shape: Shape
) -> None:
    changes = changes_of(forward, shape, -0.15 * shape.coverage)
    account = model(forward).account(shape, changes, 3)
    magnitude = changes[Channel.MAGNITUDE]
    assert leaves_unexplained(account.fitted, magnitude, 1.0)
    assert not leaves_unexplained(account.fitted, magnitude, -1.0)
    assert known_magnitudes(account.fitted, 1.0, 1)[0] == 0.0
    assert leaves_unexplained(None, magnitude, 1.0), "there is a change and no area for it"

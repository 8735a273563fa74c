"""The warm-started fit: what one frame leaves to the next, and which contacts come and go."""

from __future__ import annotations

import numpy as np
import pytest
from measured import measured
from tactomo_models.arrays import FloatArray
from tactomo_models.methods.warm_started_fit import ShapeModel, WarmStartedFit
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scans.changes import Changes
from tactomo_models.scene.outlines import MAX_PARAMETERS, SIZE, UNIT_M, Outlines, X, Y, outlines_on
from tactomo_models.scene.shape_fit import Budget, Shape, ShapeFit

RATIO = 100.0
NOISE = 1e-3  # of each relative change
PLENTY_S = 10.0

Disc = tuple[float, float, float]  # x, y and radius, metres

LEFT: Disc = (-0.012, -0.004, 0.007)
RIGHT: Disc = (0.013, 0.006, 0.006)


class Sheet:
    """Frames of discs on a sheet, with noise that is another in each."""

    def __init__(self, forward: ForwardModel) -> None:
        self._fit = ShapeFit(forward, RATIO)
        self._forward = forward
        self._rng = np.random.default_rng(2)

    def frame(self, *discs: Disc) -> Changes:
        bare = self._forward.bare_voltages
        family = outlines_on(self._forward).of(0, len(discs))
        none = measured(np.zeros(len(bare)))
        shape = self._fit.evaluate(family, family.join(contacts(*discs)), np.log(RATIO), none)
        assert shape is not None
        change = (shape.solution.voltages - bare) / np.abs(bare)
        return measured(change + NOISE * self._rng.standard_normal(len(bare)), 1 / NOISE)


def contacts(*discs: Disc) -> FloatArray:
    each = np.zeros((len(discs), MAX_PARAMETERS))
    for k, (x_m, y_m, radius_m) in enumerate(discs):
        each[k, [X, Y, SIZE]] = x_m / UNIT_M, y_m / UNIT_M, np.log(radius_m)
    return each


def places_of(shape: Shape) -> list[tuple[float, float]]:
    """Centres from left to right, metres."""
    assert isinstance(shape.family, Outlines)
    each = shape.family.split(shape.parameters)
    return sorted((float(x) * UNIT_M, float(y) * UNIT_M) for x, y in each[:, [X, Y]])


@pytest.fixture
def sheet(forward: ForwardModel) -> Sheet:
    return Sheet(forward)


@pytest.fixture
def fit(forward: ForwardModel) -> WarmStartedFit:
    return WarmStartedFit(forward, RATIO)


def follow(fit: WarmStartedFit, frame: Changes) -> tuple[Shape, str]:
    return fit.follow(frame, Budget(PLENTY_S))


def assert_at(shape: Shape, *discs: Disc) -> None:
    assert shape.converged
    assert shape.misfit < 1.5
    np.testing.assert_allclose(places_of(shape), sorted(disc[:2] for disc in discs), atol=2e-4)


def test_nothing_is_no_contact(fit: WarmStartedFit, sheet: Sheet) -> None:
    shape, how = follow(fit, sheet.frame())
    assert_at(shape)
    assert how.startswith("cold start")


def test_contacts_are_found_from_nothing(fit: WarmStartedFit, sheet: Sheet) -> None:
    shape, how = follow(fit, sheet.frame(LEFT, RIGHT))
    assert_at(shape, LEFT, RIGHT)
    assert how.startswith("cold start")


def test_a_still_scene_is_not_solved_again(
    fit: WarmStartedFit, sheet: Sheet, solves: list[int]
) -> None:
    first, second = sheet.frame(LEFT), sheet.frame(LEFT)
    shape, _ = follow(fit, first)
    solves.clear()
    again, how = follow(fit, second)
    assert how.startswith("still")
    assert not solves
    np.testing.assert_array_equal(again.parameters, shape.parameters)


def test_a_contact_that_moves_is_followed(fit: WarmStartedFit, sheet: Sheet) -> None:
    moved = (LEFT[0] + 3e-4, LEFT[1] + 2e-4, LEFT[2])
    first, second = sheet.frame(LEFT), sheet.frame(moved)
    follow(fit, first)
    shape, how = follow(fit, second)
    assert how.startswith("warm start")
    assert_at(shape, moved)


def test_a_contact_comes_and_another_goes(fit: WarmStartedFit, sheet: Sheet) -> None:
    for discs in ((LEFT,), (LEFT, RIGHT), (RIGHT,), ()):
        shape, _ = follow(fit, sheet.frame(*discs))
        assert_at(shape, *discs)


def test_work_that_a_budget_cuts_short_goes_on_in_the_next_frame(
    fit: WarmStartedFit, sheet: Sheet
) -> None:
    frame = sheet.frame(LEFT, RIGHT)
    shapes = [fit.follow(frame, Budget(0.01))[0] for _ in range(40)]
    assert not shapes[0].converged
    assert_at(shapes[-1], LEFT, RIGHT)


def test_what_is_proposed_is_judged_by_the_data(
    forward: ForwardModel, sheet: Sheet, solves: list[int]
) -> None:
    frame, effort = sheet.frame(LEFT, RIGHT), []
    for proposal in (contacts(LEFT, RIGHT), contacts((0.02, -0.018, 0.004)), contacts()):
        solves.clear()
        fit = WarmStartedFit(forward, RATIO)
        shape, how = fit.follow(frame, Budget(PLENTY_S), proposal.copy)
        assert_at(shape, LEFT, RIGHT)
        effort.append((how.split(",")[0], len(solves)))
    (good, few), (bad, many), (nothing, _) = effort
    assert (good, bad, nothing) == ("proposed", "cold start", "cold start")
    assert few < many


def test_what_is_forgotten_starts_cold(fit: WarmStartedFit, sheet: Sheet) -> None:
    follow(fit, sheet.frame(LEFT))
    fit.forget()
    shape, how = follow(fit, sheet.frame(LEFT))
    assert how.startswith("cold start")
    assert_at(shape, LEFT)


@pytest.mark.parametrize("model", [ShapeModel.OUTLINES, ShapeModel.LEVEL_SET])
def test_a_scene_is_described_as_is_asked_for(
    forward: ForwardModel, sheet: Sheet, model: ShapeModel
) -> None:
    shape, how = follow(WarmStartedFit(forward, RATIO, model), sheet.frame(LEFT))
    assert isinstance(shape.family, Outlines) == (model is ShapeModel.OUTLINES)
    assert how.endswith("level set") == (model is ShapeModel.LEVEL_SET)
    assert shape.misfit < 1.5

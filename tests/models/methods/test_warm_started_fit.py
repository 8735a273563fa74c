"""The warm-started fit: what one frame leaves to the next, and which contacts come and go."""

from __future__ import annotations

import numpy as np
import pytest
from pressed import Sensor, contact, contacts, data_of, described
from tactomo_models import Channel, SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.methods.moves import Candidate, Frame, Moves, ShapeModel
from tactomo_models.methods.warm_started_fit import WarmStartedFit
from tactomo_models.physics.bare_sheet import solve_bare_sheet
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.mesh import mesh_sheet
from tactomo_models.scene.field_fit import Budget, FittedField, Measured
from tactomo_models.scene.parameters import E1, E2, EDGE, HOLE, PEAK, UNIT_M, X, Y
from tactomo_models.scene.pressure_field import PressureField

NOISE = 1e-3  # of each relative change
PLENTY_S = 10.0

LEFT = contact(-0.012, -0.004, 0.007)
RIGHT = contact(0.013, 0.006, 0.006)


class Skin:
    """Frames of contacts on a sensor, with noise that is another in each."""

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        self._rng = np.random.default_rng(2)

    def frame(self, *each: FloatArray, noise: float = NOISE) -> Measured:
        pressed = contacts(*each)
        field = self.sensor.at(pressed, 2, self.sensor.no_data())
        return data_of(self.sensor.changes(field), noise, self._rng)


def places_of(shape: FittedField) -> list[tuple[float, float]]:
    """Centres from left to right, metres."""
    assert isinstance(shape.family, PressureField)
    each = shape.family.split(shape.parameters)
    return sorted((float(x) * UNIT_M, float(y) * UNIT_M) for x, y in each[:, [X, Y]])


@pytest.fixture(
    scope="module",
    params=["structure alone", "resistive structure alone", "both", "both falling", "one graded"],
)
def sensor(
    request: pytest.FixtureRequest, forward: ForwardModel, small: SensorDescription
) -> Sensor:
    return Sensor.of(forward, described(small, request.param))


@pytest.fixture
def skin(sensor: Sensor) -> Skin:
    return Skin(sensor)


@pytest.fixture
def fit(sensor: Sensor) -> WarmStartedFit:
    return WarmStartedFit(sensor.fit)


def follow(fit: WarmStartedFit, frame: Measured) -> tuple[FittedField, str]:
    return fit.follow(frame, Budget(PLENTY_S))


def assert_at(shape: FittedField, *each: FloatArray) -> None:
    assert shape.converged
    assert shape.misfit < 1.5
    places = sorted((one[X] * UNIT_M, one[Y] * UNIT_M) for one in each)
    np.testing.assert_allclose(places_of(shape), places, atol=3e-4)


def test_nothing_is_no_contact(fit: WarmStartedFit, skin: Skin) -> None:
    shape, how = follow(fit, skin.frame())
    assert_at(shape)
    assert how.startswith("cold start")


def test_contacts_are_found_from_nothing(fit: WarmStartedFit, skin: Skin) -> None:
    shape, how = follow(fit, skin.frame(LEFT, RIGHT))
    assert_at(shape, LEFT, RIGHT)
    assert how.startswith("cold start")


def test_a_still_scene_is_not_solved_again(
    fit: WarmStartedFit, skin: Skin, solves: list[int]
) -> None:
    first, second = skin.frame(LEFT), skin.frame(LEFT)
    shape, _ = follow(fit, first)
    solves.clear()
    again, how = follow(fit, second)
    assert how.startswith("still")
    assert not solves
    np.testing.assert_array_equal(again.parameters, shape.parameters)


def test_a_contact_that_moves_is_followed(fit: WarmStartedFit, skin: Skin) -> None:
    moved = LEFT.copy()
    moved[[X, Y]] += 0.1, 0.06
    first, second = skin.frame(LEFT), skin.frame(moved)
    follow(fit, first)
    shape, how = follow(fit, second)
    assert how.startswith("warm start")
    assert_at(shape, moved)


def test_a_contact_comes_and_another_goes(fit: WarmStartedFit, skin: Skin) -> None:
    for each in ((LEFT,), (LEFT, RIGHT), (RIGHT,), ()):
        shape, _ = follow(fit, skin.frame(*each))
        assert_at(shape, *each)


def test_work_that_a_budget_cuts_short_goes_on_in_the_next_frame(
    fit: WarmStartedFit, skin: Skin
) -> None:
    frame = skin.frame(LEFT, RIGHT)
    shapes = [fit.follow(frame, Budget(0.01))[0] for _ in range(60)]
    assert not shapes[0].converged
    assert_at(shapes[-1], LEFT, RIGHT)


def test_what_is_proposed_is_judged_by_the_data(
    sensor: Sensor, skin: Skin, solves: list[int]
) -> None:
    frame, effort = skin.frame(LEFT, RIGHT), []
    for each in (contacts(LEFT, RIGHT), contacts(contact(0.02, -0.018, 0.004)), contacts()):
        solves.clear()
        fit = WarmStartedFit(sensor.fit)
        shape, how = fit.follow(frame, Budget(PLENTY_S), each.copy)
        assert_at(shape, LEFT, RIGHT)
        effort.append((how.split(",")[0], len(solves)))
    (good, few), (_, many), (nothing, most) = effort
    assert (good, nothing) == ("proposed", "cold start")
    if sensor.fit.likely > 0:  # circles are as quickly found as ellipses made round otherwise
        assert few < min(many, most)


def test_what_is_forgotten_starts_cold(fit: WarmStartedFit, skin: Skin) -> None:
    follow(fit, skin.frame(LEFT))
    fit.forget()
    shape, how = follow(fit, skin.frame(LEFT))
    assert how.startswith("cold start")
    assert_at(shape, LEFT)


@pytest.mark.parametrize("model", [ShapeModel.OUTLINES, ShapeModel.LEVEL_SET])
def test_a_scene_is_described_as_is_asked_for(
    sensor: Sensor, skin: Skin, model: ShapeModel
) -> None:
    shape, how = follow(WarmStartedFit(sensor.fit, model), skin.frame(LEFT))
    assert isinstance(shape.family, PressureField) == (model is ShapeModel.OUTLINES)
    assert how.endswith("level set") == (model is ShapeModel.LEVEL_SET)
    assert shape.misfit < 1.5


@pytest.fixture(params=["both", "both falling", "one graded", "one falling"])
def graded(request: pytest.FixtureRequest, forward: ForwardModel, small: SensorDescription) -> Skin:
    return Skin(Sensor.of(forward, described(small, request.param)))


@pytest.mark.parametrize(("edge", "hole"), [(0.0, 0.0), (0.5, 0.0), (0.0, 1.0)])
def test_edges_and_holes_are_what_the_data_say(graded: Skin, edge: float, hole: float) -> None:
    """And the peak with them, to a tenth; frames after the first go on asking."""
    pressed = contact(-0.004, 0.002, 0.012, peak=0.85, edge=edge, hole=hole)
    fit = WarmStartedFit(graded.sensor.fit)
    for _ in range(6):
        shape, _ = follow(fit, graded.frame(pressed, noise=1e-4))
    assert isinstance(shape.family, PressureField)
    (one,) = shape.family.split(shape.parameters)
    assert (one[EDGE] > 0, one[HOLE]) == (edge > 0, hole)
    assert one[PEAK] == pytest.approx(pressed[PEAK], rel=0.1)
    assert shape.converged


def test_a_long_contact_is_one_ellipse(graded: Skin) -> None:
    """And no two circles: also where there is no saturated sheet whose ratio is fitted first."""
    pressed = contact(-0.002, 0.003, 0.01, peak=0.85, e=(0.25, 0.1))
    shape, _ = follow(WarmStartedFit(graded.sensor.fit), graded.frame(pressed, noise=1e-2))
    assert isinstance(shape.family, PressureField)
    (one,) = shape.family.split(shape.parameters)
    assert one[[E1, E2]] == pytest.approx([0.25, 0.1], abs=0.1)


def test_a_contact_that_is_added_in_vain_keeps_nothing_else_from_being_tried(
    graded: Skin, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else it would be added again and again, while the known ones wait, until time is up."""
    born = Moves.birth

    def in_vain(self: Moves, shape: FittedField, frame: Frame) -> Candidate | None:
        assert isinstance(shape.family, PressureField)
        return Candidate(shape, np.inf) if shape.family.count else born(self, shape, frame)

    monkeypatch.setattr(Moves, "birth", in_vain)
    fit = WarmStartedFit(graded.sensor.fit)
    follow(fit, graded.frame(contact(-0.002, 0.003, 0.01, peak=0.85)))
    other = contact(0.004, -0.004, 0.006, peak=1.2, e=(0.3, 0.1))
    shape, _ = follow(fit, graded.frame(other))
    assert_at(shape, other)


def test_a_sheet_that_is_lost_and_comes_back_changes_no_contact(
    forward: ForwardModel, small: SensorDescription
) -> None:
    """The magnitude channel misses frames: outlines go on, and pressures come back."""
    skin = Skin(Sensor.of(forward, described(small, "both")))
    fit = WarmStartedFit(skin.sensor.fit)
    before, _ = follow(fit, skin.frame(LEFT, RIGHT))
    for lost in (1, 10, 11):
        for _ in range(lost):
            structure = skin.frame(LEFT, RIGHT)[Channel.STRUCTURE]
            alone, _ = follow(fit, {Channel.STRUCTURE: structure})
            assert_at(alone, LEFT, RIGHT)
        back, _ = follow(fit, skin.frame(LEFT, RIGHT))
        assert_at(back, LEFT, RIGHT)
        assert back.parameters == pytest.approx(before.parameters, abs=0.1)


def test_pressures_follow_what_moves_also_when_time_is_short(graded: Skin) -> None:
    """Once it is found, a step a frame has to do for outline and pressure."""
    fit, peaks = WarmStartedFit(graded.sensor.fit), np.linspace(0.7, 0.95, 40)
    for k, peak in enumerate(peaks):
        pressed = contact(-0.010 + 2.5e-4 * k, 0.002, 0.009, peak=peak)
        frame = graded.frame(pressed, noise=2e-4)
        shape, _ = fit.follow(frame, Budget(0.0 if k else PLENTY_S))
    assert isinstance(shape.family, PressureField)
    (one,) = shape.family.split(shape.parameters)
    assert one[PEAK] == pytest.approx(peaks[-1], abs=0.03)
    assert one[X] * UNIT_M == pytest.approx(pressed[X] * UNIT_M, abs=1e-3)


def test_what_goes_on_as_it_did_costs_a_step_a_frame(graded: Skin) -> None:
    """The start is where its contacts would be now; one that stops is not lost."""
    fit, x_m = WarmStartedFit(graded.sensor.fit), -0.016
    for k in range(16):
        x_m += 0.002
        pressed = contact(x_m, 0.002, 0.007)
        shape, _ = fit.follow(graded.frame(pressed, noise=2e-4), Budget(0.0 if k else PLENTY_S))
        if k > 6:  # the first frames do not know how fast it is
            assert [x for x, _ in places_of(shape)] == pytest.approx([x_m], abs=2e-4)
    for _ in range(3):
        shape, _ = follow(fit, graded.frame(pressed, noise=2e-4))
    assert_at(shape, pressed)


def test_a_still_scene_settles_though_there_are_few_steps_a_frame(graded: Skin) -> None:
    """Each frame's noise is another: to follow it is no progress."""
    fit = WarmStartedFit(graded.sensor.fit)
    shapes = [fit.follow(graded.frame(LEFT), Budget(0.01))[0] for _ in range(20)]
    assert not shapes[0].converged
    assert all(shape.converged for shape in shapes[-5:])
    assert_at(shapes[-1], LEFT)


@pytest.mark.parametrize("budget_s", [0.01, 0.03, PLENTY_S])
def test_a_flat_press_that_lands_is_not_soft_for_want_of_time(
    graded: Skin, budget_s: float
) -> None:
    """A fit that was cut short says nothing about edges."""
    pressed = contact(-0.004, 0.002, 0.012, peak=0.85)
    fit = WarmStartedFit(graded.sensor.fit)
    for _ in range(20):
        shape, _ = fit.follow(graded.frame(pressed, noise=2e-4), Budget(budget_s))
    assert isinstance(shape.family, PressureField)
    (one,) = shape.family.split(shape.parameters)
    assert one[[EDGE, HOLE]] == pytest.approx([0, 0])
    assert one[PEAK] == pytest.approx(pressed[PEAK], rel=0.05)


CORNERS = tuple(
    contact(x, y, 0.008)
    for x, y in ((-0.046, -0.045), (-0.042, 0.046), (0.042, -0.044), (0.046, 0.045))
)
BESIDE = contact(-0.014, -0.002, 0.008), contact(0.014, 0.0, 0.008)


@pytest.fixture(scope="module")
def large(paper: SensorDescription) -> Sensor:
    """A sheet of sixteen electrodes: eight tell no six contacts."""
    forward = ForwardModel(paper, solve_bare_sheet(paper, mesh_sheet(paper, refinements=1)))
    return Sensor.of(forward, paper)


@pytest.fixture
def stacked(large: Sensor) -> Skin:
    return Skin(large)


def test_two_in_a_crowd_are_not_taken_for_one(stacked: Skin) -> None:
    """Both sheets search, also when what is proposed is one for two; and stay with it."""
    fit = WarmStartedFit(stacked.sensor.fit)
    proposed = contacts(*CORNERS, contact(0.0, 0.0, 0.012))
    for _ in range(4):
        frame = stacked.frame(*CORNERS, *BESIDE, noise=2e-4)
        shape, how = fit.follow(frame, Budget(PLENTY_S), lambda: proposed)
    assert_at(shape, *CORNERS, *BESIDE)
    assert "still" in how


@pytest.mark.slow
def test_a_crowd_that_moves_shrinks_or_misses_a_sheet_is_followed(stacked: Skin) -> None:
    """What both sheets have found is kept on one, and by the sheets that come back."""
    fit = WarmStartedFit(stacked.sensor.fit)
    follow(fit, stacked.frame(*CORNERS, *BESIDE, noise=2e-4))
    one, other = BESIDE
    for k in range(4):
        moved = one.copy()
        moved[Y] += 0.001 * (k + 1) / UNIT_M
        frame = stacked.frame(*CORNERS, moved, other, noise=2e-4)
        shape, _ = follow(fit, frame)
    assert_at(shape, *CORNERS, moved, other)
    alone, _ = follow(fit, {Channel.STRUCTURE: frame[Channel.STRUCTURE]})
    assert len(places_of(alone)) == 6
    back, _ = follow(fit, stacked.frame(*CORNERS, moved, other, noise=2e-4))
    assert_at(back, *CORNERS, moved, other)
    few, _ = follow(fit, stacked.frame(*CORNERS[:2], noise=2e-4))
    assert_at(few, *CORNERS[:2])


def test_rings_in_a_crowd_are_told_from_discs(stacked: Skin) -> None:
    """Questions are asked once what is there is settled, also where no contact was missing."""
    rings = [
        contact(one[X] * UNIT_M, one[Y] * UNIT_M, 0.013, peak=0.7, hole=1.0) for one in CORNERS
    ]
    fit = WarmStartedFit(stacked.sensor.fit)
    shape, _ = follow(fit, stacked.frame(*rings, noise=2e-4))
    assert isinstance(shape.family, PressureField)
    assert shape.family.split(shape.parameters)[:, HOLE] == pytest.approx(1.0)

"""What another kind of contact would come to, predicted without a solve: as a fit of all has it."""

from __future__ import annotations

import numpy as np
import pytest
from pressed import PLENTY_S, Sensor, contact, contacts, data_of
from tactomo_models import SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.methods.account import Account, Frame, account_of, descended
from tactomo_models.methods.kinds import Kind
from tactomo_models.methods.prediction import at_end, predict, start_of
from tactomo_models.physics.bare_sheet import solve_bare_sheet
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.mesh import mesh_sheet
from tactomo_models.scene.field_fit import Budget
from tactomo_models.scene.parameters import PEAK

NOISE = 3e-3
RADIUS_M = 0.012
GAPS_M = [0.010, 0.040]  # between the outlines of two contacts
PRESSED = {"even": {}, "soft": {"edge": 0.5}, "ring": {"hole": 1.0}}


@pytest.fixture(scope="module")
def sensor(paper: SensorDescription) -> Sensor:
    forward = ForwardModel(paper, solve_bare_sheet(paper, mesh_sheet(paper, refinements=1)))
    return Sensor.of(forward, paper)


@pytest.fixture(params=GAPS_M, ids=["10 mm", "40 mm"])
def gap_m(request: pytest.FixtureRequest) -> float:
    return float(request.param)


def fitted(sensor: Sensor, frame: Frame, each: FloatArray) -> Account:
    """The minimum of all contacts together."""
    family = sensor.family(each)
    start = sensor.fit.evaluate(family, family.join(each), sensor.fit.likely, frame.measured)
    return descended(sensor.fit, account_of(sensor.fit, start, frame), frame, steps=40)


def even_fit(sensor: Sensor, gap_m: float, pressed: str) -> tuple[Account, Frame]:
    """Two even contacts fitted to data of one of some kind and of an even one."""
    beside = contact(2 * RADIUS_M + gap_m - 0.03, 0.01, RADIUS_M, peak=0.8)
    one = contact(-0.03, 0.01, RADIUS_M, peak=0.9, **PRESSED[pressed])  # type: ignore[arg-type]
    truth = sensor.at(contacts(one, beside), sensor.no_data())
    data = data_of(sensor.changes(truth), NOISE, np.random.default_rng(7))
    frame = Frame(data, Budget(PLENTY_S))
    even = contacts(contact(-0.03, 0.01, RADIUS_M, peak=0.7), beside)
    return fitted(sensor, frame, even), frame


@pytest.mark.parametrize("kind", [Kind.EVEN, Kind.FALLING, Kind.ROUNDED, Kind.RING])
def test_a_step_to_another_drawing_is_right_to_first_order(sensor: Sensor, kind: Kind) -> None:
    """Of a step that is halved the error falls to a quarter."""
    account, frame = even_fit(sensor, 0.040, "even")
    each = account.contacts.copy()
    each[:1] = start_of(sensor.fit, sensor.field, each[0], kind, is_light=False)
    family = sensor.family(each)
    log_ratio = account.fitted.log_ratio
    at = sensor.fit.evaluate(family, family.join(each), log_ratio, frame.measured)
    along = np.random.default_rng(3).normal(size=len(at.parameters))
    errors = []
    for size in (2e-3, 1e-3):
        other = at.parameters + size * along
        [step] = sensor.fit.steps_to(at, [family.draw(other)], frame.measured)
        solved = sensor.fit.evaluate(family, other, log_ratio, frame.measured)
        errors.append(np.linalg.norm(solved.residual - at.residual - step.residual))
    assert errors[1] < 0.3 * errors[0]


@pytest.mark.parametrize("kind", [Kind.FALLING, Kind.ROUNDED, Kind.RING])
def test_a_step_has_the_slopes_of_its_drawing(sensor: Sensor, kind: Kind) -> None:
    """By the parameters of what is drawn, wherever the field was solved; and by the log ratio."""
    account, frame = even_fit(sensor, 0.010, "even")
    each = account.contacts.copy()
    each[:1] = start_of(sensor.fit, sensor.field, each[0], kind, is_light=False)
    family = sensor.family(each)
    parameters = family.join(each)
    drawings = [family.draw(parameters)]
    along = np.random.default_rng(4).normal(size=len(parameters))
    sizes = (2e-3, 1e-3)
    drawings += [family.draw(parameters + size * along) for size in sizes]
    step, *others = sensor.fit.steps_to(account.fitted, drawings, frame.measured)
    errors = [
        np.linalg.norm(other.residual - step.residual - size * step.by_parameters @ along)
        for size, other in zip(sizes, others, strict=True)
    ]
    assert errors[1] < 0.3 * errors[0]


@pytest.mark.parametrize(
    ("pressed", "kind"), [("even", Kind.RING), ("soft", Kind.FALLING), ("ring", Kind.EVEN)]
)
def test_one_solve_where_it_was_foreseen_says_what_a_fit_comes_to(
    sensor: Sensor, gap_m: float, pressed: str, kind: Kind
) -> None:
    account, frame = even_fit(sensor, gap_m, pressed)
    [found] = predict(sensor.fit, sensor.field, account, [(0, kind)], frame)
    family = sensor.family(found.every)
    once = sensor.fit.evaluate(family, family.join(found.every), found.log_ratio, frame.measured)
    end = at_end(sensor.fit, account_of(sensor.fit, once, frame), frame, found.own)
    joint = fitted(sensor, frame, found.every)
    assert end.log_evidence == pytest.approx(joint.log_evidence, abs=0.5)
    free = joint.sigmas[0] > 0
    off = (end.contacts[0] - joint.contacts[0])[free] / joint.sigmas[0][free]
    # What is left at either end is a tenth of chi-squared, a third of a sigma.
    assert np.abs(off).max() < 0.35
    assert end.sigmas[0][free] == pytest.approx(joint.sigmas[0][free], rel=0.2)


def test_what_stays_as_it_is_is_as_likely(sensor: Sensor, gap_m: float) -> None:
    account, frame = even_fit(sensor, gap_m, "even")
    [same] = predict(sensor.fit, sensor.field, account, [(0, Kind.EVEN)], frame)
    assert same.log_evidence == pytest.approx(account.log_evidence, abs=0.1)
    assert same.contacts == pytest.approx(account.contacts[:1], abs=0.02)


def test_nothing_in_place_of_a_contact_is_hardly_likely(sensor: Sensor, gap_m: float) -> None:
    account, frame = even_fit(sensor, gap_m, "even")
    [nothing] = predict(sensor.fit, sensor.field, account, [(0, Kind.NONE)], frame)
    assert nothing.log_evidence < account.log_evidence - 20
    assert len(nothing.contacts) == 0


def test_what_is_foreseen_is_not_solved_for(sensor: Sensor, solves: list[int]) -> None:
    account, frame = even_fit(sensor, 0.040, "soft")
    solves.clear()
    predict(sensor.fit, sensor.field, account, [(0, Kind.FALLING), (0, Kind.RING)], frame)
    assert not solves


def test_a_light_contact_of_another_kind_stays_below_the_onset(sensor: Sensor) -> None:
    """Where the graded sheet answers to nothing: that it rests tells how hard no kind presses."""
    light = contact(0.01, -0.02, RADIUS_M, peak=0.3)
    truth = sensor.at(contacts(light), sensor.no_data())
    data = data_of(sensor.changes(truth), NOISE, np.random.default_rng(8))
    frame = Frame(data, Budget(PLENTY_S))
    account = fitted(sensor, frame, contacts(light))
    for kind in (Kind.FALLING, Kind.RING):
        [found] = predict(sensor.fit, sensor.field, account, [(0, kind)], frame)
        assert found.contacts[0, PEAK] < sensor.field.onset

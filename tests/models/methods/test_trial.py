"""Trials of a contact beside others that are frozen: what the joint fit of all would say."""

from __future__ import annotations

import numpy as np
import pytest
from pressed import PLENTY_S, Sensor, contact, contacts, data_of
from tactomo_models import SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.methods.account import Account, Frame, account_of, descended
from tactomo_models.methods.kinds import Kind, as_kind
from tactomo_models.methods.trial import Rest
from tactomo_models.physics.bare_sheet import solve_bare_sheet
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.mesh import mesh_sheet
from tactomo_models.scene.field_fit import Budget

NOISE = 3e-3
RADIUS_M = 0.012
# Between the outlines: a neighbour at 10 mm is solved with each trial, one at 40 mm is frozen.
GAPS_M = [0.010, 0.040]
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
    assert start is not None
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


@pytest.mark.parametrize(
    ("pressed", "kind"), [("even", Kind.RING), ("soft", Kind.FALLING), ("ring", Kind.EVEN)]
)
def test_a_trial_is_what_the_fit_of_all_would_be(
    sensor: Sensor, gap_m: float, pressed: str, kind: Kind
) -> None:
    account, frame = even_fit(sensor, gap_m, pressed)
    rest = Rest(sensor.fit, sensor.field, account, [0], frame)
    start = as_kind(account.contacts[0], kind)
    trial = rest.trial(start)
    assert trial is not None
    every = np.vstack([start, account.contacts[1:]])
    joint = fitted(sensor, frame, every)
    gain = joint.log_evidence - account.log_evidence
    assert trial.log_odds == pytest.approx(gain, abs=0.5)
    free = joint.sigmas[0] > 0
    off = (trial.contacts[0] - joint.contacts[0])[free] / joint.sigmas[0][free]
    # What is left at either end is a tenth of chi-squared, a third of a sigma.
    assert np.abs(off).max() < 0.35
    assert trial.sigmas[0][free] == pytest.approx(joint.sigmas[0][free], rel=0.2)


def test_what_stays_as_it_is_is_as_likely(sensor: Sensor, gap_m: float) -> None:
    account, frame = even_fit(sensor, gap_m, "even")
    trial = Rest(sensor.fit, sensor.field, account, [0], frame).trial(account.contacts[:1])
    assert trial is not None
    assert trial.log_odds == pytest.approx(0.0, abs=0.2)


def test_nothing_in_place_of_a_contact_is_hardly_likely(sensor: Sensor, gap_m: float) -> None:
    """What the others could do of it is allowed for, and is little."""
    account, frame = even_fit(sensor, gap_m, "even")
    trial = Rest(sensor.fit, sensor.field, account, [0], frame).trial(contacts())
    assert trial is not None
    assert trial.log_odds < -100
    assert len(trial.contacts) == 0


def test_a_trial_costs_the_solves_of_its_own_contact(sensor: Sensor, solves: list[int]) -> None:
    """Far from the others; and what it spends is taken off the frame's budget."""
    account, frame = even_fit(sensor, 0.040, "soft")
    rest = Rest(sensor.fit, sensor.field, account, [0], frame)
    before = frame.budget.left_s
    solves.clear()
    rest.trial(as_kind(account.contacts[0], Kind.FALLING))
    assert len(solves) <= 2 * 8  # of two sheets
    assert frame.budget.left_s < before


def test_a_trial_that_comes_to_touch_what_is_frozen_is_solved_with_it(sensor: Sensor) -> None:
    """A start that overlaps a neighbour 40 mm away has an answer, too."""
    account, frame = even_fit(sensor, 0.040, "even")
    rest = Rest(sensor.fit, sensor.field, account, [0], frame)
    trial = rest.trial(account.contacts[1:])
    assert trial is not None
    assert np.isfinite(trial.log_odds)

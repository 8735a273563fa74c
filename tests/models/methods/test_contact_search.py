"""The search for what is missing: beside what is known, on sheets of every kind."""

from __future__ import annotations

import numpy as np
import pytest
from pressed import PLENTY_S, Sensor, contact, contacts, data_of
from tactomo_models import Channel, SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.methods.account import Account, Frame, account_of, descended
from tactomo_models.methods.contact_search import NEAR_M, ContactSearch
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene.field_fit import Budget
from tactomo_models.scene.parameters import SIZE, UNIT_M, X, Y
from variants import variant

KNOWN = contact(-0.012, -0.008, 0.006)
MISSING = contact(0.014, 0.006, 0.004)
BESIDE = contact(-0.012, 0.004, 0.004)  # 2 mm between the outlines
RATIOS = [100.0, 0.01]


@pytest.fixture(params=RATIOS, ids=["conductive", "resistive"])
def ratio(request: pytest.FixtureRequest) -> float:
    return float(request.param)


@pytest.fixture
def sensor(forward: ForwardModel, small: SensorDescription, ratio: float) -> Sensor:
    description = variant(small, magnitude=None, structure={"conductivity_ratio": ratio})
    return Sensor.of(forward, description)


def fitted_without(sensor: Sensor, missing: FloatArray) -> tuple[Account, Frame]:
    """The fit of the known contact alone to data of both."""
    truth = sensor.at(contacts(KNOWN, missing), sensor.no_data())
    frame = Frame(data_of(sensor.changes(truth), 0.01), Budget(PLENTY_S))
    start = account_of(sensor.fit, sensor.at(contacts(KNOWN), frame.measured), frame)
    return descended(sensor.fit, start, frame, steps=20), frame


def test_the_search_finds_the_contact_that_is_missing(sensor: Sensor, ratio: float) -> None:
    """Beside one that is known, and has moved and stretched to explain as much as it can."""
    account, frame = fitted_without(sensor, MISSING)
    search = ContactSearch(sensor.fit, {Channel.STRUCTURE: ratio})
    first = search.missing(account, frame, far=True)[0]
    assert np.hypot(first.x_m - 0.014, first.y_m - 0.006) < 0.008
    assert first.radius_m == pytest.approx(0.006, abs=1e-3)  # the least of a start
    assert first.gain > 10


def test_far_from_all_contacts_is_nothing_that_is_next_to_one(sensor: Sensor, ratio: float) -> None:
    """What is missing there may be a part of its form."""
    account, frame = fitted_without(sensor, BESIDE)
    search = ContactSearch(sensor.fit, {Channel.STRUCTURE: ratio})
    (known,) = account.contacts
    for one in search.missing(account, frame, far=True):
        centre = np.hypot(one.x_m - UNIT_M * known[X], one.y_m - UNIT_M * known[Y])
        assert centre - np.exp(known[SIZE]) >= NEAR_M


def test_nothing_is_missing_of_what_is_explained(sensor: Sensor, ratio: float) -> None:
    """The best of many places gains something by noise alone, which is no contact."""
    truth = sensor.at(contacts(KNOWN), sensor.no_data())
    data = data_of(sensor.changes(truth), 0.01, np.random.default_rng(5))
    frame = Frame(data, Budget(PLENTY_S))
    start = account_of(sensor.fit, sensor.fit.compare(truth, data), frame)
    account = descended(sensor.fit, start, frame, steps=20)
    search = ContactSearch(sensor.fit, {Channel.STRUCTURE: ratio})
    assert not search.missing(account, frame, far=True)

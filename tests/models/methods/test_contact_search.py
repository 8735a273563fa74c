"""The search for what is missing: beside what is known, on sheets of every kind."""

from __future__ import annotations

import numpy as np
import pytest
from measured import measured
from pressed import contact, contacts
from tactomo_models import Channel, SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.methods.contact_search import ContactSearch
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene.field_fit import FieldFit, FittedField
from tactomo_models.scene.pressure_field import PressureField
from variants import variant

KNOWN = contact(-0.012, -0.008, 0.006)
MISSING = contact(0.012, 0.006, 0.004)


@pytest.mark.parametrize("ratio", [100.0, 0.01], ids=["conductive", "resistive"])
def test_the_search_finds_the_contact_that_is_missing(
    forward: ForwardModel, small: SensorDescription, ratio: float
) -> None:
    """Beside one that is known, and about as large as it is."""
    sensor = variant(small, magnitude=None, structure={"conductivity_ratio": ratio})
    fit, field = FieldFit(forward, sensor), PressureField.on(forward, None)
    bare = forward.bare_voltages

    def fitted(*each: FloatArray) -> FittedField:
        family = field.of(contacts(*each), fits_peaks=False)
        data = {Channel.STRUCTURE: measured(np.zeros(len(bare)))}
        field_ = fit.evaluate(family, family.join(contacts(*each)), fit.likely, data)
        assert field_ is not None
        return field_

    volts = fitted(KNOWN, MISSING).solutions[Channel.STRUCTURE].voltages
    changes = {Channel.STRUCTURE: measured((volts - bare) / np.abs(bare), 100.0)}
    known = fit.compare(fitted(KNOWN), changes)
    found = ContactSearch(fit, {Channel.STRUCTURE: ratio}).missing(known, changes)[0]
    assert np.hypot(found.x_m - 0.012, found.y_m - 0.006) < 0.005
    assert found.radius_m == pytest.approx(0.004, rel=0.35)
    assert found.gain > 10

"""The converter: noise, counts and clipping."""

from __future__ import annotations

import numpy as np
import pytest
from tactomo.twin.firmware import Converter
from tactomo_models.arrays import FloatArray
from tactomo_protocol import Channel

VOLTS = np.linspace(-0.5, 0.5, 208)


def volts_of(
    converter: Converter, counter: int = 0, channel: Channel = Channel.MAGNITUDE
) -> FloatArray:
    counts, _ = converter.convert(VOLTS, channel=channel, counter=counter)
    return np.asarray(counts * converter.volts_per_count)


def test_without_noise_only_the_rounding_remains() -> None:
    converter = Converter(1.0, 0.0)
    assert np.max(np.abs(volts_of(converter) - VOLTS)) <= converter.volts_per_count / 2 * 1.000001


def test_noise_has_the_stated_size_on_every_measurement() -> None:
    converter = Converter(1.0, 1e-3)
    errors = np.array([volts_of(converter, counter) - VOLTS for counter in range(500)])
    assert np.std(errors) == pytest.approx(1e-3, rel=0.02)
    assert np.ptp(errors.std(axis=0)) < 4e-4
    assert abs(np.corrcoef(errors[:-1].ravel(), errors[1:].ravel())[0, 1]) < 0.02


def test_the_channels_have_noise_of_their_own() -> None:
    converter = Converter(1.0, 1e-3)
    assert not np.array_equal(volts_of(converter), volts_of(converter, channel=Channel.STRUCTURE))


def test_what_is_beyond_the_range_is_clipped_and_said() -> None:
    converter = Converter(0.4, 0.0)
    counts, saturated = converter.convert(VOLTS, channel=Channel.MAGNITUDE, counter=0)
    assert saturated
    assert counts.max() == -counts.min() == 2**23 - 1
    _, saturated = converter.convert(VOLTS * 0.7, channel=Channel.MAGNITUDE, counter=0)
    assert not saturated

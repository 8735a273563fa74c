"""The converter: noise, drift, counts and clipping."""

from __future__ import annotations

import numpy as np
import pytest
from tactomo.twin.converter import Converter, Drift
from tactomo_models.arrays import FloatArray
from tactomo_protocol import Channel

STILL = Drift(walk=0.0, creep=0.0)
VOLTS = np.linspace(-0.5, 0.5, 208)


def volts_of(
    converter: Converter,
    counter: int = 0,
    time_s: float = 0.0,
    channel: Channel = Channel.MAGNITUDE,
) -> FloatArray:
    counts, _ = converter.convert(VOLTS, channel=channel, counter=counter, time_s=time_s)
    return np.asarray(counts * converter.volts_per_count)


def test_without_noise_and_drift_only_the_rounding_remains() -> None:
    converter = Converter(1.0, 0.0, STILL)
    assert np.max(np.abs(volts_of(converter) - VOLTS)) <= converter.volts_per_count / 2 * 1.000001


def test_noise_has_the_stated_size_on_every_measurement() -> None:
    converter = Converter(1.0, 1e-3, STILL)
    errors = np.array([volts_of(converter, counter) - VOLTS for counter in range(500)])
    assert np.std(errors) == pytest.approx(1e-3, rel=0.02)
    assert np.ptp(errors.std(axis=0)) < 4e-4
    assert abs(np.corrcoef(errors[:-1].ravel(), errors[1:].ravel())[0, 1]) < 0.02


def test_equal_seeds_give_equal_scans_in_any_order() -> None:
    def scans(seed: int, counters: list[int]) -> dict[int, list[float]]:
        converter = Converter(1.0, 1e-3, Drift(walk=1e-3, creep=0.1), seed)
        return {n: list(volts_of(converter, n, n * 10.0)) for n in counters}

    assert scans(7, [0, 50, 100]) == scans(7, [100, 0, 50])
    assert scans(7, [0]) != scans(8, [0])


def test_the_channels_have_noise_and_drift_of_their_own() -> None:
    converter = Converter(1.0, 1e-3, Drift(walk=1e-3, creep=0.0))
    assert not np.array_equal(volts_of(converter), volts_of(converter, channel=Channel.STRUCTURE))
    converter.noise_v = 0.0
    gains = [float(np.mean(volts_of(converter, 0, 500.0, c) / VOLTS)) for c in Channel]
    assert abs(gains[0] - gains[1]) > 1e-4


def test_creep_approaches_its_level() -> None:
    converter = Converter(1.0, 0.0, Drift(walk=0.0, creep=0.02, creep_s=10.0))
    gains = [float(np.mean(volts_of(converter, 0, t) / VOLTS)) for t in (0.0, 10.0, 1000.0)]
    assert gains == pytest.approx([1.0, 1.0 + 0.02 * (1 - np.exp(-1)), 1.02], abs=1e-5)


def test_the_walk_is_continuous_and_grows_with_the_root_of_time() -> None:
    drift = Drift(walk=1e-4, creep=0.0)
    ends = []
    for seed in range(200):
        converter = Converter(2.0, 0.0, drift, seed)
        ends.append(np.mean(volts_of(converter, 0, 400.0) / VOLTS) - 1.0)
    assert np.std(ends) == pytest.approx(1e-4 * 20.0, rel=0.2)
    converter = Converter(2.0, 0.0, drift)
    steps = np.diff([np.mean(volts_of(converter, 0, t) / VOLTS) for t in np.arange(0, 60, 0.05)])
    assert np.max(np.abs(steps)) < 1e-4


def test_what_is_beyond_the_range_is_clipped_and_said() -> None:
    converter = Converter(0.4, 0.0, STILL)
    counts, saturated = converter.convert(VOLTS, channel=Channel.MAGNITUDE, counter=0, time_s=0.0)
    assert saturated
    assert counts.max() == -counts.min() == 2**23 - 1
    _, saturated = converter.convert(VOLTS * 0.7, channel=Channel.MAGNITUDE, counter=0, time_s=0.0)
    assert not saturated

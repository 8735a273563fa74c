"""Scans that are earlier ones over again are told from scans that are like them by chance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tactomo_models import Reference, SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.scans.repeats import Repeats
from tactomo_protocol import Channel

NOISE, REST = 40.0, np.linspace(1e5, 1e6, 208)  # counts
rng = np.random.default_rng(8)


def live(noise: float = NOISE) -> FloatArray:
    return np.rint(REST + rng.normal(0, noise, len(REST)))


def share_that_repeats(paper: SensorDescription, scan: Callable[[int, FloatArray], object]) -> int:
    """Of 40 scans that follow on 20 of a tare; each is made of its number and the last good one."""
    at_rest = np.array([live() for _ in range(20)])
    reference, repeats = Reference.from_scans(at_rest, None), Repeats(paper.pairs)
    for each in at_rest:
        repeats.find(Channel.MAGNITUDE, each, reference)
    found = [
        repeats.find(Channel.MAGNITUDE, np.asarray(scan(n, at_rest[-1])), reference)
        for n in range(40)
    ]
    assert not any(each is not None and each.is_another for each in found), "no tare may take it"
    return sum(each is not None and bool(each.voltages.all()) for each in found)


def test_a_frozen_scan_whose_last_bits_flicker_repeats(paper: SensorDescription) -> None:
    def stuck(_: int, last: FloatArray) -> FloatArray:
        return last + rng.integers(-1, 2, len(last))

    assert share_that_repeats(paper, stuck) == 40


def test_a_round_of_old_scans_repeats(paper: SensorDescription) -> None:
    buffers = [live() for _ in range(12)]
    assert share_that_repeats(paper, lambda n, _: buffers[n % 12]) == 28


@pytest.mark.parametrize("noise", [NOISE, NOISE / 5])
def test_a_live_scan_does_not_repeat_though_its_noise_has_fallen(
    paper: SensorDescription, noise: float
) -> None:
    assert share_that_repeats(paper, lambda *_: live(noise)) == 0


@pytest.mark.filterwarnings("error")
def test_a_voltage_without_bounds_says_nothing(paper: SensorDescription) -> None:
    at_rest = np.array([live() for _ in range(20)])
    known = Reference.from_scans(at_rest, None)
    assert known.magnitude_noise is not None
    noise = np.where(np.arange(208) == 3, np.inf, known.magnitude_noise)
    reference, repeats = replace(known, magnitude_noise=noise), Repeats(paper.pairs)
    last = live()
    last[3] = np.inf
    repeats.find(Channel.MAGNITUDE, last, reference)
    found = repeats.find(Channel.MAGNITUDE, live(), reference)
    assert found is not None
    assert not found.voltages.any()


def test_a_skin_that_crept_at_its_tare_is_not_taken_for_frozen_afterwards(
    paper: SensorDescription,
) -> None:
    """What lies on a line was no noise; what its converter has beside the line is."""
    creeping = np.array([live() * (1 + 2e-4 * number) for number in range(20)])
    reference, repeats = Reference.from_scans(creeping, None), Repeats(paper.pairs)
    assert reference.magnitude_noise is not None
    assert np.median(reference.magnitude_noise) == pytest.approx(NOISE, rel=0.1)
    for _ in range(40):
        found = repeats.find(Channel.MAGNITUDE, live(), reference)
        assert found is None or not found.voltages.any()

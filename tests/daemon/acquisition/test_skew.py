"""How far the channels are apart, on scans of two boards whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest
from tactomo.acquisition.skew import Skew
from tactomo.scans import ChannelScan, DualScan
from tactomo_protocol import Channel, ScanFlag

PERIOD_NS = 50_000_000
MAGNITUDE, STRUCTURE = Channel.MAGNITUDE, Channel.STRUCTURE


def scan(
    channel: Channel,
    counter: int,
    acquired_ns: int,
    port: int = 0,
    delay_ns: int | None = 0,
    device_us: int | None = None,
) -> ChannelScan:
    arrived_ns = acquired_ns + (delay_ns or 0)
    us = acquired_ns // 1000 if device_us is None else device_us
    times = (arrived_ns, arrived_ns, arrived_ns)
    return ChannelScan(channel, counter, us, ScanFlag(0), np.zeros(1), *times, 0, port, delay_ns)


def pairs(
    skew: Skew,
    count: int,
    behind: int = 0,
    late_ns: int = 0,
    port: int = 1,
    delay_ns: int | None = 0,
    start: int = 0,
) -> DualScan:
    """Let both channels scan; the structure's counter is `behind`. Return the last pair."""
    for number in range(start, start + count):
        at_ns = 10**12 + number * PERIOD_NS
        magnitude = scan(MAGNITUDE, number % 2**32, at_ns, 0, delay_ns)
        structure = scan(STRUCTURE, (number - behind) % 2**32, at_ns + late_ns, port, delay_ns)
        skew.take(magnitude)
        skew.take(structure)
    return DualScan(number, magnitude, structure)


def test_the_skew_is_the_difference_of_the_dates_with_its_sign() -> None:
    skew = Skew()
    timing = skew.timing(pairs(skew, 20, late_ns=3_000_000))
    assert timing.skew_ns == -3_000_000
    assert timing.is_dated
    assert not timing.is_skewed
    assert timing.delay_ns == 3_000_000  # as old as the older one
    skew.note(timing)
    percentiles = skew.sizes.percentiles_ms()
    assert percentiles is not None
    assert percentiles["p50"] == pytest.approx(3.0)


@pytest.mark.parametrize("behind", [-40, -1, 1, 3, 1_000_000])
@pytest.mark.parametrize("start", [0, 2**32 - 12])
def test_a_board_that_missed_pulses_is_noticed_and_forgiven_once_cured(
    behind: int, start: int
) -> None:
    skew = Skew()
    pairs(skew, 20, start=start)
    assert not skew.is_skewed
    pairs(skew, 10, behind=behind, start=start + 20)
    assert skew.is_skewed
    assert abs(skew.out_of_step_ns) == pytest.approx(abs(behind) * PERIOD_NS, rel=1e-3)
    assert skew.timing(pairs(skew, 1, behind, start=start + 30)).is_skewed
    pairs(skew, 10, start=start + 31)
    assert not skew.is_skewed


def test_a_pair_too_far_apart_is_flagged_at_once() -> None:
    skew = Skew()
    pairs(skew, 20)
    last = scan(MAGNITUDE, 20, 10**12 + 20 * PERIOD_NS)
    other = scan(STRUCTURE, 20, 10**12 + 20 * PERIOD_NS + PERIOD_NS * 6 // 10, port=1)
    assert skew.timing(DualScan(20, last, other)).is_skewed
    assert not skew.is_skewed


def test_lags_bursts_and_a_silent_channel_are_no_skew() -> None:
    """Structure scans come five at once, then not at all for a minute, then again."""
    skew = Skew()
    structures = []
    for number in range(2000):
        at_ns = 10**12 + number * PERIOD_NS
        skew.take(scan(MAGNITUDE, number, at_ns))
        if not 500 <= number < 1700:
            structures.append(scan(STRUCTURE, number, at_ns, 1, 200_000_000))
        if number % 5 == 4:
            for structure in structures:
                skew.take(structure)
            structures.clear()
        assert not skew.is_skewed


def test_an_overload_that_holds_boards_up_by_more_or_less_is_no_missed_pulse() -> None:
    """A board that waits for its line before it reads its clock, at 300 scans a second."""
    skew, rng = Skew(), np.random.default_rng(3)
    for number in range(600):
        at_ns = 10**12 + number * PERIOD_NS // 15
        skew.take(scan(MAGNITUDE, number, at_ns))
        skew.take(scan(STRUCTURE, number, at_ns + int(rng.uniform(0, 60_000_000)), 1))
        assert not skew.is_skewed

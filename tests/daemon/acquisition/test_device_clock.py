"""The device's clock against the computer's, on simulated arrivals whose truth is known."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tactomo.acquisition.device_clock import ClockState, DeviceClock
from tactomo_protocol import Channel

BOOT_NS = 10**15
MIN_S = 1e-3
MAGNITUDE = Channel.MAGNITUDE

Delay = Callable[[random.Random, float], float]
Clock = Callable[[float], float]


def waits(mean_s: float) -> Delay:
    """A busy line: most scans come soon, a few late."""
    return lambda rng, _: rng.expovariate(1 / mean_s)


def held_for_16_ms(rng: random.Random, at_s: float) -> float:
    """An FTDI adapter's latency timer, and a busy computer behind it."""
    return -at_s % 0.016 + rng.expovariate(1 / 0.5e-3)


def warming_up(at_s: float) -> float:
    """A crystal: 150 ppm slow at first, right after an hour."""
    return at_s - 150e-6 * (at_s - at_s**2 / 7200)


def right(at_s: float) -> float:
    return at_s


@dataclass
class Seen:
    """What came of simulated arrivals."""

    clock: DeviceClock
    times_s: list[float] = field(default_factory=list)
    errors_ms: list[float] = field(default_factory=list)
    """Of the dated ones: acquired as told, less the truth and the least delay."""
    undated_s: list[float] = field(default_factory=list)

    def within_ms(self, share: float) -> float:
        """Return the bound that so many keep, once the rate is more than a first guess."""
        known = np.array(self.times_s) > 30
        return float(np.quantile(np.abs(self.errors_ms)[known], share))


def arrivals(
    seconds: float,
    rate_hz: float = 19.3,
    delay: Delay | None = None,
    device_s: Clock = right,
    stall_s: tuple[float, float] = (0.0, 0.0),
    device_us: Callable[[int], int] = lambda us: us,
) -> Seen:
    """Let scans come; those that would between `stall_s` come at its end, all at once."""
    rng = random.Random(7)
    delay = delay or waits(2e-3)
    seen = Seen(DeviceClock())
    last_s = 0.0
    for number in range(1, int(seconds * rate_hz)):
        at_s = number / rate_hz
        came_s = at_s + MIN_S + delay(rng, at_s)
        if stall_s[0] < came_s < stall_s[1]:
            came_s = stall_s[1]
        last_s = came_s = max(came_s, last_s)
        ticks = device_us(int(device_s(at_s) * 1e6))
        late_ns = seen.clock.date(MAGNITUDE, ticks, BOOT_NS + round(came_s * 1e9))
        if late_ns is None:
            seen.undated_s.append(at_s)
        else:
            assert late_ns >= 0
            seen.times_s.append(at_s)
            seen.errors_ms.append((came_s - late_ns * 1e-9 - at_s - MIN_S) * 1e3)
    return seen


@pytest.mark.parametrize(
    ("delay", "rate_hz", "bound_ms"),
    [
        (waits(2e-3), 19.3, 1.0),
        (held_for_16_ms, 4.9, 2.0),  # a scan in step with the timer now and then is all there is
        (held_for_16_ms, 97.0, 1.0),
    ],
)
def test_a_crystal_that_warms_up_is_followed_for_an_hour(
    delay: Delay, rate_hz: float, bound_ms: float
) -> None:
    seen = arrivals(3600 if rate_hz < 90 else 600, rate_hz, delay, warming_up)
    assert seen.clock.state is ClockState.SETTLED
    assert seen.clock.jumps == 0
    assert len(seen.undated_s) < 16 * rate_hz
    assert seen.within_ms(0.999) < bound_ms
    assert max(np.abs(seen.errors_ms)) < 3.0  # from the first one on


def test_the_rate_and_the_offset_are_told() -> None:
    seen = arrivals(300, device_s=lambda at_s: 123.0 + at_s * (1 - 80e-6))
    line = seen.clock.line
    assert line is not None
    assert line.rate == pytest.approx(80e-6, abs=5e-6)
    assert line.lag_ns - BOOT_NS + 123e9 == pytest.approx(300 * 80e-6 * 1e9 + 1e6, abs=1e6)
    percentiles = seen.clock.delays.percentiles_ms()
    assert percentiles is not None
    assert percentiles["p50"] == pytest.approx(2 * math.log(2), rel=0.4)


@pytest.mark.parametrize("length_s", [2.0, 60.0])
def test_what_a_stall_held_up_is_as_old_as_it_is(length_s: float) -> None:
    seen = arrivals(400, stall_s=(200.0, 200.0 + length_s), device_s=warming_up)
    assert seen.clock.jumps == 0
    assert seen.within_ms(1.0) < 1.0


def test_a_stall_while_the_clock_is_not_known_yet_does_no_harm() -> None:
    seen = arrivals(60, stall_s=(4.0, 6.0))
    assert seen.within_ms(1.0) < 1.0
    assert max(np.abs(seen.errors_ms)) < 3.0


def test_a_backlog_that_stays_is_not_taken_for_the_least_delay() -> None:
    """Half a second of data waits in the device for ten minutes: longer than the fit looks back."""

    def backlog(rng: random.Random, at_s: float) -> float:
        return rng.expovariate(1 / 2e-3) + (0.5 if 200 < at_s < 800 else 0.0)

    seen = arrivals(900, delay=backlog)
    assert max(seen.errors_ms) < 40.0  # of 500


@pytest.mark.parametrize("jump_us", [300_000, 4_000, -300_000])
def test_one_scan_that_seems_early_or_old_moves_nothing(jump_us: int) -> None:
    def jumpy(device_us: int) -> int:
        return device_us + (jump_us if 200_000_000 <= device_us < 200_050_000 else 0)

    seen = arrivals(300, device_us=jumpy)
    assert seen.clock.jumps == 0
    assert len([at_s for at_s in seen.undated_s if at_s > 100]) <= 1
    assert seen.within_ms(1.0) < 1.0


@pytest.mark.parametrize(
    "jump",
    [
        lambda us: us % 200_000_000,  # a reset
        lambda us: (us + 2**32 - 200_000_000) % 2**32,  # 32 bits, never extended
        lambda us: us + (us >= 200_000_000) * 3_600_000_000,  # the computer slept for an hour
        lambda us: us + (us >= 200_000_000) * 80_000,
        lambda us: us - (us >= 200_000_000) * 3_000_000,
    ],
    ids=["reset", "wrap", "suspended", "ahead by 80 ms", "back by 3 s"],
)
def test_a_clock_that_jumps_is_known_again_soon(jump: Callable[[int], int]) -> None:
    seen = arrivals(390, device_us=jump)
    assert seen.clock.jumps == 1
    after = [at_s for at_s in seen.undated_s if at_s > 100]
    assert 200 <= after[0] < after[-1] < 217
    assert seen.within_ms(1.0) < 1.0


def test_a_clock_that_paused_is_known_again() -> None:
    """It stood still for five seconds, as in a debugger; meanwhile no scan came."""
    seen = Seen(DeviceClock())
    rng = random.Random(1)
    for number in range(8000):
        at_s = number / 20
        came_s = at_s + rng.expovariate(1 / 2e-3) + (5.0 if at_s > 200 else 0.0)
        late_ns = seen.clock.date(MAGNITUDE, round(at_s * 1e6), BOOT_NS + round(came_s * 1e9))
    assert seen.clock.jumps == 1
    assert late_ns is not None
    assert late_ns < 30e6


@pytest.mark.parametrize(
    "device_us",
    [
        lambda _: 0,
        lambda _: 77,
        lambda us: us // 1000,
        lambda us: us * 2,
        lambda us: us * 1002 // 1000,
    ],
    ids=["zero", "still", "milliseconds", "double", "2000 ppm"],
)
def test_a_clock_that_is_none_is_found_out(device_us: Callable[[int], int]) -> None:
    seen = arrivals(400, device_us=device_us)
    assert seen.clock.state is ClockState.UNUSABLE
    assert seen.clock.line is None
    # One that is only slightly off is believed for two minutes; it is wrong by little then.
    assert max(np.abs(seen.errors_ms), default=0.0) < 10.0
    assert not [at_s for at_s in seen.times_s if at_s > 130]


def test_a_clock_that_stops_is_found_out_within_seconds() -> None:
    seen = arrivals(400, device_us=lambda us: min(us, 200_000_000))
    assert seen.clock.state is ClockState.UNUSABLE
    assert max(seen.times_s) < 212
    assert max(seen.errors_ms) < 1.0  # meanwhile older than it is, never younger


def test_a_year_of_microseconds_is_as_good_as_a_minute() -> None:
    year_us = 365 * 24 * 3600 * 10**6
    seen = arrivals(200, device_us=lambda us: 2**64 - year_us + us)
    assert seen.within_ms(1.0) < 1.0


@given(
    st.lists(
        st.tuples(st.integers(0, 2**64 - 1), st.integers(0, 4_000_000_000)), min_size=1, max_size=80
    )
)
def test_whatever_a_device_says_nothing_is_acquired_after_it_came(
    scans: list[tuple[int, int]],
) -> None:
    clock = DeviceClock()
    now_ns = 0
    for device_us, after_ns in scans:
        now_ns += after_ns
        late_ns = clock.date(MAGNITUDE, device_us, now_ns)
        assert late_ns is None or late_ns >= 0


@pytest.mark.parametrize("apart_us", [20_000_000, 3_600_000_000, 2**52])
def test_a_channel_by_another_clock_is_not_dated_and_told(apart_us: int) -> None:
    clock = DeviceClock()
    for n in range(1000):
        arrived_ns = BOOT_NS + n * 50_000_000
        clock.date(MAGNITUDE, apart_us + n * 50_000, arrived_ns)
        assert clock.date(Channel.STRUCTURE, n * 50_000, arrived_ns) is None
    assert clock.state is ClockState.UNUSABLE
    assert clock.line is None


def test_channels_in_either_order_and_gaps_are_of_one_clock() -> None:
    clock = DeviceClock()
    at_us = 0
    for n in range(1000):
        at_us += 50_000 if n % 100 else 40_000_000
        arrived_ns = BOOT_NS + at_us * 1000
        for channel in list(Channel)[:: 1 if n % 3 else -1]:
            own_us = at_us - (20_000 if channel is MAGNITUDE else 0)
            clock.date(channel, own_us, arrived_ns)
    assert clock.state is ClockState.SETTLED

"""Joining scans by counter, whatever order they come in."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tactomo.acquisition.scan_pairer import CounterPairer
from tactomo.scans import ChannelScan, DualScan
from tactomo_protocol import Channel, ScanFlag

WAIT_NS = 30_000_000
BOTH = (Channel.MAGNITUDE, Channel.STRUCTURE)


def scan(channel: Channel, counter: int, clock_ns: int, device_us: int = 0) -> ChannelScan:
    return ChannelScan(
        channel, counter, device_us, ScanFlag(0), np.zeros(1), clock_ns, clock_ns, clock_ns, 0
    )


# What happens on the wire: which channel speaks, how far its counter moves (0 repeats it, negative
# numbers are a restart), how long after the event before, and what its device's clock says.
arrivals = st.lists(
    st.tuples(
        st.sampled_from(BOTH),
        st.integers(-20, 3) | st.sampled_from([2**31, 2**31 - 1]),
        st.integers(0, 2_000_000_000) | st.integers(0, 40_000_000),
        st.integers(0, 5_000_000),
    ),
    max_size=60,
)


@given(arrivals, st.integers(0, 2**32 - 1))
def test_every_scan_is_joined_sent_alone_or_counted_once(
    steps: list[tuple[Channel, int, int, int]], start: int
) -> None:
    sync = CounterPairer(BOTH, WAIT_NS)
    counters = dict.fromkeys(BOTH, start)
    pushed: list[ChannelScan] = []
    sent: list[DualScan] = []
    now_ns = 0
    for channel, move, after_ns, device_us in steps:
        now_ns += after_ns
        counters[channel] = (counters[channel] + move) % 2**32
        sent += sync.advance(now_ns)
        pushed.append(scan(channel, counters[channel], now_ns, device_us))
        sent += sync.push(pushed[-1])
        assert sync.deadline_ns is None or sync.deadline_ns <= now_ns + WAIT_NS
        told = sum(len(dual.scans) for dual in sent)
        assert told + sync.late + sync.repeated + len(sync._waiting) == len(pushed)
    sent += sync.finish()

    out = [id(single) for dual in sent for single in dual.scans]
    assert max(Counter(out).values(), default=1) == 1
    assert set(out) <= {id(single) for single in pushed}
    assert len(out) + sync.late + sync.repeated == len(pushed)
    for dual in sent:
        assert {single.counter for single in dual.scans} == {dual.counter}


class Instant(NamedTuple):
    """One dual scan as it was taken, and what becomes of each channel's scan of it."""

    magnitude_lag: float | None
    """Share of the wait by which it comes late; None: it is lost on the way."""
    structure_lag: float | None
    is_repeated: bool


def lag() -> st.SearchStrategy[float | None]:
    return st.floats(0, 0.99) | st.just(0.0) | st.none()


instants = st.lists(st.builds(Instant, lag(), lag(), st.booleans()), max_size=40)
PERIODS_NS = st.sampled_from([2_000_000, 10_000_000, 50_000_000])


@given(instants, PERIODS_NS, st.sampled_from([0, 5, 2**32 - 7]), st.integers(1, 40) | st.none())
def test_lags_skips_and_repeats_lose_no_pair_and_make_no_wrong_one(
    taken: list[Instant], period_ns: int, start: int, zero_at: int | None
) -> None:
    """Two ports that each keep their order; how far one lags changes all the time."""
    arriving: list[tuple[int, ChannelScan, int]] = []  # when, what, of which instant
    counter = start
    taken[:1] = [Instant(0.0, 0.0, False) for _ in taken[:1]]  # both channels are heard of
    if zero_at is not None and zero_at < len(taken):
        # Both are heard to begin anew, from a counter heard just before: one that missed the wrap
        # at 2^32 right before it is zeroed sees no step back, and no counter could tell it.
        for near in (zero_at - 1, zero_at):
            taken[near] = Instant(taken[near][0] or 0.0, taken[near][1] or 0.0, False)
    for number, instant in enumerate(taken):
        counter = 0 if number == zero_at else (counter + 1) % 2**32
        for channel, share in zip(BOTH, instant[:2], strict=True):
            if share is None:
                continue
            before = [when for when, one, _ in arriving if one.channel == channel]
            at_ns = max([number * period_ns + int(share * WAIT_NS), *before[-1:]])
            one = scan(channel, counter, at_ns, 10**9 + number * period_ns // 1000)
            arriving.append((at_ns, one, number))
            if instant.is_repeated:
                again = scan(channel, counter, at_ns, one.device_us)
                arriving.append((at_ns, again, number))
    arriving.sort(key=lambda arrival: arrival[0])
    number_of = {id(one): number for _, one, number in arriving}

    sync = CounterPairer(BOTH, WAIT_NS)
    sent: list[DualScan] = []
    for now_ns, one, _ in arriving:
        sent += sync.advance(now_ns)
        sent += sync.push(one)
    sent += sync.finish()

    for dual in sent:
        assert len({number_of[id(one)] for one in dual.scans}) == 1
    order = [number_of[id(dual.scans[0])] for dual in sent]
    assert len(order) == len(set(order))
    assert order == sorted(order)
    assert sync.repeated == sum(i.is_repeated * (2 - i[:2].count(None)) for i in taken)
    assert sync.resets == 0
    assert sync.late == 0
    assert [len(dual.scans) for dual in sent] == [
        2 - instant[:2].count(None) for instant in taken if instant[:2] != (None, None)
    ]


def feed(sync: CounterPairer, *scans: ChannelScan) -> list[list[int]]:
    """Push scans and return the counters of what comes of them, one list for each dual scan."""
    sent: list[DualScan] = []
    for one in scans:
        sent += sync.advance(one.clock_ns) + sync.push(one)
    return [[one.counter for one in dual.scans] for dual in sent]


def test_counters_that_are_zeroed_while_one_port_lags_stay_paired() -> None:
    """The magnitude port is three scans ahead; old counters are joined with old ones."""
    counters = (1004, 1005, 0, 1)
    us = range(10**9, 10**9 + 4)
    magnitudes = [scan(BOTH[0], n, 1000 * k, us[k]) for k, n in enumerate(counters)]
    structures = [scan(BOTH[1], n, 9000 + k, us[k]) for k, n in enumerate(counters)]
    sync = CounterPairer(BOTH, WAIT_NS)
    feed(sync, *(scan(channel, 1003, 0, 10**9 - 1) for channel in BOTH))
    assert feed(sync, *magnitudes, *structures) == [[n, n] for n in counters]
    assert sync.zeroed == 2
    assert sync.resets == 0


@pytest.mark.parametrize(("old", "repeated"), [(7, 1), (6, 0)])
def test_an_old_scan_is_no_restart_but_a_repetition_or_late(old: int, repeated: int) -> None:
    sync = CounterPairer(BOTH, WAIT_NS)
    told = [scan(BOTH[0], n, n, n * 50_000) for n in (7, 8, old, 9)]
    feed(sync, *told)
    assert (sync.repeated, sync.late, sync.resets, sync.zeroed) == (repeated, 1 - repeated, 0, 0)
    assert sync.disordered == sync.late


@pytest.mark.parametrize("jitter_ns", [0, 7_000_000])
def test_a_channel_about_as_late_as_the_wait_is_lost_once(jitter_ns: int) -> None:
    """33 ms behind, or 29.5 to 36.5, where 30 are waited for: it does not flap."""
    sync, rng, changes = CounterPairer(BOTH, 30_000_000), np.random.default_rng(0), 0
    events = []
    for n in range(2000):
        at_ns = n * 50_000_000
        late_ns = at_ns + 33_000_000 + int(rng.uniform(-jitter_ns / 2, jitter_ns / 2))
        events.append(scan(BOTH[0], n, at_ns, n * 50_000))
        events.append(scan(BOTH[1], n, late_ns, n * 50_000))
    for each in sorted(events, key=lambda event: event.clock_ns):
        before = set(sync.lost)
        sync.advance(each.clock_ns)
        sync.push(each)
        changes += before != sync.lost
    assert sync.lost == {BOTH[1]}
    assert changes == 1


def test_a_sensor_of_one_channel_is_told_no_scan_twice() -> None:
    sync = CounterPairer(BOTH[:1], WAIT_NS)
    told = [scan(BOTH[0], n, n, n * 50_000) for n in (7, 7, 8)]
    assert feed(sync, *told) == [[7], [8]]
    assert sync.repeated == 1


def test_a_scan_waits_for_its_partner_until_the_deadline() -> None:
    sync = CounterPairer(BOTH, wait_ns=30)
    assert sync.deadline_ns is None
    assert sync.push(scan(Channel.MAGNITUDE, 1, 1_000)) == []
    assert sync.deadline_ns == 1_030
    assert sync.advance(1_029) == []
    assert [dual.counter for dual in sync.advance(1_030)] == [1]
    assert sync.deadline_ns is None

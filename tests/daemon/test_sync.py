"""Joining scans by counter, whatever order they come in."""

from __future__ import annotations

from collections import Counter

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from tactomo.port import ChannelScan
from tactomo.sync import DualScan, Sync
from tactomo_protocol import Channel, ScanFlag

WAIT_NS = 30_000_000
BOTH = (Channel.MAGNITUDE, Channel.STRUCTURE)


def scan(channel: Channel, counter: int, clock_ns: int) -> ChannelScan:
    return ChannelScan(
        channel, counter, 0, ScanFlag(0), np.zeros(1), clock_ns, clock_ns, clock_ns, 0
    )


# What happens on the wire: which channel speaks, how far its counter moves (0 repeats it, negative
# numbers are a restart), and how long after the event before.
arrivals = st.lists(
    st.tuples(
        st.sampled_from(BOTH),
        st.integers(-20, 3),
        st.integers(0, 2_000_000_000) | st.integers(0, 40_000_000),
    ),
    max_size=60,
)


@given(arrivals, st.integers(0, 2**32 - 1))
def test_every_scan_is_joined_sent_alone_or_counted_late_once(
    steps: list[tuple[Channel, int, int]], start: int
) -> None:
    sync = Sync(BOTH, WAIT_NS)
    counters = dict.fromkeys(BOTH, start)
    pushed: list[ChannelScan] = []
    sent: list[DualScan] = []
    now_ns = 0
    for channel, move, after_ns in steps:
        now_ns += after_ns
        counters[channel] = (counters[channel] + move) % 2**32
        sent += sync.advance(now_ns)
        pushed.append(scan(channel, counters[channel], now_ns))
        sent += sync.push(pushed[-1])
        assert sync.deadline_ns is None or sync.deadline_ns <= now_ns + WAIT_NS
    sent += sync.finish()

    out = [id(single) for dual in sent for single in dual.scans]
    assert max(Counter(out).values(), default=1) == 1
    assert set(out) <= {id(single) for single in pushed}
    assert len(out) + sync.late == len(pushed)
    for dual in sent:
        assert {single.counter for single in dual.scans} == {dual.counter}


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.booleans()), max_size=60))
def test_what_comes_in_time_is_joined_and_stays_in_order(
    instants: list[tuple[bool, bool, bool]],
) -> None:
    """Each instant, either channel may be lost on the way and either may come first."""
    sync = Sync(BOTH, WAIT_NS)
    sent: list[DualScan] = []
    for counter, (has_magnitude, has_structure, magnitude_first) in enumerate(instants):
        now_ns = counter * 50_000_000
        sent += sync.advance(now_ns)
        present = [
            c for c, there in zip(BOTH, (has_magnitude, has_structure), strict=True) if there
        ]
        for channel in present if magnitude_first else reversed(present):
            sent += sync.push(scan(channel, counter, now_ns))
    sent += sync.finish()

    assert [dual.counter for dual in sent] == [
        counter for counter, (m, s, _) in enumerate(instants) if m or s
    ]
    # Those whose channels were both there before are joined; a lost channel may cost one pair.
    joined = sum(len(dual.scans) == 2 for dual in sent)
    whole = sum(m and s for m, s, _ in instants)
    assert whole - sync.late == joined

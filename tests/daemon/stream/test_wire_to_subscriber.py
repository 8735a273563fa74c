"""Whatever a board says in packets whose checksums are right, what is published keeps to STREAM.md.

The whole way in one: a real pseudo-terminal, the real reconstructor, a subscriber that holds each
message against the page. `make faults` plays an hour of it (`hostile_board`).
"""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import Any, cast

import pytest
from daemon_bench import HELLO, Memory, scan
from fixture_types import Start
from hostile_board import EDGES_F64, EDGES_U32, EDGES_U64, content_of, framed
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stream_rules import Subscriber
from tactomo_protocol import Channel

U32 = st.sampled_from(EDGES_U32) | st.integers(0, 2**32 - 1)
U64 = st.sampled_from(EDGES_U64) | st.integers(0, 2**64 - 1)
F64 = st.sampled_from(EDGES_F64) | st.floats()


@st.composite
def headers(draw: st.DrawFn) -> bytes:
    """A scan of the bench's sensor with any header before its samples."""
    content = content_of(scan(draw(st.sampled_from(Channel)), 1))
    head = struct.pack("<BIQ", draw(st.integers(0, 255)), draw(U32), draw(U64))
    return framed(content[:3] + head + content[16:])


@st.composite
def hellos(draw: st.DrawFn) -> bytes:
    """The bench's hello with any scale and rate."""
    content = content_of(HELLO)
    return framed(content[:8] + struct.pack("<dd", draw(F64), draw(F64)) + content[24:])


@st.composite
def samples(draw: st.DrawFn) -> bytes:
    """A scan of floats of any bits."""
    content = content_of(scan(draw(st.sampled_from(Channel)), draw(U32)))
    bits = draw(st.lists(st.integers(0, 2**32 - 1), min_size=208, max_size=208))
    return framed(content[:16] + b"\3" + content[17:20] + struct.pack("<208I", *bits))


@pytest.mark.slow
def test_no_packet_ends_the_publisher_or_breaks_the_stream(bench: Start) -> None:
    b = bench(real=True, sync_wait_ms=500).tare()
    line = b.skin.lines[0]
    with Subscriber(b.daemon.stream_address) as subscriber:

        @settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
        @given(st.lists(headers() | hellos() | samples(), min_size=1, max_size=6))
        def say(frames: list[bytes]) -> None:
            taken = b.ask("status")["ports"][0]["bytes"] + sum(map(len, frames))
            line.say(*frames)
            b.until(lambda: b.ask("status")["ports"][0]["bytes"] >= taken)

        say()
        line.say(HELLO)
        b.until(lambda: b.skin.scan() and runs(b))
        assert subscriber.messages["map"]
    assert subscriber.faults == []


def runs(b: Any) -> bool:
    return bool(b.ask("status")["state"] == "running")


@pytest.mark.parametrize("late_us", [2**53 - 1, 2**62])
def test_the_largest_clock_goes_through_to_the_subscriber(bench: Start, late_us: int) -> None:
    """Beyond 2^53 the packet breaks PROTOCOL.md; up to it, every value derived of it fits."""
    b = bench().tare()
    b.skin.counter += 1
    for channel in Channel:
        content = content_of(scan(channel, b.skin.counter))
        b.skin.lines[0].say(framed(content[:8] + struct.pack("<Q", late_us) + content[16:]))
    if late_us < 2**53:
        assert b.listener.frame(b.skin.counter)["device_us"] == late_us
    b.until(lambda: b.ask("status")["ports"][0]["faulty"] == (0 if late_us < 2**53 else 2))
    assert b.step()


@pytest.mark.slow
def test_a_message_that_cannot_be_sent_is_left_out_and_told(
    bench: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    proper, no_text = Memory._result, cast("str", 7)
    b = bench().tare()
    monkeypatch.setattr(Memory, "_result", lambda *given: replace(proper(*given), reason=no_text))
    b.skin.scan()
    told = b.listener.event("message_unsent")
    assert "tier_reason" in told["detail"]
    monkeypatch.setattr(Memory, "_result", proper)
    assert b.step()
    b.listener.wait("status", lambda status: status["tier"] == "tikhonov")

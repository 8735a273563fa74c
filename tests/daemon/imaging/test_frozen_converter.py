"""Scans that repeat earlier ones were not measured: the channel is missing, and told."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from daemon_bench import BOTH, REST, scan
from fixture_types import Start
from tactomo_protocol import Channel


def freeze(b: Any, frozen: tuple[Channel, ...], load: float) -> dict[str, Any]:
    """Send a dual scan whose frozen channels read what they read at the start."""
    b.skin.counter += 1
    for channel in BOTH:
        fresh = scan(channel, b.skin.counter, REST * (1 + load))
        stuck = replace(scan(channel, 1), counter=fresh.counter, device_us=fresh.device_us)
        b.skin.line_of(channel).say(stuck if channel in frozen else fresh)
    frame: dict[str, Any] = b.listener.frame(b.skin.counter)
    return frame


@pytest.mark.parametrize("frozen", [(Channel.MAGNITUDE,), (Channel.STRUCTURE,), BOTH])
def test_a_frozen_channel_is_missing_and_told(bench: Start, frozen: tuple[Channel, ...]) -> None:
    b = bench(ports=2, lossless=True).tare()
    freeze(b, frozen, 0.1)  # the first one repeats nothing
    flags = {f"{channel}_missing" for channel in frozen}
    for _ in range(3):
        frame = freeze(b, frozen, 0.1)
        assert flags <= set(frame["flags"])
    for channel in frozen:
        told = b.listener.wait("event", lambda e, c=channel: e["detail"].startswith(str(c)))
        assert told["name"] == "converter_frozen"
        assert told["next_step"]
    assert b.step(0.1)["flags"] == []
    b.listener.event("converter_back")
    names = [event["name"] for event in b.listener.of("event")]
    assert names.count("converter_frozen") == len(frozen)


def test_a_round_of_buffers_that_are_sent_again_is_no_measurement(bench: Start) -> None:
    b = bench(ports=2, lossless=True).tare()
    for number in range(9):
        b.skin.counter += 1
        for channel in BOTH:
            fresh = scan(channel, b.skin.counter, REST * 1.1)
            old = replace(scan(channel, number % 3), counter=fresh.counter)
            b.skin.line_of(channel).say(replace(old, device_us=fresh.device_us))
        frame = b.listener.frame(b.skin.counter)
        assert number < 3 or {"magnitude_missing", "structure_missing"} <= set(frame["flags"])
    assert b.step(0.1)["flags"] == []


def test_a_tare_ends_what_a_tare_amid_interference_began(bench: Start) -> None:
    """Scans with a hundredth of the noise of the tare are no measurement until the next tare."""
    b = bench(ports=2, lossless=True).tare()
    rng = np.random.default_rng(8)

    def tare(noise_v: float) -> None:
        with ThreadPoolExecutor(1) as terminal:
            answer = terminal.submit(b.ask, "tare")
            while not answer.done():
                b.step(volts={c: REST + rng.normal(0, noise_v, len(REST)) for c in BOTH})
            answer.result()

    tare(5e-4)
    for _ in range(3):
        frame = b.step()
    assert {"magnitude_missing", "structure_missing"} <= set(frame["flags"])
    tare(2e-6)
    assert b.step()["flags"] == []


def test_drives_that_repeat_are_left_out_and_the_rest_is_imaged(bench: Start) -> None:
    b = bench(ports=2, lossless=True).tare()
    stuck = replace(scan(Channel.STRUCTURE, 1), counter=0).samples
    for _ in range(3):
        b.skin.counter += 1
        for channel in BOTH:
            fresh = scan(channel, b.skin.counter, REST)
            half = len(stuck) // 2  # scans are drive-major
            samples = np.concatenate([stuck[:half], fresh.samples[half:]])
            is_stuck = channel == Channel.STRUCTURE
            b.skin.line_of(channel).say(replace(fresh, samples=samples) if is_stuck else fresh)
        frame = b.listener.frame(b.skin.counter)
    assert "invalid_voltage" in frame["flags"]
    assert "structure_missing" not in frame["flags"]
    told = b.listener.event("converter_frozen")
    assert "drive 0-1" in told["detail"]
    assert "drive 8-9" not in told["detail"]
    assert b.step(0.0)["flags"] == []

"""Two channels on one port or two: joined by counter, never waited for too long."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fixture_types import Start
from tactomo_client.messages import array_from_wire
from tactomo_protocol import Channel, SampleFormat, Scan, ScanFlag
from waiting import PATIENCE_S


@pytest.mark.parametrize(
    ("present", "flag"),
    [(Channel.MAGNITUDE, "structure_missing"), (Channel.STRUCTURE, "magnitude_missing")],
)
def test_one_channel_missing_is_flagged_and_the_maps_go_on(
    bench: Start, present: Channel, flag: str
) -> None:
    b = bench(ports=2, lossless=True).tare()
    alone = b.skin.scan(load=0.1, channels=(present,))
    assert b.step()["flags"] == []  # both again: what waited for a partner waited in vain
    frame = b.listener.frame(alone)
    assert frame["flags"] == [flag]
    assert array_from_wire(frame["map"])[0, 0] == pytest.approx(0.1, abs=1e-3)
    assert b.ask("status")["incomplete_scans"] == 1


@pytest.mark.slow
def test_a_channel_that_stays_out_is_lost_and_comes_back(bench: Start) -> None:
    # A wait that would be noticed if every frame had to pay for it.
    b = bench(ports=2, sync_wait_ms=800).tare()
    while not any(e["name"] == "channel_lost" for e in b.listener.of("event")):
        b.step(channels=(Channel.MAGNITUDE,))
    b.until(lambda: b.step(channels=(Channel.MAGNITUDE,))["age_ns"] < 750e6)  # waited for no more
    # The first pair is what shows that the channel is back: it may still be sent on alone.
    b.step()
    b.listener.event("channel_back")
    b.until(lambda: b.step()["flags"] == [])  # a busy computer may tear one of them apart


def test_a_channel_that_comes_after_the_tare_says_that_it_has_no_reference(bench: Start) -> None:
    b = bench(ports=1)
    (line,) = b.skin.lines
    both = line.hello
    line.hello = replace(both, channels=(Channel.MAGNITUDE,))
    b.skin.introduce()  # nobody announces the structure channel, so nobody waits for it
    b.until(lambda: all(port["device"] for port in b.ask("status")["ports"]))
    for _ in range(3):
        b.step(channels=(Channel.MAGNITUDE,))
    b.listener.event("tared")
    line.hello = both
    line.say(both)
    b.step(channels=(Channel.STRUCTURE, Channel.MAGNITUDE))
    assert b.listener.event("channel_back")["next_step"].startswith("run `tactomo tare`")


def test_a_scan_that_comes_too_late_is_counted_and_left_out(bench: Start) -> None:
    b = bench(ports=2, sync_wait_ms=20).tare()
    before = b.ask("status")["late_scans"]  # of pairs that a busy computer tore apart
    counter = b.skin.counter + 1
    assert b.step(channels=(Channel.MAGNITUDE,))["flags"] == ["structure_missing"]
    b.skin.scan(channels=(Channel.STRUCTURE,), counter=counter)
    b.until(lambda: b.ask("status")["late_scans"] > before)
    assert b.ask("status")["late_scans"] == before + 1
    assert [f["scan_counter"] for f in b.listener.of("map")].count(counter) == 1


def test_counters_that_start_again_are_followed(bench: Start) -> None:
    b = bench(ports=2)
    b.skin.counter = 1000
    b.tare()
    b.step()
    b.step(counter=0, device_us=0)
    b.listener.event("device_restarted")
    assert b.step(load=0.1)["flags"] == []


def test_counters_wrap_after_32_bits(bench: Start) -> None:
    b = bench()
    b.skin.counter = 2**32 - 5
    b.tare()
    b.step(counter=2**32 - 1)
    for counter in (0, 1):  # the clock does not wrap
        frame = b.step(counter=counter, device_us=(2**32 + counter) * 50_000)
        assert frame["flags"] == []
    silent = {"device_silent", "device_speaks"}  # so is a computer that stops for seconds
    assert {event["name"] for event in b.listener.of("event")} - silent == {"tared"}


def test_a_saturated_scan_is_used_and_flagged(bench: Start) -> None:
    b = bench().tare()
    frame = b.step(flags=ScanFlag.SATURATED)
    assert frame["flags"] == ["saturated"]
    assert frame["map"] is not None


def test_voltages_that_are_no_numbers_are_left_to_the_models_and_never_tared(bench: Start) -> None:
    b = bench().tare()
    line = b.skin.lines[0]
    counter = b.skin.counter + 1
    good = np.full(208, 1e5, np.float32)
    bad = good.copy()
    bad[17] = np.nan
    line.say(replace(line.hello, sample_format=SampleFormat.FLOAT32))
    answer = b.daemon._pipeline.tare()
    b.until(lambda: b.daemon._imaging.taring.is_on)  # a scan that comes first is none of the tare's
    for number in range(counter, counter + 3):
        good = good + np.float32(1)  # the very same again would be a frozen converter's
        bad = bad + np.float32(1)
        line.say(
            Scan(Channel.MAGNITUDE, number, 0, ScanFlag(0), good),
            Scan(Channel.STRUCTURE, number, 0, ScanFlag(0), bad),
        )
        assert b.listener.frame(number)["flags"] == ["invalid_voltage"]
    assert "not numbers" in str(answer.exception(PATIENCE_S))
    assert b.ask("status")["reference"]["scans"] == 3


@pytest.mark.slow
def test_a_channel_that_begins_after_the_other_was_never_missing(bench: Start) -> None:
    b = bench(ports=2, lossless=True)
    b.skin.introduce()
    alone = [b.skin.scan(channels=(Channel.MAGNITUDE,)) for _ in range(2)]
    b.tare()
    assert all("structure_missing" in b.listener.frame(each)["flags"] for each in alone)
    assert b.ask("status")["incomplete_scans"] == 0
    b.skin.scan(channels=(Channel.MAGNITUDE,))
    b.step()
    assert b.ask("status")["incomplete_scans"] == 1

"""What a firmware's author is told: what breaks PROTOCOL.md is not a bad cable, nor silence."""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from daemon_bench import HELLO, VOLTS_PER_COUNT, scan
from fixture_types import Start
from hostile_board import content_of, framed
from tactomo_protocol import Acknowledge, AckStatus, Channel, SampleFormat, Scan, ScanFlag

MAGNITUDE = Channel.MAGNITUDE


def told(b: Any) -> dict[str, Any]:
    """Return the fault that was told, and see that nothing else was."""
    event: dict[str, Any] = b.listener.event("firmware_fault")
    assert "PROTOCOL.md" in event["next_step"]
    assert not {"corrupt_packets", "device_garbled"} & b.ask("status")["events"]["counts"].keys()
    return event


def test_another_version_is_no_bad_cable(bench: Start) -> None:
    b = bench()
    b.skin.introduce()
    b.skin.lines[0].say(framed(b"\2" + content_of(HELLO)[1:]))
    assert "version 2" in told(b)["detail"]


@pytest.mark.slow
def test_a_hello_with_a_rate_that_cannot_be_is_told_and_the_port_does_not_run(bench: Start) -> None:
    b = bench()
    content = content_of(HELLO)
    bad = framed(content[:16] + struct.pack("<d", float("nan")) + content[24:])
    b.skin.lines[0].say(bad)
    assert "scan_rate_hz is nan" in told(b)["detail"]

    def while_idle() -> dict[str, Any] | None:
        b.skin.lines[0].say(bad, scan(MAGNITUDE, 1))
        status: dict[str, Any] = b.ask("status")
        (port,) = status["ports"]
        return status if port["state"] == "faulty" and "scan_rate_hz" in port["problem"] else None

    status = b.until(while_idle)
    assert "device_idle" not in status["events"]["counts"]
    (port,) = status["ports"]
    assert port["corrupt"] == 0 < port["faulty"]
    issues = [issue for issue in status["issues"] if port["url"] in issue["what"]]
    assert len(issues) == 2  # the port's state, and the share of its packets
    for issue in issues:
        assert "correct the firmware" in issue["next_step"]
        assert "cable" not in issue["next_step"]


def test_scans_in_swapped_order_are_told(bench: Start) -> None:
    b = bench(ports=2).tare()
    first = b.skin.counter
    for number in (2, 1, 4, 3):
        for channel in Channel:
            b.skin.line_of(channel).say(scan(channel, first + number))
    event = b.listener.event("scans_disordered")
    assert "in the order of their counter" in event["next_step"]


@pytest.mark.parametrize(
    ("changed", "detail"),
    [
        ({"samples": np.zeros(104, np.int32)}, "104 samples come; its hello says 208"),
        ({"samples": np.zeros(208, np.int16)}, "int16 come; its hello says int32"),
    ],
)
def test_scans_unlike_the_hello_are_no_silence(
    bench: Start, changed: dict[str, Any], detail: str
) -> None:
    b = bench()
    b.skin.introduce()
    b.skin.lines[0].say(replace(scan(MAGNITUDE, 1), **changed))
    assert detail in told(b)["detail"]
    b.until(lambda: b.ask("status")["ports"][0]["unused_scans"] == 1)  # counted once it is told


def test_scans_of_a_channel_that_the_hello_does_not_name_are_not_mixed_in(bench: Start) -> None:
    b = bench(ports=2).tare()
    magnitude, structure = b.skin.lines
    before = b.ask("status")["scans"]["magnitude"]
    structure.say(scan(MAGNITUDE, b.skin.counter + 1))
    assert "does not name" in told(b)["detail"]
    assert magnitude.hello.channels == (MAGNITUDE,)
    assert b.ask("status")["scans"]["magnitude"] == before


@pytest.mark.slow
def test_commands_that_nobody_acknowledges_are_told_once(bench: Start) -> None:
    b = bench()
    b.skin.introduce()
    wanted = "command_unanswered"
    b.until(lambda: b.skin.scan() and b.ask("status")["events"]["counts"].get(wanted))
    assert "RX" in b.listener.event(wanted)["next_step"]


@pytest.mark.slow
def test_who_acknowledges_is_not_said_to_be_silent(bench: Start) -> None:
    b = bench()
    line = b.skin.lines[0]
    asked = b.until(line.heard)
    line.say(*(Acknowledge(each.request, each.code, AckStatus.OK) for each in asked), line.hello)
    begun = b.ask("status")["uptime_s"]
    b.until(lambda: b.skin.scan() and b.ask("status")["uptime_s"] - begun > 4.0)
    assert "command_unanswered" not in b.ask("status")["events"]["counts"]


@pytest.mark.slow
def test_infinities_are_no_numbers_and_the_rest_is_used(bench: Start) -> None:
    b = bench(real=True).tare()
    line = b.skin.lines[0]
    line.say(replace(line.hello, sample_format=SampleFormat.FLOAT32))
    counter = b.skin.counter + 1
    for channel in Channel:
        counts = scan(channel, counter).samples.astype(np.float32)
        counts[[3, 50]] = np.inf, -np.inf
        line.say(Scan(channel, counter, counter * 50_000, ScanFlag(0), counts))
    frame = b.listener.frame(counter)
    assert "invalid_voltage" in frame["flags"]
    assert line.hello.volts_per_count == VOLTS_PER_COUNT
    assert frame["map"] is not None


def test_two_clocks_of_one_device_are_told(bench: Start) -> None:
    b = bench().tare()

    def told_after_another() -> dict[str, int]:
        counter = b.skin.counter = b.skin.counter + 1
        for channel in Channel:
            ahead_us = 0 if channel is MAGNITUDE else 3_600_000_000
            b.skin.lines[0].say(scan(channel, counter, device_us=counter * 50_000 + ahead_us))
        assert b.listener.frame(counter)["dated_by"] == "arrival"
        counts: dict[str, int] = b.ask("status")["events"]["counts"]
        return counts

    b.until(lambda: {"device_clock_unusable", "channels_skewed"} <= told_after_another().keys())
    assert "its channels" in b.listener.event("device_clock_unusable")["detail"]
    assert b.ask("status")["ports"][0]["clock"]["state"] == "unusable"

"""What PROTOCOL.md asks of every device, of the C library on a board whose time and room are given.

The board is tests/speak.c: its timer moves only when a test says so.
"""

from __future__ import annotations

import os
import struct
import subprocess
import time
from collections.abc import Sequence

import numpy as np
import pytest
from c_firmware import FOLLOWER, LEADER, SimulatedDevice, Speaker, build
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tactomo_protocol import (
    Acknowledge,
    AckStatus,
    Channel,
    Command,
    CommandCode,
    CompanionReading,
    Decoder,
    Hello,
    Packet,
    Scan,
    ScanFlag,
    encode,
)
from waiting import PATIENCE_S

OK, UNKNOWN, BAD, BUSY = AckStatus
IDENTIFY, START, STOP, SET_RATE, ZERO = CommandCode
SECOND_US = 1_000_000
PERIOD_US = 50_000


@pytest.fixture
def device(sanitized: Speaker) -> SimulatedDevice:
    """A device that has been switched on, and has said its first hello."""
    device = SimulatedDevice(sanitized)
    device.poll()
    return device


@pytest.fixture
def scanning(device: SimulatedDevice) -> SimulatedDevice:
    """The same, started."""
    device.tell(Command(START, 1))
    return device


def statuses(packets: Sequence[Packet]) -> list[AckStatus]:
    return [packet.status for packet in packets if isinstance(packet, Acknowledge)]


def kinds(packets: Sequence[Packet]) -> list[type]:
    return [type(packet) for packet in packets]


# --- hello and commands ---------------------------------------------------------------------------


def test_hello_comes_at_once_and_every_second_also_when_stopped(sanitized: Speaker) -> None:
    device = SimulatedDevice(sanitized)
    [first] = device.poll()
    assert isinstance(first, Hello)
    assert (first.device_id, first.scan_rate_hz) == ("board", 20.0)
    heard = []
    for _ in range(100):
        device.pass_time(100_000)
        heard += device.poll()
    assert kinds(heard) == [Hello] * 10
    device.pass_time(10 * SECOND_US)  # halted: missed ones are not made up for
    assert kinds(device.poll()) == [Hello]
    device.pass_time(SECOND_US // 2)
    assert device.poll() == []


def test_commands_are_acknowledged_in_order_and_hello_follows(device: SimulatedDevice) -> None:
    acknowledge, hello = device.tell(Command(IDENTIFY, 200))
    assert acknowledge == Acknowledge(200, IDENTIFY, OK)
    assert isinstance(hello, Hello)
    said = device.tell(Command(START, 1), Command(77, 2), Command(SET_RATE, 3, -1.0))
    assert said == [
        Acknowledge(1, START, OK),
        Acknowledge(2, 77, UNKNOWN),
        Acknowledge(3, SET_RATE, BAD),
    ]
    argument = bytes([BUSY, 1, 2, 3, 4, 5, 6, 7])  # of a command of the firmware's own
    own = Command(0xF0, 9, *struct.unpack("<d", argument))
    assert statuses(device.tell(own)) == [BUSY], "tests/speak.c answers with its first byte"
    assert statuses(device.tell(Command(0xF1, 10))) == [UNKNOWN]


def test_a_rate_that_cannot_be_is_refused_and_the_nearest_is_kept_and_stated(
    device: SimulatedDevice,
) -> None:
    for rate_hz in (float("nan"), 0.0, -0.0, -5.0, float("inf"), 1000.1, 1e308):
        assert device.tell(Command(SET_RATE, 5, rate_hz)) == [Acknowledge(5, SET_RATE, BAD)]
    kept = {40.0: 40.0, 1000.0: 1000.0, 30.0: 1e6 / 33_333, 1e-9: 0.001, 5e-324: 0.001}
    for rate_hz, kept_hz in kept.items():
        acknowledge, hello = device.tell(Command(SET_RATE, 5, rate_hz))
        assert acknowledge == Acknowledge(5, SET_RATE, OK)
        assert isinstance(hello, Hello)
        assert hello.scan_rate_hz == pytest.approx(kept_hz, rel=1e-12)


def test_a_companions_reading_leaves_with_the_scans_clock(device: SimulatedDevice) -> None:
    device.pass_time(PERIOD_US)
    words = ("send_companion", 2, PERIOD_US - 10, 0, 0x42280000)  # 42.0
    assert device.speaker.ask(*words) == "0", "it is stopped"
    device.tell(Command(START, 1))
    assert device.speaker.ask(*words) == "1"
    assert device.said() == [CompanionReading(2, ScanFlag(0), PERIOD_US - 10, 42.0)]


def test_a_busy_device_says_so_and_still_stops(scanning: SimulatedDevice) -> None:
    scanning.busy(True)
    asked = [Command(START, 1), Command(SET_RATE, 2, 10.0), Command(ZERO, 3), Command(STOP, 4)]
    assert statuses(scanning.tell(*asked)) == [BUSY, BUSY, BUSY, OK]
    scanning.busy(False)
    assert statuses(scanning.tell(Command(START, 5))) == [OK]


def test_what_cannot_be_read_is_not_answered(device: SimulatedDevice) -> None:
    frame = bytearray(encode(Command(START, 1)))
    frame[6] ^= 1
    assert device.tell(bytes(frame), Acknowledge(1, 2, OK), b"\x01\x02garbage\x00") == []
    assert statuses(device.tell(Command(STOP, 2))) == [OK]


def test_a_device_that_could_not_keep_its_rate_does_not_begin(sanitized: Speaker) -> None:
    for rate_hz, accepted in ((1000.0, 1), (1001.0, 0)):
        device = SimulatedDevice(sanitized, rate_hz=rate_hz, shortest_period_us=1000)
        assert device.accepted == accepted


# --- scans, counter, clock, flags -----------------------------------------------------------------


def test_nothing_is_due_or_sent_until_it_is_started(device: SimulatedDevice) -> None:
    device.pass_time(10 * SECOND_US)
    device.poll()
    assert not device.is_due
    assert device.dual_scan() == (None, None)
    device.tell(Command(START, 1))
    assert device.is_due
    assert None not in device.dual_scan()


def test_scans_are_paced_and_numbered_by_dual_scan(scanning: SimulatedDevice) -> None:
    counters, stamps = [], []
    for _ in range(1000):
        if scanning.is_due:
            for scan in scanning.dual_scan():
                assert scan is not None
                assert scan.flags == 0
                counters.append((scan.counter, scan.channel))
                stamps.append(scan.device_us)
        scanning.pass_time(1000)
        scanning.poll()
    assert counters == [(n, channel) for n in range(20) for channel in Channel]
    assert stamps == [n * PERIOD_US for n in range(20) for _ in Channel]


def test_stop_is_the_end_and_the_counter_goes_on(scanning: SimulatedDevice) -> None:
    scanning.dual_scan()
    half = scanning.begin_scan()
    assert scanning.send(half) is not None
    assert statuses(scanning.tell(Command(STOP, 2), Command(STOP, 3))) == [OK, OK]
    assert scanning.send(half, Channel.STRUCTURE) is None
    scanning.tell(Command(START, 4), Command(START, 5))
    first, _ = scanning.dual_scan()
    assert first is not None
    assert first.counter == 2
    scanning.tell(Command(STOP, 6))  # alone, it takes none while stopped, and counts none
    for _ in range(10):
        scanning.pass_time(PERIOD_US)
        assert not scanning.is_due
    scanning.tell(Command(START, 7))
    assert scanning.begin_scan() == 3


def test_zero_counters_leaves_the_clock(scanning: SimulatedDevice) -> None:
    for _ in range(3):
        scanning.dual_scan()
        scanning.pass_time(PERIOD_US)
    assert statuses(scanning.tell(Command(ZERO, 1))) == [OK]
    both = scanning.dual_scan()
    assert [(scan.counter, scan.device_us) for scan in both if scan] == [(0, 3 * PERIOD_US)] * 2


def test_the_counter_wraps_and_the_clock_does_not(sanitized: Speaker) -> None:
    device = SimulatedDevice(sanitized, timer_us=2**32 - 30_000)
    device.tell(Command(START, 1))
    clock_us = 0
    for step_us in (PERIOD_US, 2**31 + 1, 2**31 + 1, 5, 2**32 - 1, 20):
        device.pass_time(step_us)
        device.poll()
        clock_us += step_us
        scan, _ = device.dual_scan()
        assert scan is not None
        assert scan.device_us == clock_us
    assert device.state[2] == clock_us > 2**33


def test_a_scan_that_began_before_the_timers_wrap_keeps_its_time(sanitized: Speaker) -> None:
    device = SimulatedDevice(sanitized, timer_us=2**32 - 10)
    device.tell(Command(START, 1))
    counter, started_us = device.begin_scan(), device.timer_us
    device.pass_time(25)
    device.poll()
    scan = device.send(counter, started_us=started_us)
    assert scan is not None
    assert scan.device_us == 0


def test_late_is_said_of_scans_that_leave_later_than_the_rate_allows(
    scanning: SimulatedDevice,
) -> None:
    counter, started_us = scanning.begin_scan(), scanning.timer_us
    scanning.pass_time(PERIOD_US)
    in_time = scanning.send(counter, started_us=started_us)
    scanning.pass_time(1)
    late = scanning.send(counter, Channel.STRUCTURE, started_us)
    assert in_time is not None
    assert late is not None
    assert (in_time.flags, late.flags) == (0, ScanFlag.LATE)
    assert late.device_us == in_time.device_us == 0


def test_a_scan_that_a_newer_one_has_overtaken_keeps_its_counter_and_is_late(
    sanitized: Speaker,
) -> None:
    follower = SimulatedDevice(sanitized, role=FOLLOWER)
    follower.tell(Command(START, 1))
    older = follower.begin_scan()
    follower.begin_scan()  # the next pulse's interrupt
    scan = follower.send(older)
    assert scan is not None
    assert (scan.counter, scan.flags) == (0, ScanFlag.LATE)
    # At rate 0 a scan is late only when the next has begun.
    counter, started_us = follower.begin_scan(), follower.timer_us
    follower.pass_time(3_600_000_000 // 4)
    scan = follower.send(counter, started_us=started_us)
    assert scan is not None
    assert scan.flags == 0


def test_missed_scans_are_not_made_up(scanning: SimulatedDevice) -> None:
    scanning.dual_scan()
    scanning.pass_time(10 * PERIOD_US)
    scanning.poll()
    begun = 0
    for _ in range(100):
        if scanning.is_due:
            scanning.dual_scan()
            begun += 1
        scanning.pass_time(1000)
    assert begun == 2


def test_an_external_trigger_paces_and_no_rate_is_taken(sanitized: Speaker) -> None:
    device = SimulatedDevice(sanitized, rate_hz=0.0)
    [hello] = device.poll()
    assert isinstance(hello, Hello)
    assert hello.scan_rate_hz == 0.0
    said = device.tell(Command(START, 1), Command(SET_RATE, 2, 10.0))
    assert statuses(said) == [OK, UNKNOWN]
    device.pass_time(SECOND_US)
    assert not device.is_due
    assert None not in device.dual_scan()


# --- whole frames or none -------------------------------------------------------------------------


def test_a_scan_without_room_is_dropped_whole_and_its_number_is_used(
    scanning: SimulatedDevice,
) -> None:
    first, _ = scanning.dual_scan()
    assert first is not None
    scanning.room(2 * len(encode(first)) - 1)
    assert [scan is None for scan in scanning.dual_scan()] == [False, True]
    scanning.room(1000)
    following, _ = scanning.dual_scan()
    assert following is not None
    assert following.counter == 2
    assert scanning.state[1] == 1


def test_answers_wait_for_room_in_order_and_go_before_scans(scanning: SimulatedDevice) -> None:
    scanning.room(11)
    asked = [Command(IDENTIFY, 1), Command(START, 2), Command(SET_RATE, 3, 10.0)]
    assert scanning.tell(*asked) == []
    counter = scanning.begin_scan()
    scanning.room(24)
    assert scanning.send(counter) is None, "an answer took the room"
    scanning.room(1000)
    said = scanning.poll()
    assert [p.request for p in said if isinstance(p, Acknowledge)] == [2, 3]
    assert any(isinstance(p, Hello) for p in said)
    assert scanning.send(counter) is not None


def test_hello_without_room_is_not_forgotten(device: SimulatedDevice) -> None:
    device.room(20)
    device.pass_time(SECOND_US)
    assert device.poll() == []
    device.room(1000)
    assert kinds(device.poll()) == [Hello]
    device.pass_time(SECOND_US - 1)
    assert device.poll() == []


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("command"), st.integers(0, 7)),
            st.tuples(st.just("garbage"), st.integers(0, 255)),
            st.tuples(st.just("room"), st.integers(0, 120)),
            st.tuples(st.just("time"), st.integers(0, 3 * PERIOD_US)),
            st.tuples(st.just("scan"), st.just(0)),
        ),
        max_size=40,
    )
)
def test_any_course_of_events_gives_whole_frames_and_every_answer(
    sanitized: Speaker, events: list[tuple[str, int]]
) -> None:
    """Each answer that the simulated device gives is a sound frame: `said` asserts that."""
    device = SimulatedDevice(sanitized)
    asked: list[int] = []
    for what, amount in events:
        if what == "command":
            asked.append(len(asked))
            device.tell(Command(amount, asked[-1]))
        elif what == "garbage":
            device.tell(bytes([0, amount, amount, 0]))
        elif what == "room":
            device.room(amount)
        elif what == "time":
            device.pass_time(amount)
        elif device.is_due:
            device.dual_scan()
    device.room(100_000)
    device.poll()
    assert [p.request for p in device.heard if isinstance(p, Acknowledge)] == asked
    counters = [scan.counter for scan in device.heard if isinstance(scan, Scan)]
    if ("command", ZERO) not in events:
        assert counters == sorted(counters)


# --- two boards -----------------------------------------------------------------------------------


def test_a_leader_gives_pulses_when_stopped_and_its_zero_is_the_long_one(
    sanitized: Speaker,
) -> None:
    leader = SimulatedDevice(sanitized, role=LEADER)
    counters = []
    for _ in range(200):
        if leader.is_due:
            counters.append(leader.begin_scan())
        if len(counters) == 3:
            leader.tell(Command(ZERO, 1))
            counters.append(-1)
        leader.pass_time(1000)
        leader.poll()
    assert counters == [0, 1, 2, -1, 0]
    assert leader.send(0) is None, "stopped"


def test_a_follower_counts_pulses_and_leaves_rate_and_zero_to_the_leader(
    sanitized: Speaker,
) -> None:
    follower = SimulatedDevice(sanitized, role=FOLLOWER)
    [hello] = follower.poll()
    assert isinstance(hello, Hello)
    assert hello.scan_rate_hz == 0.0
    assert [follower.begin_scan() for _ in range(3)] == [0, 1, 2]
    said = follower.tell(Command(ZERO, 1), Command(SET_RATE, 2, 10.0), Command(START, 3))
    assert statuses(said) == [UNKNOWN, UNKNOWN, OK]
    assert follower.begin_scan() == 3
    assert follower.zero_counter() == 0
    scan = follower.send(0)
    assert scan is not None
    assert (scan.counter, scan.flags) == (0, 0)
    assert follower.begin_scan() == 1


# --- the example ----------------------------------------------------------------------------------


def test_the_example_firmware_runs_and_keeps_the_order_of_samples() -> None:
    program = build("example_on_pipes")
    packets: list[Packet] = []
    decoder = Decoder()
    with subprocess.Popen([program], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(encode(Command(START, 1)))
        process.stdin.flush()
        deadline = time.monotonic() + PATIENCE_S
        while sum(isinstance(packet, Scan) for packet in packets) < 6:
            assert time.monotonic() < deadline
            packets += decoder.feed(os.read(process.stdout.fileno(), 65_536))
        process.stdin.close()
        assert process.wait(PATIENCE_S) == 0
    assert decoder.counts.corrupt == 0
    assert kinds(packets[:2]) == [Hello, Acknowledge]
    magnitude, structure = [packet for packet in packets if isinstance(packet, Scan)][:2]
    order = [(k, m) for k in range(16) for m in range(16) if (m - k) % 16 not in (0, 1, 15)]
    assert len(magnitude.samples) == 208
    for scan, channel in ((magnitude, 0), (structure, 1)):
        expected = [channel << 24 | k << 16 | (k + 1) % 16 << 8 | m for k, m in order]
        assert np.array_equal(scan.samples, expected)
    # The board's second channel counts beyond the converter's limit.
    assert structure.flags & ScanFlag.SATURATED
    assert not magnitude.flags & ScanFlag.SATURATED

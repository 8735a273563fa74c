"""How a device does is judged by what came and when; times are the test's own."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tactomo.acquisition.liveness import PATIENCE_S, REOPEN_MOST_S, REOPEN_S, DeviceState, Liveness
from tactomo.timing import LATE_PERIODS, LONGEST_PERIOD_S


@pytest.fixture
def device() -> Liveness:
    liveness = Liveness()
    liveness.opened(100.0)
    return liveness


@pytest.mark.parametrize(
    ("packets", "scans", "state"),
    [(0, 0, DeviceState.GARBLED), (1, 0, DeviceState.IDLE), (2, 1, DeviceState.RUNNING)],
)
def test_what_comes_says_how_it_does(
    device: Liveness, packets: int, scans: int, state: DeviceState
) -> None:
    for tenth in range(60):
        device.heard(100.0 + tenth / 10, packets, scans)
    assert device.judge(106.0) is state
    assert device.judge(110.0) is DeviceState.SILENT


def reopenings(device: Liveness, until_s: int) -> list[int]:
    """Return when the port is opened anew, in whole seconds from 100 s on."""
    times = []
    for now_s in range(101, 100 + until_s):
        device.judge(now_s)
        if device.is_reopening_due(now_s):
            device.reopened(now_s)
            times.append(now_s - 100)
    return times


def test_a_mute_device_is_opened_anew_ever_more_rarely(device: Liveness) -> None:
    times = reopenings(device, 400)
    waits = [later - earlier for earlier, later in zip([0, *times], times, strict=False)]
    assert waits[0] == REOPEN_S
    assert waits == sorted(waits)
    assert waits[-1] == REOPEN_MOST_S


def test_a_device_that_speaks_is_left_alone_and_soon_looked_after_again(device: Liveness) -> None:
    assert len(reopenings(device, 200)) > 2
    for now_s in range(300, 340):
        device.heard(now_s, 1, 0)
        assert device.judge(now_s) is not DeviceState.SILENT or now_s < 303
        assert not device.is_reopening_due(now_s)
    device.judge(339 + REOPEN_S)
    assert device.is_reopening_due(339 + REOPEN_S)


# Slow by nature


def states_until(device: Liveness, now_s: float, end_s: float) -> set[DeviceState]:
    """Return what it is taken for, looked at ten times a second; it is never opened anew."""
    seen = set()
    while now_s < end_s:
        seen.add(device.judge(now_s))
        assert not device.is_reopening_due(now_s)
        now_s += 0.1
    return seen


@given(st.floats(PATIENCE_S, LONGEST_PERIOD_S))
def test_a_slow_foreign_device_runs_and_one_that_stops_is_told_by_its_own_pace(
    period_s: float,
) -> None:
    device = Liveness(says_hello=False)
    device.opened(0.0)
    for number in range(1, 4):  # each frame comes at once; the first one is too late to be known of
        device.heard(number * period_s, 1, 1)
    states = states_until(device, 3 * period_s, 3 * period_s + 0.9 * LATE_PERIODS * period_s)
    assert states == {DeviceState.RUNNING}
    assert device.judge(3 * period_s + 1.01 * LATE_PERIODS * period_s) is DeviceState.SILENT


def test_until_its_pace_is_known_a_device_has_what_its_protocol_says() -> None:
    device = Liveness(says_hello=False, first_s=10.0)
    device.opened(0.0)
    assert states_until(device, 0.0, 9.9) == {DeviceState.STARTING}
    assert device.judge(10.1) is DeviceState.SILENT
    for tenth in range(111, 120):
        device.heard(tenth / 10, 1, 1)
    assert device.judge(11.9 + PATIENCE_S + 0.1) is DeviceState.SILENT


def test_a_device_of_ours_has_the_rate_that_it_says_and_is_silent_as_soon_as_any(
    device: Liveness,
) -> None:
    device.note_rate(rate_hz=0.1)
    for number in range(3):
        device.heard(110.0 + 10 * number, 2, 2)  # two channels at once: that is not its pace
        device.heard(110.0 + 10 * number, 2, 2)
        for second in range(1, 10):
            device.heard(110.0 + 10 * number + second, 1, 0)
            assert device.judge(110.0 + 10 * number + second) is DeviceState.RUNNING
    assert device.judge(139.0 + PATIENCE_S) is DeviceState.SILENT
    for second in range(140, 165):
        device.heard(float(second), 1, 0)
    assert device.judge(164.0) is DeviceState.IDLE


def test_one_long_pause_is_nobodys_pace(device: Liveness) -> None:
    for number in range(100):
        device.heard(101.0 + number / 20, 1, 1)
    device.heard(4000.0, 1, 1)
    device.heard(4000.05, 1, 1)
    assert device.patience_s == PATIENCE_S


@pytest.mark.parametrize("since_s", [4.0, 60.0])
def test_what_comes_after_silence_has_its_time_to_become_a_packet(since_s: float) -> None:
    """A frame reaches the reader in pieces: the first one alone is no garbage."""
    device = Liveness(says_hello=False)
    device.opened(0.0)
    device.judge(since_s)
    device.heard(since_s, 0, 0)
    assert device.judge(since_s + PATIENCE_S - 0.1) is DeviceState.SILENT
    device.heard(since_s + PATIENCE_S - 0.1, 0, 0)
    assert device.judge(since_s + PATIENCE_S) is DeviceState.GARBLED
    device.heard(since_s + PATIENCE_S, 1, 1)
    assert device.judge(since_s + PATIENCE_S) is DeviceState.RUNNING


def test_a_board_that_is_opened_amid_a_frame_has_its_time_for_a_whole_one() -> None:
    device = Liveness(says_hello=False, first_s=4.0)
    device.opened(0.0)
    device.heard(3.5, 0, 0)
    assert states_until(device, 3.5, 7.4) == {DeviceState.STARTING}
    device.heard(7.4, 1, 1)
    assert device.judge(7.4) is DeviceState.RUNNING


def test_a_first_scan_that_comes_at_once_is_nobodys_pace() -> None:
    device = Liveness(says_hello=False, first_s=10.0)
    device.opened(0.0)
    device.heard(0.1, 1, 1)
    assert states_until(device, 0.1, 5.0) == {DeviceState.RUNNING}
    device.heard(5.1, 1, 1)
    assert device.patience_s == pytest.approx(3 * 5.0)

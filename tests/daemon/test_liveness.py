"""How a device does is judged by what came and when; times are the test's own."""

from __future__ import annotations

import pytest
from tactomo.liveness import PATIENCE_S, REOPEN_MOST_S, REOPEN_S, DeviceState, Liveness


@pytest.fixture
def device() -> Liveness:
    liveness = Liveness()
    liveness.opened(100.0)
    return liveness


def test_a_device_gets_its_time_to_answer(device: Liveness) -> None:
    assert device.judge(100.0 + PATIENCE_S - 0.1) is DeviceState.STARTING
    assert device.judge(100.0 + PATIENCE_S) is DeviceState.SILENT


@pytest.mark.parametrize(
    ("packets", "scans", "state"),
    [
        (0, 0, DeviceState.GARBAGE),
        (1, 0, DeviceState.IDLE),
        (2, 1, DeviceState.RUNNING),
    ],
)
def test_what_comes_says_how_it_does(
    device: Liveness, packets: int, scans: int, state: DeviceState
) -> None:
    for tenth in range(60):
        device.heard(100.0 + tenth / 10, packets, scans)
    assert device.judge(106.0) is state
    assert device.judge(110.0) is DeviceState.SILENT


def test_a_trouble_lasts_until_scans_come(device: Liveness) -> None:
    device.judge(103.0)
    device.reopened(106.0)
    assert device.judge(106.1) is DeviceState.SILENT
    device.heard(106.2, 1, 1)
    assert device.judge(106.3) is DeviceState.RUNNING


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


def test_a_device_that_is_plugged_in_again_begins_anew(device: Liveness) -> None:
    reopenings(device, 200)
    device.opened(300.0)
    assert device.judge(300.1) is DeviceState.STARTING
    device.judge(300 + REOPEN_S)
    assert device.is_reopening_due(300 + REOPEN_S)

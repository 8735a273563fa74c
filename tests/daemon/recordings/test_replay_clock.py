"""How far a replay is: what waits for a partner must not be given up before it came."""

from __future__ import annotations

import pytest
from tactomo.recordings.replay import ReplayClock
from tactomo.scans import PortRead


def test_a_port_at_its_end_holds_up_nobody() -> None:
    clock = ReplayClock(2, is_paced=False)
    clock.follow(PortRead(0, 5_000, ()))
    assert clock.follow(PortRead(1, 0, (), has_ended=True)) == 5_000
    assert not clock.has_ended
    assert clock.follow(PortRead(0, 0, (), has_ended=True)) is None
    assert clock.has_ended


@pytest.mark.parametrize("slow", [0, 1])
def test_paced_time_goes_on_where_one_port_is_silent(slow: int) -> None:
    clock = ReplayClock(2, is_paced=True)
    assert clock.follow(PortRead(slow, 100, ())) == 100
    assert clock.follow(PortRead(1 - slow, 5_000, ())) == 5_000

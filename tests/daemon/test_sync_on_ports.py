"""Two channels on one port or two: joined by counter, never waited for too long."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from tactomo_client.messages import array_from_wire

Start = Callable[..., Any]


@pytest.mark.parametrize("ports", [1, 2])
def test_both_channels_of_one_instant_become_one_frame(bench: Start, ports: int) -> None:
    b = bench(ports=ports)
    b.tare()
    frame = b.step(load=0.1)
    assert frame["flags"] == []
    assert array_from_wire(frame["map"])[0, 0] == pytest.approx(0.2, abs=1e-3)
    assert frame["device_us"] == b.skin.counter * 50_000
    assert b.ask("status")["incomplete_scans"] == 0

"""Times that make no sense are refused where they are given, in words that say what to give."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fake_control import FakeControl
from tactomo_client import Daemon, aio, request, subscribe
from tactomo_client.fake import FakeSensor

NOWHERE = "tcp://127.0.0.1:1"
NO_NUMBERS: list[Any] = ["0.5", "soon", True, b"1", [1.0], 1j]
NEGATIVE: list[Any] = [-1, -0.001, -math.inf, -(10**400), np.float32(-2)]
NAN: list[Any] = [math.nan, np.float64("nan")]
SENSIBLE: list[Any] = [60, 30.5, np.float32(30.5), np.int64(60), 1e300, 10**400, math.inf]


def doors() -> dict[str, tuple[str, Callable[[Any], Any]]]:
    """What takes a time, by a name: that of the argument, and the call."""
    return {
        "subscribe timeout": ("timeout_s", lambda t: subscribe("a", timeout_s=t)),
        "subscribe stale": ("stale_after_s", lambda t: subscribe("a", stale_after_s=t)),
        "aio subscribe timeout": ("timeout_s", lambda t: aio.subscribe("a", timeout_s=t)),
        "aio subscribe stale": ("stale_after_s", lambda t: aio.subscribe("a", stale_after_s=t)),
        "request": ("timeout_s", lambda t: request("status", NOWHERE, t)),
        "daemon": ("timeout_s", lambda t: Daemon(NOWHERE, timeout_s=t)),
        "daemon connects": ("connect_timeout_s", lambda t: Daemon(NOWHERE, connect_timeout_s=t)),
        "tare": ("timeout_s", lambda t: Daemon(NOWHERE).tare(t)),
        "aio control": ("timeout_s", lambda t: aio.Control(NOWHERE, timeout_s=t)),
        "aio tare": ("timeout_s", lambda t: asyncio.run(aio.Control(NOWHERE).request("tare", t))),
    }


@pytest.mark.parametrize("door", doors())
def test_a_time_is_a_number_and_not_negative(door: str) -> None:
    name, call = doors()[door]
    for value in NO_NUMBERS:
        with pytest.raises(TypeError, match=f"^{name} = .* is no number: give seconds"):
            call(value)
    for value in NEGATIVE + NAN:
        with pytest.raises(ValueError, match=f"^{name} = .*: give seconds, "):
            call(value)


@pytest.mark.parametrize("door", ["request", "daemon", "daemon connects", "tare", "aio tare"])
def test_a_command_needs_some_time(door: str) -> None:
    name, call = doors()[door]
    with pytest.raises(ValueError, match=f"^{name} = 0: give seconds, more than 0"):
        call(0)


def test_long_and_endless_times_serve() -> None:
    with FakeSensor("left") as sensor, FakeControl() as control:
        for value in SENSIBLE:
            with Daemon(control.address, timeout_s=value, connect_timeout_s=value) as daemon:
                assert daemon.request("status") == {}
            options: dict[str, Any] = {"timeout_s": value, "stale_after_s": value}
            with subscribe("left", address=sensor.address, **options) as skin:
                sensor.wait_for_subscriber()
                sensor.publish()
                assert next(skin).sensor == "left"


def test_what_is_left_of_a_time_may_be_nothing(sensor: FakeSensor) -> None:
    with subscribe("left", address=sensor.address) as skin:
        sensor.wait_for_subscriber()
        begin_s = time.monotonic()
        assert skin.wait(-1) is skin.wait(-math.inf) is skin.wait(0) is None
        assert time.monotonic() - begin_s < 5
        for value in NO_NUMBERS:
            with pytest.raises(TypeError, match="timeout_s = "):
                skin.wait(value)
        with pytest.raises(ValueError, match="timeout_s = nan"):
            skin.wait(math.nan)

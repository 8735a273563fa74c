"""request(): what was asked arrives, what was answered comes back, silence is an error."""

from __future__ import annotations

import socket
import threading
import time

import pytest
from tactomo_client import ControlError, Daemon, MessageError, NoAnswer, request, subscribe
from tactomo_client.control import TARE_TIMEOUT_S

PATIENCE_S = 60.0


def test_a_wrong_address_is_named() -> None:
    with pytest.raises(ControlError, match="cannot connect to 'localhost'") as caught:
        request("status", "localhost")
    assert caught.value.name == "bad_address"
    with pytest.raises(ControlError, match=r"127\.0\.0\.1:5560") as of_stream:
        subscribe("left", address="localhost")
    assert "5561" in of_stream.value.next_step


def test_nothing_listens_is_told_long_before_a_commands_own_time_is_over() -> None:
    begin_s = time.monotonic()
    with (
        Daemon("ipc:///nowhere/at/all", connect_timeout_s=0.3) as daemon,
        pytest.raises(NoAnswer, match=r"within [\d.]+ s: nothing listens there; start the daemon"),
    ):
        daemon.tare()
    assert time.monotonic() - begin_s < TARE_TIMEOUT_S / 2


@pytest.mark.slow
def test_a_busy_daemon_is_waited_for_though_it_says_nothing() -> None:
    """The kernel answers for a program that does not come round to its socket."""
    with socket.create_server(("127.0.0.1", 0)) as busy:
        address = f"tcp://127.0.0.1:{busy.getsockname()[1]}"
        begin_s = time.monotonic()
        with (
            Daemon(address, connect_timeout_s=2.0) as daemon,
            pytest.raises(NoAnswer, match=r"though something listens there; .* its log") as caught,
        ):
            daemon.tare(4.0)
        assert time.monotonic() - begin_s >= 4.0
        assert "within 4 s" in caught.value.cause


def test_a_daemon_that_goes_away_during_a_command_is_missed() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        threading.Timer(0.5, server.shutdown, [socket.SHUT_RDWR]).start()
        with pytest.raises(NoAnswer, match="nothing listens there"):
            Daemon(address, connect_timeout_s=0.3).tare(PATIENCE_S)


def test_a_request_that_the_daemon_would_hang_up_on_is_refused_at_once() -> None:
    with pytest.raises(MessageError, match="is over 65536"):
        request("record_start", "ipc:///nowhere/at/all", path="x" * 70_000)

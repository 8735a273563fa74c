"""request(): what was asked arrives, what was answered comes back, silence is an error."""

from __future__ import annotations

import time

import pytest
from tactomo_client import ControlError, MessageError, request, subscribe
from tactomo_client.fake import FakeControl


def test_a_command_is_sent_and_its_result_returned() -> None:
    with FakeControl({"set_tier": {"tier": "quiet"}}) as daemon:
        assert request("set_tier", daemon.address, 10, tier="quiet") == {"tier": "quiet"}
        assert daemon.requests == [("set_tier", {"tier": "quiet"})]


def test_a_refusal_carries_cause_and_next_step() -> None:
    refusal = ControlError("a contact is there", "lift it", "tare_refused")
    with FakeControl({"tare": refusal}) as daemon, pytest.raises(ControlError) as caught:
        request("tare", daemon.address, timeout_s=10)
    error = caught.value
    assert (error.name, error.cause, error.next_step) == (
        "tare_refused",
        "a contact is there",
        "lift it",
    )


def test_silence_says_what_to_do() -> None:
    started = time.monotonic()
    with pytest.raises(ControlError, match=r"nothing answered at .* start the daemon") as caught:
        request("status", "tcp://127.0.0.1:1", timeout_s=0.05)
    assert caught.value.name == "no_answer"
    assert time.monotonic() - started < 10


def test_an_answer_in_another_language_is_named() -> None:
    answers = {"status": b"HTTP/1.1 400 Bad Request\r\n\r\n"}
    with FakeControl(answers) as web_server, pytest.raises(MessageError):
        request("status", web_server.address, timeout_s=10)


def test_a_wrong_address_is_named() -> None:
    with pytest.raises(ControlError, match="cannot connect to 'localhost'") as caught:
        request("status", "localhost")
    assert caught.value.name == "bad_address"
    with pytest.raises(ControlError, match=r"127\.0\.0\.1:5560") as of_stream:
        subscribe("left", address="localhost")
    assert "5561" in of_stream.value.next_step

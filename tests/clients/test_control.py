"""request(): what was asked arrives, what was answered comes back, silence is an error."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
from tactomo_client import ControlError, MessageError, request
from tactomo_client.messages import decode_request, encode_error, encode_reply

Server = Callable[[bytes], tuple[str, list[bytes]]]


def test_a_command_is_sent_and_its_result_returned(reply_with: Server) -> None:
    address, asked = reply_with(encode_reply({"tier": "quiet"}))
    assert request("set_tier", address, timeout_s=10, tier="quiet") == {"tier": "quiet"}
    assert decode_request(asked[0]) == ("set_tier", {"tier": "quiet"})


def test_a_refusal_carries_cause_and_next_step(reply_with: Server) -> None:
    address, _ = reply_with(encode_error("tare_refused", "a contact is there", "lift it"))
    with pytest.raises(ControlError) as caught:
        request("tare", address, timeout_s=10)
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


def test_an_answer_in_another_language_is_named(reply_with: Server) -> None:
    address, _ = reply_with(b"HTTP/1.1 400 Bad Request\r\n\r\n")
    with pytest.raises(MessageError):
        request("status", address, timeout_s=10)


def test_a_wrong_address_is_named() -> None:
    with pytest.raises(ControlError, match="cannot connect to 'localhost'") as caught:
        request("status", "localhost")
    assert caught.value.name == "bad_address"

"""A web page reaches no ZeroMQ socket, although a browser sends its requests to any port."""

from __future__ import annotations

from fixture_types import Start
from hostile_page import SUBSCRIBE, post
from tactomo_client.messages import encode_request


def test_a_posted_command_is_not_obeyed_and_a_posted_subscription_gets_nothing(
    bench: Start,
) -> None:
    b = bench()
    before = b.ask("status")
    answer = post(b.daemon.control_address, [b"", encode_request("set_tier", {"tier": "noser"})])
    assert b"ok" not in answer
    assert b"left/status" not in post(b.daemon.stream_address, [SUBSCRIBE])
    after = b.ask("status")
    assert all(after[name] == before[name] for name in ("tier_requested", "subscribers"))

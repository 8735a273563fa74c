"""A channel is one port's: a second skin on the same daemon is refused, by name."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from daemon_bench import BOTH, REST, scan
from fixture_types import Start
from tactomo_protocol import Channel


def two_skins(bench: Start) -> Any:
    """A daemon of two ports, each with a skin of its own that sends both channels; tared."""
    b = bench(ports=2)
    for number, line in enumerate(b.skin.lines):
        line.hello = replace(line.hello, device_id=f"skin-{number}", channels=BOTH)
    first, second = b.skin.lines
    first.introduce()
    b.until(lambda: b.ask("status")["ports"][0]["device"])
    second.introduce()
    b.until(lambda: b.ask("status")["ports"][1]["device"])
    b.skin.lines = [first]
    for _ in range(b.daemon.config.tare_scans):
        b.step()
    b.listener.event("tared")
    b.skin.lines = [first, second]
    return b


def test_a_port_whose_channels_another_one_carries_is_refused_and_told(bench: Start) -> None:
    b = two_skins(bench)
    first, second = b.skin.lines
    told = b.listener.event("device_refused")
    for part in (str(second.path), "skin-1", str(first.path)):
        assert part in told["detail"]
    assert "daemon of its own" in told["next_step"]
    ports = b.ask("status")["ports"]
    assert [port["state"] == "refused" for port in ports] == [False, True]
    assert str(first.path) in ports[1]["refusal"]
    second.say(*[scan(channel, 100, REST * 1.2) for channel in BOTH])
    b.until(lambda: b.ask("status")["ports"][1]["unused_scans"] == 2)
    b.skin.lines = [first]
    assert b.step()["flags"] == []


def test_a_board_that_moves_to_the_other_port_takes_its_channel_along(bench: Start) -> None:
    b = bench(ports=2)
    for line, name in zip(b.skin.lines, ("one", "other"), strict=True):
        line.hello = replace(line.hello, device_id=name)
    b.tare()
    first, second = b.skin.lines
    for line in (first, second):
        line.unplug()
    b.until(lambda: all(port["state"] == "closed" for port in b.ask("status")["ports"]))
    first.hello, second.hello = second.hello, first.hello
    for line in (first, second):
        line.plug()
        line.introduce()
    first.say(first.hello)
    assert b.skin.line_of(Channel.STRUCTURE) is first
    b.until(lambda: not any(port["refusal"] for port in b.ask("status")["ports"]))
    b.until(lambda: b.step()["flags"] == [])  # a channel that was lost is waited for again

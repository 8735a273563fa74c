"""What can go wrong at a port: noise, unplugging, the wrong device, somebody else's port."""

from __future__ import annotations

import random
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from daemon_bench import LOCAL, UNUSED
from fixture_types import Start
from tactomo import timing
from tactomo.config import load_config
from tactomo.errors import PortError
from tactomo.service.daemon import Daemon
from tactomo_protocol import Acknowledge, AckStatus, CommandCode


def refusal(port: str | Path) -> PortError:
    """Return the error with which a daemon refuses to start on a port."""
    config = load_config(None, ports=[str(port)], baseline={"track": False}, **LOCAL)

    def start() -> None:
        daemon = Daemon(config, reconstructor=UNUSED)
        try:
            daemon.start()
        finally:
            daemon.stop()

    with pytest.raises(PortError) as caught:
        start()
    assert caught.value.next_step
    return caught.value


def test_garbage_is_counted_and_told_in_few_events_and_costs_nothing_else(bench: Start) -> None:
    b = bench().tare()
    first_s = time.monotonic()
    b.skin.lines[0].say(
        b"\x00" + random.Random(1).randbytes(300).replace(b"\x00", b"\x01") + b"\x00"
    )
    event = b.listener.event("corrupt_packets")
    assert event["severity"] == "warning"
    assert b.step()["flags"] == []
    for _ in range(200):
        b.skin.lines[0].say(b"\x00garbage\x00")
    b.step()
    passed_s = time.monotonic() - first_s
    (port,) = b.ask("status")["ports"]
    assert port["corrupt"] == 201
    assert port["connected"]
    told = sum(e["name"] == "corrupt_packets" for e in b.listener.of("event"))
    assert 1 <= told <= 2 + passed_s  # once a second at most


def test_a_board_that_calls_itself_otherwise_each_time_is_told_in_few_events(bench: Start) -> None:
    b = bench().tare()
    line = b.skin.lines[0]
    for number in range(100):
        line.hello = replace(line.hello, device_id=f"board-{number}")
        line.say(line.hello)
    b.until(lambda: b.ask("status")["ports"][0]["device"]["device_id"] == "board-99")
    b.step()
    told = Counter(event["name"] for event in b.listener.of("event"))
    assert 1 <= told["device_changed"] <= 10
    assert told.total() < 30


def test_damage_that_is_over_is_not_told_as_present(
    bench: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(timing, "LOOK_S", 0.0)
    b = bench().tare()
    b.skin.lines[0].say(b"\x00garbage\x00")
    b.listener.event("corrupt_packets")
    status = b.ask("status")
    assert status["ports"][0]["received_last_minute"]["corrupt"] == 1
    assert any("damaged" in issue["what"] for issue in status["issues"])
    monkeypatch.setattr(timing, "MINUTE_S", 0.5)
    b.step()
    status = b.until(
        lambda: (s := b.ask("status"))["ports"][0]["received_last_minute"]["corrupt"] == 0 and s
    )
    assert status["ports"][0]["corrupt"] == 1
    assert not any("damaged" in issue["what"] for issue in status["issues"])


@pytest.mark.parametrize("ports", [1, 2])
def test_an_unplugged_port_is_waited_for_and_started_again(bench: Start, ports: int) -> None:
    b = bench(ports=ports).tare()
    line = b.skin.lines[0]
    line.unplug()
    assert b.listener.event("port_lost")["severity"] == "error"
    assert not b.ask("status")["ports"][0]["connected"]
    line.plug()
    b.listener.event("port_back")
    line.introduce()
    frame = b.step(load=0.1)
    assert frame["flags"] == []  # the reference held
    assert frame["map"] is not None


def test_a_device_that_is_there_already_needs_no_introduction(bench: Start) -> None:
    b = bench()
    line = b.skin.lines[0]
    line.say(b"the end of a packet that began before\x00")  # attached in the middle
    line.say(line.hello)
    for _ in range(3):
        b.step()
    b.listener.event("tared")
    assert b.ask("status")["ports"][0]["corrupt"] == 0


@pytest.mark.slow
def test_a_silent_device_is_asked_again(bench: Start) -> None:
    b = bench()
    codes: list[int] = []

    def asked_twice() -> bool:
        codes.extend(command.code for command in b.skin.lines[0].heard())
        return codes.count(CommandCode.IDENTIFY) >= 2 and codes.count(CommandCode.START) >= 2

    b.listener.wait("status", lambda _: asked_twice())


def test_the_wrong_device_is_refused_and_not_reconstructed(bench: Start) -> None:
    b = bench()
    line = b.skin.lines[0]
    right = line.hello
    line.hello = replace(right, electrodes=8)
    line.introduce()
    assert "electrodes 8, not 16" in b.listener.event("device_refused")["detail"]
    b.skin.scan()
    line.hello = right
    line.say(right)
    b.step()
    assert [frame["scan_counter"] for frame in b.listener.of("map")] == [2]
    (port,) = b.ask("status")["ports"]
    assert (port["refusal"], port["unused_scans"]) == (None, 2)


def test_a_device_of_another_skin_is_refused_by_its_name(bench: Start) -> None:
    b = bench(ports=2, device_ids=["ours-a", "ours-b"])
    first, second = b.skin.lines
    first.hello, ours = replace(first.hello, device_id="theirs"), replace(first.hello)
    second.hello = replace(second.hello, device_id="ours-a")  # whichever port it is at
    b.skin.introduce()
    refused = b.listener.event("device_refused")
    assert "theirs" in refused["detail"]
    assert "ours-a, ours-b" in refused["detail"]
    assert "by-path" in refused["next_step"]

    def states() -> list[str]:
        b.skin.scan()
        return [port["state"] for port in b.ask("status")["ports"] if port["device"]]

    b.until(lambda: states() == ["refused", "running"])
    assert b.ask("status")["ports"][0]["unused_scans"]
    first.say(replace(ours, device_id="ours-b"))
    for _ in range(3):
        b.step()
    b.listener.event("tared")
    assert b.ask("status")["ports"][0]["refusal"] is None


def test_a_device_in_anothers_place_and_a_command_that_it_refuses_are_told(bench: Start) -> None:
    b = bench().tare()
    line = b.skin.lines[0]
    line.unplug()
    b.listener.event("port_lost")
    line.hello = replace(line.hello, device_id="bench-2")
    line.plug()
    line.introduce()
    event = b.listener.event("device_changed")
    assert "bench-2 is where bench-1 was" in event["detail"]
    assert "tare" in event["next_step"]
    assert b.step()["flags"] == []
    line.say(Acknowledge(3, CommandCode.START, AckStatus.BUSY))
    refused = b.listener.event("command_refused")
    assert "BUSY" in refused["detail"]
    assert "PROTOCOL.md" in refused["next_step"]


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("absent", "does not exist"),
        ("file", "is not a serial device"),
        ("folder", "cannot open"),
        ("url", "cannot open"),
    ],
)
def test_what_is_no_port_is_refused_at_once(tmp_path: Path, kind: str, said: str) -> None:
    path = tmp_path / "port"
    if kind == "file":
        path.write_text("not a device")
    if kind == "folder":
        path.mkdir()
    error = refusal("nonsense://1" if kind == "url" else path)
    assert said in error.cause

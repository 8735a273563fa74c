"""Commands to a running daemon, good ones and bad ones, over a real socket."""

from __future__ import annotations

import threading
from typing import Any

import msgpack  # type: ignore[import-untyped]
import pytest
import zmq
from daemon_bench import LOCAL, UNUSED, Memory
from fixture_types import Start
from tactomo.config import load_config
from tactomo.errors import AddressError
from tactomo.service.daemon import Daemon
from tactomo.stream import control
from tactomo_client import ControlError
from tactomo_client.messages import decode_reply, encode_request
from waiting import PATIENCE_S


def test_status_says_how_everything_is(bench: Start) -> None:
    b = bench()
    assert b.ask("status")["state"] == "waiting_for_data"
    assert b.ask("status")["source"] == {"kind": "unknown"}
    b.tare()
    status = b.until(
        lambda: b.step(load=0.1) and (s := b.ask("status"))["state"] == "running" and s
    )
    assert status["source"] == {"kind": "device"}
    assert status["description"]["model"] == "paper_square"
    assert status["description"]["sensing_width_mm"] == pytest.approx(138)
    assert len(status["description"]["electrodes_mm"]) == 16
    assert status["reference"]["scans"] == 3
    assert status["stage_ms"]["reconstruct"]["p50"] > 0
    assert 0 < status["latency_ms"]["p50"] <= status["latency_ms"]["p99"]
    assert status["sequence"] >= 1
    assert status["tier"] == "tikhonov"
    assert status["recording"] is None
    assert status["baseline"]["state"] == "off"  # as the bench's configuration has it
    assert status["subscribers"] == 5
    assert set(b.listener.of("status")[-1]) == set(status)


@pytest.mark.slow
def test_rates_are_what_comes_and_nothing_when_nothing_comes(bench: Start) -> None:
    b = bench().tare()
    b.until(
        lambda: (
            b.step()
            and (rates := b.ask("status")["rates"])["magnitude_hz"] > 0
            and rates["structure_hz"] > 0
            and rates["frames_hz"] > 0
        )
    )
    b.listener.wait("status", lambda s: s["state"] == "stale")
    b.listener.wait("status", lambda s: s["rates"]["frames_hz"] == 0)


@pytest.mark.parametrize("sockets", [pytest.param(200, marks=pytest.mark.slow), 1])
def test_two_hundred_tares_at_once_are_all_answered(
    bench: Start, connect: Start, sockets: int
) -> None:
    b = bench().tare()
    askers = [connect(zmq.DEALER, b.daemon.control_address) for _ in range(sockets)]
    for number in range(200):
        askers[number % sockets].send_multipart([b"", encode_request("tare", {})])
    b.until(lambda: len(b.daemon._control._pending) == 200)
    for _ in range(b.daemon.config.tare_scans):
        b.step()
    answers = []
    for number in range(200):
        assert askers[number % sockets].poll(30_000), f"{number} answers of 200"
        answers.append(decode_reply(askers[number % sockets].recv_multipart()[-1]))
    assert answers == [{"scans": b.daemon.config.tare_scans, "contacts": 0}] * 200

    def times_told() -> int:
        return [event["name"] for event in b.listener.of("event")].count("tared")

    b.until(lambda: times_told() >= 2)  # events come by another socket than answers
    assert times_told() == 2


def test_tare_is_refused_while_somebody_presses(bench: Start) -> None:
    b = bench(tare_scans=10).tare()
    reference = b.ask("status")["reference"]
    errors: list[ControlError] = []

    def ask() -> None:
        with pytest.raises(ControlError) as caught:
            b.ask("tare")
        errors.append(caught.value)

    asking = threading.Thread(target=ask)
    asking.start()
    load = 0.0
    while not errors:
        load += 0.02
        b.step(load=load)
    asking.join()
    assert errors[0].name == "tare_refused"
    assert "take the load off" in errors[0].next_step
    b.listener.event("tare_refused")
    assert b.ask("status")["reference"] == reference


def test_the_first_tare_waits_until_nobody_presses(bench: Start) -> None:
    b = bench(tare_scans=10)
    b.skin.introduce()
    for step in range(12):
        b.step(load=0.02 * step)
    b.listener.event("tare_refused")
    b.until(lambda: b.step() and b.ask("status")["state"] == "taring")
    for _ in range(20):
        b.step()
    b.listener.event("tared")


@pytest.mark.slow
def test_tare_without_data_says_so(bench: Start) -> None:
    b = bench()
    with pytest.raises(ControlError) as caught:
        b.ask("tare")
    assert caught.value.name == "no_data"


@pytest.mark.slow
def test_tier_and_budget_are_answered_when_they_are_in_force(
    bench: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control, "SETTLE_S", PATIENCE_S)
    b = bench(seconds=0.2).tare()
    for tier, budget_ms in [("levelset", 25.0), ("fit", 30.0), ("tikhonov", None)]:
        b.skin.scan()  # a frame that takes its time, and the commands come meanwhile
        assert b.ask("set_tier", tier=tier) == {"tier": tier}
        assert b.ask("status")["tier_requested"] == tier
        b.skin.scan()
        assert b.ask("set_budget", budget_ms=budget_ms) == {"budget_ms": budget_ms}
        status = b.ask("status")
        assert (status["tier_requested"], status["budget_ms"]) == (tier, budget_ms)
        assert status["plan"]["tier"] == tier


@pytest.mark.slow
def test_a_frame_that_takes_long_holds_up_no_command(
    bench: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_made, solve = threading.Event(), Memory.solve

    def slowly(*given: Any, **details: Any) -> Any:
        assert is_made.wait(PATIENCE_S)
        return solve(*given, **details)

    monkeypatch.setattr(Memory, "solve", slowly)
    b = bench()
    b.skin.introduce()
    b.skin.scan()
    b.until(lambda: b.ask("status")["scans"]["structure"])
    assert b.ask("set_tier", tier="fit") == {"tier": "fit"}
    assert b.ask("status")["frames"] == 0  # it is still being made
    is_made.set()
    b.until(lambda: b.ask("status")["tier_requested"] == "fit")


REFUSED: list[tuple[str, dict[str, Any], str]] = [
    ("make_coffee", {}, "unknown_command"),
    ("tare", {"scans": 3}, "bad_argument"),
    ("set_tier", {"tier": "best"}, "bad_argument"),
    ("set_tier", {}, "bad_argument"),
    ("set_budget", {"budget_ms": -1}, "bad_argument"),
    ("set_budget", {"budget_ms": 1e-300}, "bad_argument"),
    ("set_budget", {"budget_ms": "fast"}, "bad_argument"),
    ("record_start", {"path": 7}, "bad_argument"),
    ("record_start", {"path": ""}, "bad_argument"),
    ("record_start", {"path": "/tmp/skin.mcap"}, "bad_argument"),
    ("record_start", {"path": "../skin.mcap"}, "bad_argument"),
    ("record_start", {"path": "a/../../skin.mcap"}, "bad_argument"),
    ("record_start", {"path": "~/skin.mcap"}, "cannot_write"),
    ("record_start", {"path": ".bashrc"}, "bad_argument"),
    ("record_start", {"path": ".mcap"}, "bad_argument"),
    ("record_start", {"path": "evil.desktop"}, "bad_argument"),
    ("record_start", {"path": "a\0b.mcap"}, "bad_argument"),
    ("record_start", {"path": "\x1b[2J.mcap"}, "bad_argument"),
    ("record_start", {"path": "x" * 300 + ".mcap"}, "cannot_write"),
    ("record_stop", {}, "not_recording"),
]
MALFORMED = [
    b"",
    b"\xc1",
    b"hello",
    msgpack.packb([1, 2]),
    msgpack.packb({"schema": 2, "command": "status"}),
    msgpack.packb({"schema": 1, "command": 5}),
    msgpack.packb({"schema": 1, "command": "status", "arguments": [1]}),
    msgpack.packb({"schema": 1, "command": "record_start", "path": "argument.mcap"}),
]


def test_what_cannot_be_done_is_refused_by_name(bench: Start, connect: Start) -> None:
    b = bench()
    for command, arguments, name in REFUSED:
        with pytest.raises(ControlError) as caught:
            b.ask(command, **arguments)
        assert caught.value.name == name, (command, arguments)
        assert caught.value.next_step
    socket = connect(zmq.REQ, b.daemon.control_address)
    for body in MALFORMED:
        socket.send(body)
        assert socket.poll(30_000)
        with pytest.raises(ControlError) as caught:
            decode_reply(socket.recv())
        assert caught.value.name == "malformed_message", body
        assert caught.value.next_step
    dealer = connect(zmq.DEALER, b.daemon.control_address)
    dealer.send_multipart([b"", encode_request("status", {})])
    assert dealer.poll(30_000)
    empty, reply = dealer.recv_multipart()
    assert empty == b""
    assert decode_reply(reply)["state"]
    dealer.send_multipart([b"", b"x" * 1_000_000])  # cut off, not answered
    assert not dealer.poll(200)
    assert b.ask("status")["state"] == "waiting_for_data"


@pytest.mark.parametrize(("purpose", "transport"), [("stream", "tcp"), ("control", "ipc")])
def test_an_address_in_use_is_refused_and_nothing_is_left_open(
    bench: Start, tmp_path: Any, purpose: str, transport: str
) -> None:
    other = f"ipc://{tmp_path}/socket" if transport == "ipc" else "tcp://127.0.0.1:0"
    b = bench(**{purpose: other})
    taken = getattr(b.daemon, f"{purpose}_address")
    settings = {**LOCAL, "baseline": {"track": False}, purpose: taken}
    second = Daemon(load_config(ports=["/dev/null"], **settings), reconstructor=UNUSED)
    before = threading.active_count()
    with pytest.raises(AddressError, match="in use") as caught:
        second.start()
    assert f"--{purpose}" in caught.value.next_step
    assert threading.active_count() == before
    assert b.ask("status")  # the first one goes on

"""What subscribers get: envelopes, late joiners, slow readers, and nothing that nobody wants."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
import pytest
import zmq
from daemon_bench import REST
from fixture_types import Start
from tactomo.service import status
from tactomo_client import subscribe
from tactomo_client.messages import array_from_wire, decode_message, topic
from waiting import PATIENCE_S


def test_every_message_carries_the_envelope_and_a_scan_its_volts(bench: Start) -> None:
    b = bench()
    before_ns = time.monotonic_ns()
    b.tare()
    b.step(load=0.1)
    frame = b.listener.of("map")[-1]
    assert before_ns < frame["acquired_monotonic_ns"] < time.monotonic_ns()
    assert abs(frame["acquired_realtime_ns"] - time.time_ns()) < 60e9
    assert 0 < frame["age_ns"] < 10e9
    assert frame["tier"] == "tikhonov"
    assert frame["misfit"] == 1.0
    for kind in ("map", "contacts", "scan", "status", "event"):
        messages = b.listener.of(kind)
        assert {m["session"] for m in messages} == {b.daemon.session}
        sequence = [m["sequence"] for m in messages]
        if kind == "status":  # the last one is said again to whoever joins
            sequence = list(dict.fromkeys(sequence))
        assert sequence == list(range(sequence[0], sequence[0] + len(sequence)))
    volts = {"magnitude": 1.1 * REST, "structure": 0.9 * REST}
    counter = b.skin.scan(volts=volts)
    scan = b.listener.wait("scan", lambda s: s["scan_counter"] == counter)
    for channel, sent in volts.items():
        assert array_from_wire(scan[channel]) == pytest.approx(sent, abs=2e-5)
    assert (scan["tier"], scan["misfit"]) == (None, None)


def test_frames_before_the_first_reference_say_so(bench: Start) -> None:
    b = bench()
    b.skin.introduce()
    frame = b.step()
    assert frame["flags"] == ["no_reference"]
    assert frame["map"] is None
    assert frame["contacts"] == []


def test_the_client_reads_maps_and_contacts(bench: Start) -> None:
    b = bench().tare()
    with (
        subscribe("left", address=b.daemon.stream_address, timeout_s=30) as maps,
        subscribe("left", address=b.daemon.stream_address, kind="contacts", timeout_s=30) as few,
    ):
        b.until(lambda: b.ask("status")["subscribers"] == 7)
        b.step(load=0.1)
        frame = next(maps)
        assert frame.map is not None
        assert frame.map.shape == (51, 51)
        assert frame.x_mm == pytest.approx((-75, 75))
        (contact,) = next(few).contacts
        assert (contact.x_mm, contact.y_mm) == pytest.approx((10, -20))
        assert contact.area_mm2 == pytest.approx(700)
        assert contact.pressure_sigma_kpa is None
        assert frame.contacts == (contact,)


@pytest.mark.slow
def test_a_late_joiner_gets_the_status_at_once(bench: Start, connect: Start) -> None:
    b = bench().tare()
    b.until(lambda: len(b.listener.of("status")) >= 2)

    def is_repeated() -> bool:
        # The next one is due in a second; a repetition comes at once and has the number of the
        # last. A joiner whom a busy computer holds up for that second gets a new one.
        last: int = b.listener.of("status")[-1]["sequence"]
        socket = connect(zmq.SUB, b.daemon.stream_address, topic("left", "status"))
        assert socket.poll(30_000)
        came: int = decode_message(socket.recv()).fields["sequence"]
        socket.close()
        return came == last

    b.until(is_repeated)
    b.until(lambda: b.ask("status")["subscribers"] == 5)


def test_a_frame_that_was_heard_is_counted(bench: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    b = bench().tare()
    publish, is_asked = b.daemon._publisher.publish, threading.Event()

    def held_up(kind: str, *given: Any) -> None:
        publish(kind, *given)
        assert kind != "map" or is_asked.wait(PATIENCE_S)

    monkeypatch.setattr(b.daemon._publisher, "publish", held_up)
    b.step()
    assert b.ask("status")["frames"] == 4
    is_asked.set()


def test_a_map_is_made_for_subscribers_alone(bench: Start) -> None:
    b = bench().tare()
    b.step()  # its map has come, and so have all before it
    # Unsubscribe from maps; contacts and the rest go on.
    b.listener.socket.setsockopt(zmq.UNSUBSCRIBE, topic("left", "map"))
    b.until(lambda: b.ask("status")["subscribers"] == 4)
    counter = b.skin.scan()
    b.listener.wait("contacts", lambda c: c["scan_counter"] == counter)
    b.listener.socket.setsockopt(zmq.SUBSCRIBE, topic("left", "map"))
    b.until(lambda: b.ask("status")["subscribers"] == 5)
    b.step()
    maps = b.listener.of("map")
    assert counter not in [m["scan_counter"] for m in maps]
    # None was numbered that was not sent; a busy computer may make two of a scan.
    assert [m["sequence"] for m in maps] == list(range(1, len(maps) + 1))


@pytest.mark.slow
def test_a_stalled_subscriber_slows_nobody(bench: Start, connect: Start) -> None:
    b = bench().tare()
    connect(zmq.SUB, b.daemon.stream_address, b"", rcvhwm=1)
    b.until(lambda: b.ask("status")["subscribers"] == 6)
    start = b.skin.counter
    for _ in range(400):  # some 12 MB of maps, far more than the stalled one is kept
        b.step(load=0.1)
    maps = [m for m in b.listener.of("map") if m["scan_counter"] > start]
    assert len(maps) == 400
    assert np.percentile([m["age_ns"] for m in maps], 50) < 500e6


def test_the_newest_scan_wins_when_the_reconstruction_lags(bench: Start) -> None:
    b = bench(seconds=0.05).tare()
    start = b.skin.counter
    for _ in range(40):
        b.skin.scan()
    frame = b.listener.frame(b.skin.counter)
    assert frame["age_ns"] < 10e9
    frames = [m for m in b.listener.of("map") if m["scan_counter"] > start]
    assert len(frames) < 40
    b.listener.event("scans_dropped")
    assert b.ask("status")["dropped_scans"] == 40 - len(frames)


def test_where_frames_lag_the_state_is_late_and_not_that_no_scans_come(
    bench: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(status, "STALE_S", 0.2)
    b = bench().tare()
    for _ in range(5):
        b.step()
    b.daemon._imaging._reconstructor.seconds = 1.5  # far above the frames' pace until now

    def state() -> str:
        b.skin.scan()
        return str(b.ask("status")["state"])

    b.until(lambda: state() == "late")
    b.until(lambda: b.ask("status")["state"] == "stale")  # and nothing comes any more


@pytest.mark.slow
def test_a_reconstruction_that_fails_costs_its_frame_alone(
    bench: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    b = bench().tare()
    memory = b.daemon._imaging._reconstructor
    solve = memory.solve

    def fail_once(*_: Any, **__: Any) -> Any:
        memory.solve = solve
        raise ZeroDivisionError("a mistake")

    memory.solve = fail_once
    b.skin.scan()
    assert "ZeroDivisionError" in b.listener.event("reconstruction_failed")["detail"]
    assert b.step(load=0.1)["map"] is not None

"""Subscriptions against a real XPUB socket, in this process and in another."""

from __future__ import annotations

import dataclasses
import gc
import signal
import subprocess
import sys
import time
import weakref
from dataclasses import replace
from typing import Any, assert_type

import numpy as np
import pytest
from tactomo_client import (
    Answer,
    Contact,
    ControlError,
    Event,
    Frame,
    MessageError,
    Status,
    StreamTimeout,
    Subscription,
    aio,
    subscribe,
)
from tactomo_client.fake import FakeSensor
from waiting import wait_until

CONTACT = Contact(
    id=3,
    x_mm=10.0,
    y_mm=-20.0,
    area_mm2=700.0,
    magnitude=0.15,
    magnitude_sigma=0.01,
    pressure_kpa=170.0,
)
RAMP = np.tile(np.linspace(0, 1, 51, dtype=np.float32), (51, 1))
# Far apart, for on a busy computer what was published this moment is some tenths of a second old.
STALE_S, OLD_NS = 10.0, 20_000_000_000


@pytest.mark.parametrize(
    ("known", "answer"),
    [
        ({"pressure_kpa": 170.0}, Answer.YES),
        ({"pressure_kpa": 120.0, "peak_kpa": 150.0, "max_kpa": 170.0}, Answer.YES),
        ({"pressure_kpa": 145.0, "max_kpa": 152.0}, Answer.CANNOT_TELL),
        ({"pressure_kpa": 140.0, "max_kpa": 146.0}, Answer.NO),
        ({"pressure_kpa": None, "pressure_range": "below", "max_kpa": 134.0}, Answer.NO),
        ({"pressure_kpa": None, "pressure_range": "below"}, Answer.CANNOT_TELL),
        ({"pressure_kpa": 120.0, "pressure_range": "above"}, Answer.CANNOT_TELL),
    ],
)
def test_a_contact_exceeds_a_limit_or_not_or_nobody_can_tell(
    known: dict[str, Any], answer: Answer
) -> None:
    assert replace(CONTACT, **known).exceeds(150) is answer


@pytest.mark.parametrize("answer", Answer)
def test_no_answer_is_taken_for_another_by_a_bare_if(answer: Answer) -> None:
    with pytest.raises(TypeError, match=r"Answer\.YES"):
        bool(answer)


def test_an_old_frame_or_one_that_misses_touches_answers_no_question(sensor: FakeSensor) -> None:
    known: tuple[list[str], ...] = ([], ["magnitude_missing", "electrode_fault"])
    unknown = (["magnitude_missing", "no_usable_scan"], ["reference_disputed"], ["of_tomorrow"])
    with subscribe("left", address=sensor.address, timeout_s=10, stale_after_s=STALE_S) as frames:
        sensor.wait_for_subscriber()
        for flags in (*known, *unknown):
            sensor.publish(flags=flags)
            frame = next(frames)
            assert frame.is_known == (flags in known)
            assert frame.exceeds(150) is (Answer.CANNOT_TELL if flags else Answer.NO)
            sensor.publish(flags=flags, acquired_monotonic_ns=time.monotonic_ns() - OLD_NS)
            frame = next(frames)
            assert not frame.is_known
            assert frame.exceeds(150) is Answer.CANNOT_TELL
        sensor.publish([CONTACT], flags=["misfit_high"])
        assert next(frames).exceeds(150) is Answer.YES


def newest_sequence(frames: Subscription[Frame]) -> int:
    frame = frames.latest()
    return 0 if frame is None else frame.sequence


def test_a_frame_arrives_typed_and_cannot_be_changed(sensor: FakeSensor) -> None:
    with subscribe("left", address=sensor.address, timeout_s=10) as frames:
        assert sensor.wait_for_subscriber() == b"left/map\0"
        sensor.publish([CONTACT], map=RAMP, pressure_kpa=200 * RAMP, flags=["misfit_high"])
        frame = next(frames)
    assert (frame.sensor, frame.session, frame.sequence) == ("left", sensor.session, 1)
    assert frame.scan_counter == 1
    assert frame.flags == {"misfit_high"}
    assert (frame.tier, frame.misfit) == ("levelset", 1.0)
    assert frame.contacts == (CONTACT,)
    assert frame.map is not None
    assert frame.pressure_kpa is not None
    np.testing.assert_array_equal(frame.map, RAMP)
    np.testing.assert_array_equal(frame.pressure_kpa, 200 * RAMP)
    assert frame.structure is None
    assert (frame.x_mm, frame.y_mm) == ((-75.0, 75.0), (-75.0, 75.0))
    with pytest.raises(ValueError, match="read-only"):
        frame.map[0, 0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        frame.sequence = 2  # type: ignore[misc]
    unknown = replace(CONTACT, magnitude=None, magnitude_sigma=None, pressure_kpa=None)
    with subscribe("left", address=sensor.address, kind="contacts", timeout_s=10) as frames:
        assert sensor.wait_for_subscriber() == b"left/contacts\0"
        sensor.publish([unknown])
        frame = next(frames)
    assert frame.map is None  # contacts alone need no images
    assert frame.contacts == (unknown,)


def test_one_sensor_does_not_hear_another() -> None:
    with FakeSensor("left2") as other, subscribe("left", address=other.address) as frames:
        other.wait_for_subscriber()
        other.publish([CONTACT])
        other.sensor = "left"
        other.publish()
        assert next(frames).contacts == ()


def test_latest_only_skips_what_a_busy_caller_missed(sensor: FakeSensor) -> None:
    with subscribe("left", address=sensor.address, latest_only=True, timeout_s=10) as frames:
        sensor.wait_for_subscriber()
        for _ in range(200):
            sensor.publish(map=RAMP)
        seen = [next(frames).sequence]
        while seen[-1] < 200:
            seen.append(next(frames).sequence)
        assert len(seen) < 200  # how many were waiting at each call is the network's affair
        assert frames.missed == 200 - seen[0] - (len(seen) - 1)
        assert seen == sorted(seen)


def test_frames_come_in_order_gaps_are_counted_and_latest_never_waits(sensor: FakeSensor) -> None:
    with subscribe("left", address=sensor.address, timeout_s=10) as frames:
        assert frames.latest() is None
        assert frames.is_stale
        sensor.wait_for_subscriber()
        for sequence in (1, 2, 3, 7):
            sensor.publish(sequence=sequence)
        assert [next(frames).sequence for _ in range(4)] == [1, 2, 3, 7]
        assert frames.missed == 3
        for sequence in (8, 9):
            sensor.publish(sequence=sequence)
        wait_until(lambda: newest_sequence(frames) == 9)
        assert newest_sequence(frames) == 9


def test_malformed_messages_are_counted_and_skipped(sensor: FakeSensor) -> None:
    good = {"scan_counter": 1, "contacts": [], "x_mm": [-75.0, 75.0], "y_mm": [-75.0, 75.0]}
    contact = dataclasses.asdict(CONTACT)
    bad: list[dict[str, object]] = [
        {"map": {"shape": [51, 51], "dtype": "<f4", "data": b"short"}},
        {"map": np.zeros(51, np.float32)},
        {"map": np.zeros((51, 51), np.float64)},
        {"contacts": None},
        {"contacts": [7]},
        {"contacts": [contact | {"id": "one"}]},
        {"contacts": [contact | {"x_mm": float("nan")}]},
        {"scan_counter": "1"},
        {"acquired_monotonic_ns": None},
        {"x_mm": [1]},
    ]
    with subscribe("left", address=sensor.address, timeout_s=10) as frames:
        sensor.wait_for_subscriber()
        sensor.send(b"left/map\0")
        sensor.send(b"left/map\0\xc1")
        for change in bad:
            sensor.publish_message("map", good | change)
        sensor.publish([CONTACT])
        assert next(frames).contacts == (CONTACT,)
        assert frames.malformed == 2 + len(bad)


def test_a_restarted_daemon_is_heard_again_and_seen(sensor: FakeSensor) -> None:
    with subscribe("left", address=sensor.address, timeout_s=30) as frames:
        sensor.wait_for_subscriber()
        sensor.publish(sequence=50)
        assert next(frames).session == sensor.session
        sensor.close()
        with FakeSensor("left", sensor.address) as restarted:
            # zmq renews a subscription from within the subscriber's own calls, so keep calling.
            def heard_again() -> bool:
                restarted.publish()
                return newest_sequence(frames) < 50

            wait_until(heard_again)
            newest = frames.latest()
    assert newest is not None
    assert newest.session == restarted.session != sensor.session
    assert frames.missed == 0


def test_malformed_messages_do_not_put_off_the_timeout(sensor: FakeSensor) -> None:
    def is_taken_in() -> bool:  # on a busy computer it may come after the time is over
        with pytest.raises(StreamTimeout, match=r"no map of sensor 'left'.*tactomo status"):
            next(frames)
        return frames.malformed == 1

    assert issubclass(StreamTimeout, TimeoutError)
    with subscribe("left", address=sensor.address, timeout_s=0.2) as frames:
        sensor.wait_for_subscriber()
        sensor.send(b"left/map\0")
        wait_until(is_taken_in)


def test_age_is_exact_on_one_computer(sensor: FakeSensor) -> None:
    with subscribe("left", address=sensor.address, timeout_s=10, stale_after_s=STALE_S) as frames:
        sensor.wait_for_subscriber()
        now_ns = time.monotonic_ns()
        sensor.publish(acquired_monotonic_ns=now_ns - OLD_NS, age_ns=0)
        sensor.publish(acquired_monotonic_ns=now_ns, age_ns=0)
        old, new = next(frames), next(frames)
        for frame, older_s in ((new, 0.0), (old, OLD_NS * 1e-9)):
            earliest_s = older_s + (time.monotonic_ns() - now_ns) * 1e-9
            age_s = frame.age_s
            latest_s = older_s + (time.monotonic_ns() - now_ns) * 1e-9
            assert earliest_s - 1e-6 <= age_s <= latest_s + 1e-6
        assert old.is_stale
        assert not new.is_stale
        # From another computer it starts at the age at publication.
        for age_ns in (OLD_NS, 3_000_000):
            sensor.publish(clock_id="elsewhere", acquired_monotonic_ns=17, age_ns=age_ns)
        old, new = next(frames), next(frames)
        assert old.is_stale
        assert not new.is_stale
        assert 0.003 <= new.age_s < STALE_S


def test_closing_ends_the_iteration(sensor: FakeSensor) -> None:
    frames = subscribe("left", address=sensor.address)
    sensor.wait_for_subscriber()
    sensor.publish()
    seen: list[Frame] = []
    for frame in frames:
        seen.append(frame)
        frames.close()
    assert len(seen) == 1
    frames.close()


def test_an_abandoned_subscription_closes_itself(sensor: FakeSensor) -> None:
    for _ in range(2):
        frames = subscribe("left", address=sensor.address)
        sensor.wait_for_subscriber()
        connection = weakref.ref(frames._connection)
        socket = frames._connection.owner
        del frames
        gc.collect()
        assert connection() is None
        assert socket.closed


def test_ctrl_c_interrupts_the_wait(sensor: FakeSensor) -> None:
    script = (
        "from tactomo_client import subscribe\n"
        "try:\n"
        f"    for frame in subscribe('left', address={sensor.address!r}):\n"
        "        print(frame.sequence, flush=True)\n"
        "except KeyboardInterrupt:\n"
        "    print('interrupted', flush=True)\n"
    )
    child = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    try:
        sensor.wait_for_subscriber(60)
        sensor.publish()
        assert child.stdout.readline() == "1\n"
        child.send_signal(signal.SIGINT)
        assert child.communicate(timeout=60)[0] == "interrupted\n"
    finally:
        child.kill()
        child.communicate()


def test_what_comes_has_the_type_that_was_asked_for(sensor: FakeSensor) -> None:
    """The types are for `mypy --strict` to check; here it runs."""
    with (
        subscribe("left", address=sensor.address, kind="contacts") as frames,
        subscribe("left", address=sensor.address, kind="status") as statuses,
        subscribe("left", address=sensor.address, kind="event", timeout_s=10) as events,
        subscribe("left", address=sensor.address, kind=("map", "event"), timeout_s=10) as news,
    ):
        assert_type(frames, Subscription[Frame])
        assert_type(statuses.latest(), Status | None)
        assert_type(news.wait(0.01), Frame | Status | Event | None)
        assert_type(aio.subscribe("left", kind="event"), aio.Subscription[Event])
        for _ in range(5):
            sensor.wait_for_subscriber()
        sensor.publish_message(
            "event", {"name": "port_lost", "severity": "error", "detail": "gone"}
        )
        assert_type(event := next(events), Event)
        assert (event.name, event.severity, event.detail) == ("port_lost", "error", "gone")
        assert next(news) == event


def test_a_status_is_stale_when_none_has_come_for_three_seconds(sensor: FakeSensor) -> None:
    with subscribe("left", address=sensor.address, kind="status", timeout_s=10) as statuses:
        sensor.wait_for_subscriber()
        sensor.publish_message("status", {"state": "running", "ports": [{"url": "/dev/x"}]})
        status = next(statuses)
        assert (status.state, status.ports[0].url) == ("running", "/dev/x")
        assert not statuses.is_stale
        old = dataclasses.replace(status, _received_ns=status._received_ns - 3_100_000_000)
        assert old.is_stale


def test_what_cannot_be_subscribed_to_is_named() -> None:
    with pytest.raises(MessageError, match="not a sensor name"):
        subscribe("left forearm")
    with pytest.raises(MessageError, match="kind='map', 'contacts'"):
        subscribe("left", kind="scan")  # type: ignore[call-overload]
    with pytest.raises(MessageError, match="or a tuple of some"):
        subscribe("left", kind=["status", "event"])  # type: ignore[call-overload]
    with pytest.raises(MessageError, match="latest_only keeps the newest message of one kind"):
        subscribe("left", kind=("map", "status"), latest_only=True)
    with pytest.raises(ControlError, match="cannot connect to '5560'"):
        subscribe("left", address="5560")


def test_the_client_starts_with_two_packages_alone() -> None:
    script = (
        "import sys, tactomo_client\n"
        "ours = {n for n in sys.modules if n.partition('.')[0].startswith('tactomo')}\n"
        "print(sorted(n for n in ours if n.partition('.')[0] != 'tactomo_client'))\n"
        "foreign = {n.partition('.')[0] for n, m in sys.modules.items()\n"
        "           if 'site-packages' in (getattr(m, '__file__', None) or '')}\n"
        "print(sorted(n for n in foreign if not n.startswith('_')))\n"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert run.stdout == "[]\n['msgpack', 'zmq']\n", run.stdout + run.stderr

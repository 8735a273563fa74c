"""A replay that is paused, stepped, moved, paced and begun again while it runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from daemon_bench import HELLO, LOCAL, Bench, Listener, Memory, scan
from fixture_types import Start
from tactomo.config import load_config
from tactomo.imaging.imaging import MOVED_BUDGET_MS
from tactomo.protocols import protocol_named
from tactomo.recordings.recording import Origin, open_recording
from tactomo.recordings.recording_writer import RecordingWriter
from tactomo.recordings.replay import Playback
from tactomo.service.daemon import Daemon
from tactomo.service.status import STALE_S
from tactomo_client import ControlError
from tactomo_client.messages import array_from_wire
from tactomo_models import load_description
from tactomo_protocol import Channel, Scan, encode


@pytest.fixture
def play(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    """Start a replay that is paused at its beginning: ``play(path, start_s=0, speed=1)``."""
    undo: list[Callable[[], None]] = []

    def start(path: Path, start_s: float = 0.0, speed: float = 1.0, seconds: float = 0.0) -> Bench:
        settings = {
            **LOCAL,
            "ports": open_recording(path).replay_urls(speed),
            "baseline": {"track": False},
        }
        memory: Any = Memory(seconds)
        daemon = Daemon(load_config(None, **settings), reconstructor=memory)
        assert daemon.playback is not None
        daemon.playback.steer(paused=True, speed=None, loop=None)
        if start_s:
            daemon.playback.move(start_s)
        daemon.start()
        undo.append(daemon.stop)
        # The stream keeps 64 messages for a subscriber that a busy computer does not let read.
        listener = Listener(daemon.stream_address, "left", ("map", "status", "event"))
        undo.append(listener.socket.close)
        listener.wait("status", lambda status: status["state"] == "paused")
        skin: Any = None
        return Bench(daemon, skin, listener)

    yield start
    for each in undo:
        each()


class Life(NamedTuple):
    """A recording of presses with a tare among them."""

    path: Path
    values: dict[int, float]
    """What each frame's map showed, by the counter of its scans."""
    times_s: dict[int, float]
    """When each frame was recorded."""
    tared: int
    """Counter of the first frame against the second reference."""


LIVES: dict[int, Life] = {}
"""By the number of ports; each is recorded once."""


@pytest.fixture(params=[pytest.param(1, marks=pytest.mark.slow), 2])
def life(
    request: pytest.FixtureRequest, bench: Start, tmp_path_factory: pytest.TempPathFactory
) -> Life:
    if request.param not in LIVES:
        folder = tmp_path_factory.mktemp("life")
        b = bench(ports=request.param, recording={"folder": folder}).tare()
        LIVES[request.param] = recorded(b, folder / "life.mcap")
    return LIVES[request.param]


def recorded(b: Bench, path: Path) -> Life:
    b.ask("record_start", path=path.name)
    first = b.skin.counter + 1
    for index in range(8):
        b.step(load=0.02 * index)
    answer = b.daemon._pipeline.tare()
    while not answer.done():
        b.step(load=0.05)
    tared = b.skin.counter + 1
    for index in range(8):
        b.step(load=0.2 - 0.01 * index)
    b.ask("record_stop")
    recording = open_recording(path)
    values = {f["scan_counter"]: value(f) for f in b.listener.of("map")}
    times = {m.scans[0].counter: m.clock_ns - recording.start_ns for m in recording.marks()}
    return Life(
        path,
        {counter: each for counter, each in values.items() if counter >= first},
        {counter: time_ns * 1e-9 for counter, time_ns in times.items()},
        tared,
    )


def value(frame: dict[str, Any]) -> float:
    return float("nan") if frame["map"] is None else float(array_from_wire(frame["map"])[0, 0])


def counters(b: Bench) -> list[int]:
    return [frame["scan_counter"] for frame in b.listener.of("map")]


# No faster than five times the recorded speed where frames are counted: the stream leaves out what
# a subscriber on a busy computer does not take.


def play_to_the_end(b: Bench, life: Life) -> None:
    b.until(lambda: b.ask("status")["state"] == "ended")
    b.until(lambda: counters(b)[-1:] == [max(life.values)])  # published, and not yet heard


def test_a_paused_replay_goes_on_frame_by_frame_and_then_to_its_end(play: Any, life: Life) -> None:
    path, values = life.path, life.values
    b = play(path)
    assert counters(b) == []
    for count in (1, 2, 3):
        b.ask("replay", step=True)
        b.until(lambda count=count: len(counters(b)) == count)
        b.until(lambda: b.ask("status")["replay"]["paused"])
    assert counters(b) == list(values)[:3]
    assert b.ask("status")["replay"]["exact"]
    position_s = b.ask("status")["replay"]["position_s"]
    assert 0 < position_s < b.ask("status")["replay"]["duration_s"]
    assert b.ask("status")["replay"]["position_s"] == position_s  # it stands still
    assert b.ask("replay", paused=False, speed=5.0)["speed"] == 5.0
    play_to_the_end(b, life)
    b.listener.event("replay_ended")
    told = [each for each in b.listener.of("event") if each["name"] == "replay_ended"]
    assert len(told) == 1  # not by each port
    assert counters(b) == list(values)
    np.testing.assert_array_equal([value(f) for f in b.listener.of("map")], list(values.values()))


@pytest.mark.parametrize("speed", [0, 5])
def test_a_moved_replay_goes_on_there_against_the_reference_of_then(
    play: Any, life: Life, speed: float
) -> None:
    path, values, times, tared = life
    known = list(values)
    b = play(path, speed=speed)
    b.ask("replay", paused=False)
    play_to_the_end(b, life)
    for number in (2, 7, len(known) - 3, 5):  # before the tare, after it, and back
        seen = len(counters(b))
        middle_s = (times[known[number - 1]] + times[known[number]]) / 2
        b.ask("replay", position_s=middle_s)
        b.until(lambda: b.ask("status")["state"] == "ended")
        b.until(lambda seen=seen: counters(b)[seen:] and counters(b)[-1] == known[-1])
        again = b.listener.of("map")[seen:]
        shown = known.index(again[0]["scan_counter"])
        # The scans may lie on both sides of the middle between two frames: then it is the next.
        assert shown in (number, number + 1)
        assert [f["scan_counter"] for f in again] == known[shown:]
        # Half of a frame is the frame before; the first one after a move or a tare has none.
        before = 0.0 if known[shown] == tared else values[known[shown - 1]]
        assert value(again[0]) == pytest.approx(values[known[shown]] - 0.5 * before, abs=1e-5)
    status = b.ask("status")
    assert [port["corrupt"] for port in status["ports"]] == [0] * len(status["ports"])
    tally = status["scan_tally"]
    assert tally["received"] == sum(n for name, n in tally.items() if name != "received")


def test_a_paused_replay_that_is_moved_shows_the_frame_there(play: Any, life: Life) -> None:
    known = list(life.values)
    b = play(life.path)
    for count, number in enumerate((6, len(known) - 3, 2), start=1):
        middle_s = (life.times_s[known[number - 1]] + life.times_s[known[number]]) / 2
        moved = b.ask("replay", position_s=middle_s)
        assert moved["position_s"] == pytest.approx(middle_s)
        b.until(lambda count=count: len(counters(b)) == count)
        frame = b.listener.of("map")[-1]
        assert frame["sequence"] == moved["maps_before"] + 1
        assert frame["scan_counter"] in known[number : number + 2]
        status = b.ask("status")
        assert (status["state"], status["replay"]["paused"]) == ("paused", True)
        assert status["replay"]["position_s"] == pytest.approx(middle_s, abs=0.5)
    b.ask("replay", position_s=1e9)  # the end shows the last frame
    b.until(lambda: counters(b)[-1] == known[-1])


def test_the_first_frame_after_a_move_has_the_time_to_be_found_anew(play: Any, life: Life) -> None:
    b = play(life.path)
    b.ask("replay", position_s=life.times_s[list(life.values)[5]])
    b.until(lambda: len(counters(b)) == 1)
    b.ask("replay", step=True)
    b.until(lambda: len(counters(b)) == 2)
    assert b.daemon._pipeline._imaging._reconstructor.budgets_s == [MOVED_BUDGET_MS / 1e3, None]


def test_a_replay_does_not_run_ahead_of_who_reads_it(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 100.0
    monkeypatch.setattr("time.monotonic_ns", lambda: round(now_s * 1e9))
    playback = Playback(0, 10 * 10**9, 2.0, 10 * 10**9)
    assert playback.wait_until_due(0, 0.0, 0)
    now_s += 0.5
    assert playback.wait_until_due(900_000_000, 0.0, 0)  # 50 ms late
    assert playback.fields()["position_s"] == pytest.approx(1.0)
    now_s += 3.0  # whoever reads was busy
    assert playback.wait_until_due(1_100_000_000, 0.0, 0)
    assert playback.fields()["position_s"] == pytest.approx(1.1)
    assert not playback.wait_until_due(1_200_000_000, 0.0, 0)
    now_s += 0.05
    assert playback.wait_until_due(1_200_000_000, 0.0, 0)


@pytest.mark.slow
def test_what_the_ports_had_read_before_a_move_is_left_out(play: Any, life: Life) -> None:
    b = play(life.path, speed=0, seconds=0.05)  # the ports are far ahead of the frames
    b.ask("replay", paused=False)
    b.until(lambda: len(counters(b)) >= 3)
    b.ask("replay", position_s=0.0)
    play_to_the_end(b, life)
    assert counters(b)[-len(life.values) :] == list(life.values)
    assert len(counters(b)) < 2 * len(life.values) - 3
    tally = b.ask("status")["scan_tally"]
    assert tally["received"] == sum(n for name, n in tally.items() if name != "received")


@pytest.fixture
def torn(tmp_path: Path) -> Path:
    """A recording without marks, whose reads end anywhere in a packet."""
    path = tmp_path / "torn.mcap"
    dual_scans = [encode(scan(c, n)) for n in range(1, 81) for c in Channel]
    stream = encode(HELLO) + b"".join(dual_scans)
    writer = RecordingWriter(path, Origin("left", "paper_square", "", ("/dev/x",), "0"))
    for index in range(0, len(stream), 300):
        at_ns = 10**18 + index * 4 * 10**9 // len(stream)
        writer.write("port/0", stream[index : index + 300], at_ns, at_ns)
    writer.flush()
    writer.close()
    return path


@pytest.mark.slow
def test_a_step_gives_one_frame_of_a_read_that_brought_several(play: Any, tmp_path: Path) -> None:
    path = tmp_path / "coarse.mcap"
    writer = RecordingWriter(path, Origin("left", "paper_square", "", ("/dev/x",), "0"))
    writer.write("port/0", encode(HELLO), 10**18, 10**18)
    for first in range(1, 13, 4):
        read = b"".join(encode(scan(c, n)) for n in range(first, first + 4) for c in Channel)
        at_ns = 10**18 + first * 5 * 10**7
        writer.write("port/0", read, at_ns, at_ns)
    writer.flush()
    writer.close()
    b = play(path)
    for count in range(1, 13):
        b.ask("replay", step=True)
        b.until(lambda count=count: len(counters(b)) >= count)
        assert counters(b) == list(range(1, count + 1))
        assert count == 12 or b.ask("status")["state"] == "paused"
    b.until(lambda: b.ask("status")["state"] == "ended")


def test_a_replay_that_goes_on_is_not_stale_before_its_next_frame(play: Any, life: Life) -> None:
    b = play(life.path)
    b.ask("replay", step=True)
    b.until(lambda: len(counters(b)) == 1)
    time.sleep(STALE_S + 0.1)
    b.ask("replay", paused=False, speed=0.01)
    assert b.ask("status")["state"] == "running"


def test_the_end_is_told_at_once(play: Any, life: Life, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tactomo.stream.publisher.STATUS_PERIOD_S", 1000.0)
    b = play(life.path, speed=5)
    b.ask("replay", paused=False)
    b.listener.wait("status", lambda status: status["state"] == "ended")


@pytest.mark.slow
def test_a_move_into_the_middle_of_a_packet_is_no_damage(play: Any, torn: Path) -> None:
    b = play(torn)
    b.ask("replay", paused=False)
    for position_s in (1.003, 2.101, 0.507):
        seen = len(counters(b))
        b.until(lambda seen=seen: len(counters(b)) > seen + 2)
        b.ask("replay", position_s=position_s)
    b.ask("replay", speed=5.0)
    b.until(lambda: b.ask("status")["state"] == "ended")
    b.until(lambda: counters(b)[-1:] == [80])
    events = b.ask("status")["events"]["counts"]
    assert not {"corrupt_packets", "device_clock_jumped", "device_restarted"} & events.keys()
    assert b.ask("status")["ports"][0]["corrupt"] == 0


def test_a_replay_that_loops_begins_again(play: Any, life: Life) -> None:
    path, values = life.path, life.values
    b = play(path, speed=5)
    b.ask("replay", loop=True, paused=False)
    b.until(lambda: counters(b).count(list(values)[-1]) >= 3)
    b.ask("replay", loop=False)
    play_to_the_end(b, life)
    seen = b.listener.of("map")
    assert [f["scan_counter"] for f in seen] == list(values) * (len(seen) // len(values))
    np.testing.assert_array_equal(
        [value(f) for f in seen], [*values.values()] * (len(seen) // len(values))
    )


def test_a_replay_begins_where_it_is_told(play: Any, life: Life) -> None:
    path, values, times, _ = life
    late = list(values)[-4]
    b = play(path, start_s=times[late] - 1e-4)
    b.ask("replay", paused=False)
    play_to_the_end(b, life)
    assert counters(b)[0] in list(values)[-4:-2]
    assert counters(b)[-1] == list(values)[-1]


def test_only_a_replay_is_steered_and_only_where_that_makes_sense(
    bench: Start, play: Any, life: Life
) -> None:
    with pytest.raises(ControlError, match="nothing is replayed here") as refused:
        bench().ask("replay", paused=True)
    assert refused.value.name == "no_replay"
    b = play(life[0])
    for wrong in ({"speed": 0.0}, {"position_s": -1.0}, {"speed": float("nan")}, {"loop": 1}):
        with pytest.raises(ControlError) as refused:
            b.ask("replay", **wrong)
        assert refused.value.name == "bad_argument"
    b.ask("replay", position_s=1e308)  # beyond the end is the end
    b.ask("replay", position_s=1e9, paused=False)
    b.until(lambda: b.ask("status")["state"] == "ended")


def test_a_foreign_port_goes_on_in_the_middle_with_whole_scans_and_their_counters(
    tmp_path: Path,
) -> None:
    """Their lines say neither counter nor clock: what does comes every second."""
    description = load_description("openeit_disc")
    protocol = protocol_named("openeit", description)
    origin = Origin("left", "openeit_disc", description.sha256, ("/dev/x",), "0", "openeit")
    writer = RecordingWriter(tmp_path / "board.mcap", origin)
    numbers = ",".join(["1.5"] * description.measurements)
    stream = b"".join(b"magnitudes: %s,\r\n" % numbers.encode() for _ in range(60))
    begin_ns, whole = 10**18, []
    for index in range(0, len(stream), 300):  # a line is in several reads
        at_ns = begin_ns + index * 10**10 // len(stream)
        if index * 10 // len(stream) != (index - 300) * 10 // len(stream):
            writer.write("port/0/hello", protocol.preamble(), at_ns, at_ns)
        data = stream[index : index + 300]
        writer.write("port/0", data, at_ns, at_ns)
        whole += [(at_ns, each.counter) for each in protocol.feed(data) if isinstance(each, Scan)]
    writer.flush()
    writer.close()
    recording = open_recording(tmp_path / "board.mcap")
    for after_s in (0.0, 3.4, 7.9):
        from_ns = begin_ns + round(after_s * 1e9)
        again = recording.origin.new_protocol()
        found = [
            packet.counter
            for chunk in recording.chunks(0, from_ns)
            for packet in again.feed(chunk.data)
            if isinstance(packet, Scan)
        ]
        expected = [counter for at_ns, counter in whole if at_ns >= from_ns]
        assert found[-len(expected) :] == expected
        assert len(found) - len(expected) <= 60 / 10 + 1  # those since the preamble, a second back
        assert again.counts.corrupt == 0

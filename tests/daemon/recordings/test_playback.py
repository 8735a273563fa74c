"""A replay that is paused, stepped, moved, paced and begun again while it runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from daemon_bench import Bench, Listener, Memory
from tactomo.config import load_config
from tactomo.recordings.recording_set import open_replayable
from tactomo.service.daemon import Daemon
from tactomo_client import ControlError
from tactomo_client.messages import array_from_wire

Start = Callable[..., Any]


@pytest.fixture
def play(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    """Start a replay that is paused at its beginning: ``play(path, start_s=0, speed=1)``."""
    undo: list[Callable[[], None]] = []

    def start(path: Path, start_s: float = 0.0, speed: float = 1.0) -> Bench:
        settings = {
            "name": "left",
            "ports": open_replayable(path).replay_urls(speed),
            "stream": "tcp://127.0.0.1:0",
            "control": "tcp://127.0.0.1:0",
            "tare_scans": 3,
            "baseline": {"track": False},
        }
        memory: Any = Memory()
        daemon = Daemon(load_config(None, **settings), reconstructor=memory)
        assert daemon.playback is not None
        daemon.playback.steer(paused=True, speed=None, loop=None)
        if start_s:
            daemon.playback.move(start_s)
        daemon.start()
        undo.append(daemon.stop)
        listener = Listener(daemon.stream_address, "left")
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


@pytest.fixture(params=[1, 2])
def life(request: pytest.FixtureRequest, bench: Start, tmp_path: Path) -> Life:
    path = tmp_path / "life.mcap"
    b = bench(ports=request.param)
    b.tare()
    b.ask("record_start", path=str(path))
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
    recording = open_replayable(path)
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
    position_s = b.ask("status")["replay"]["position_s"]
    assert 0 < position_s < b.ask("status")["replay"]["duration_s"]
    assert b.ask("status")["replay"]["position_s"] == position_s  # it stands still
    assert b.ask("replay", paused=False, speed=5.0)["speed"] == 5.0
    play_to_the_end(b, life)
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
    b.ask("replay", position_s=1e9, paused=False)  # beyond the end is the end
    b.until(lambda: b.ask("status")["state"] == "ended")

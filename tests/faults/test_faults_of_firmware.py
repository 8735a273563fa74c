"""Firmware that frames its packets as it should and says what cannot be."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest
import zenoh
from daemon_process import SENSOR, DaemonProcess
from fixture_types import Figure, StartProcess
from foxglove_client import FoxgloveClient
from hostile_board import HostileBoard
from pty_skin import PtySkin, Scenes
from stream_rules import Subscriber
from tactomo.cli.children import ProcessGroup
from tactomo_client import subscribe
from tactomo_models import SensorDescription
from tactomo_ros2.live import run
from waiting import PATIENCE_S, wait_until

SHORT_S = 60.0
LONG_S = 3600.0


def try_hostile_board(
    skin: PtySkin, scenes: Scenes, daemon: DaemonProcess, figure: Figure, seconds: float
) -> None:
    """Play a hostile board to a daemon, hold all that it publishes against STREAM.md."""
    rss_mb = daemon.rss_mb
    board = HostileBoard(skin, scenes.rest, [*scenes.one, *scenes.two], seed=17)
    with Subscriber(daemon.stream) as subscriber:
        board.play(seconds, stop=lambda: not daemon.is_running)
        board.behave(2.0)
        heard = dict(subscriber.messages)
    counts = daemon.status()["events"]["counts"] if daemon.is_running else {}
    figure(
        f"{board.packets} packets in {len(board.acts)} acts; "
        f"{sum(heard.values())} messages, {len(subscriber.faults)} against the page; "
        f"{counts.get('reconstruction_failed', 0)} frames failed; "
        f"memory {daemon.rss_mb - rss_mb:+.1f} MB"
    )
    assert daemon.is_running, f"it ended in {board.acts[-3:]}"
    assert not subscriber.faults
    assert heard["map"] > 100
    assert "reconstruction_failed" not in counts


@pytest.mark.faults
@pytest.mark.fault(
    "A hostile board on {ports} port(s): valid checksums, absurd contents",
    "the daemon continues; every message conforms to STREAM.md",
    "for a second each: clocks, counters, rates, scales, samples, channels, sizes, versions and"
    " types at their limits and beyond, with a correct board in between; a subscriber to all "
    "kinds compares each message with the page's tables; recording with maps",
)
@pytest.mark.parametrize("ports", [1, 2])
@pytest.mark.timeout(2 * LONG_S)
def test_a_hostile_board(
    tmp_path: Path,
    description: SensorDescription,
    scenes: Scenes,
    start: StartProcess,
    figure: Figure,
    scale: float,
    ports: int,
) -> None:
    skin = PtySkin(tmp_path / "lines", description, ports)
    recording = {"file": str(tmp_path / "hostile.mcap"), "maps": True}
    daemon = start(skin.paths, recording=recording)
    try:
        try_hostile_board(skin, scenes, daemon, figure, max(SHORT_S, LONG_S * scale / 2))
    finally:
        skin.close()


Count = Callable[[], int]


@contextmanager
def foxglove(stream: str, _: Path) -> Iterator[Count]:
    """The bridge, and who looks through it."""
    with ProcessGroup() as group:
        bridge = group.start(
            *("bridge", "foxglove", SENSOR, "--foxglove-port", "0", "--announce"),
            *("--address", stream),
        ).wait_ready()
        with FoxgloveClient(bridge["url"]) as client:
            yield lambda: sum(client.counts().values())


@contextmanager
def zenoh_bridge(stream: str, folder: Path) -> Iterator[Count]:
    """The bridge to Zenoh, and a subscriber to all that it publishes."""
    at = {"endpoints": [f"unixsock-stream/{folder / 'router'}"]}
    apart = {"scouting": {"multicast": {"enabled": False}}}
    (folder / "robot.json5").write_text(json.dumps({**apart, "mode": "router", "listen": at}))
    (folder / "desk.json5").write_text(json.dumps({**apart, "mode": "client", "connect": at}))
    with ProcessGroup() as group:
        group.start(*("zenoh", "zenoh", "--from", stream, "--config", str(folder / "robot.json5")))
        wait_until((folder / "router").exists, "Zenoh to listen")
        session = zenoh.open(zenoh.Config.from_file(str(folder / "desk.json5")))
        heard: list[object] = []
        session.declare_subscriber("tactomo/**", heard.append)
        try:
            yield lambda: len(heard)
        finally:
            session.close()  # type: ignore[no-untyped-call]


@contextmanager
def ros(stream: str, _: Path) -> Iterator[Count]:
    """What the node publishes, without ROS."""
    ended = threading.Event()
    heard: list[object] = []
    failures: list[BaseException] = []

    def publish() -> None:
        try:
            with subscribe(SENSOR, kind=("map", "status"), address=stream, timeout_s=600.0) as skin:
                run(skin, heard.append, ended.is_set)
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=publish, name="ros")
    thread.start()
    yield lambda: len(heard)
    ended.set()
    thread.join(PATIENCE_S)
    assert not failures


@pytest.mark.faults
@pytest.mark.fault(
    "A hostile board behind another program: {door.__name__}",
    "the program continues, and passes frames on when the board behaves",
    "as above for a minute; for ROS 2 the node's messages, without ROS",
)
@pytest.mark.parametrize("door", [foxglove, zenoh_bridge, ros])
@pytest.mark.timeout(600)
def test_a_door_beside_a_hostile_board(
    tmp_path: Path,
    skin: PtySkin,
    scenes: Scenes,
    start: StartProcess,
    figure: Figure,
    door: Callable[[str, Path], AbstractContextManager[Count]],
) -> None:
    daemon = start(skin.paths)
    board = HostileBoard(skin, scenes.rest, [*scenes.one, *scenes.two], seed=18)
    with door(daemon.stream, tmp_path) as count:
        board.play(SHORT_S, stop=lambda: not daemon.is_running)
        board.behave(2.0)
        before = count()
        board.behave(5.0)
        after = count()
    figure(
        f"{board.packets} packets; {before} messages handed on, {after - before} in 5 s after it"
    )
    assert daemon.is_running
    assert before
    assert after > before

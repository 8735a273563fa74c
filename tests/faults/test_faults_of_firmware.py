"""Firmware that frames its packets as it should and says what cannot be."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from daemon_process import DaemonProcess
from hostile_board import HostileBoard
from pty_skin import PtySkin, Scenes
from stream_rules import Subscriber
from tactomo_models import SensorDescription

Start = Callable[..., DaemonProcess]
Figure = Callable[[str], None]

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
    "A hostile board on {ports} port(s): checksums that are right, contents that are absurd",
    "the daemon goes on; every message that it publishes keeps to STREAM.md",
    "acts of a second: clocks, counters, rates, scales, samples, channels, sizes, versions and "
    "types at their edges and beyond, a proper board in between; a subscriber to all kinds "
    "holds each message against the page's tables; recording with maps",
)
@pytest.mark.parametrize("ports", [1, 2])
@pytest.mark.timeout(2 * LONG_S)
def test_a_hostile_board(
    tmp_path: Path,
    description: SensorDescription,
    scenes: Scenes,
    start: Start,
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

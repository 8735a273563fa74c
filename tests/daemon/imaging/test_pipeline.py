"""The pipeline by itself: what becomes of scans that come, late or not at all."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tactomo.imaging import pipeline as module
from tactomo.imaging.pipeline import Pipeline
from tactomo.recordings.replay import Playback, Replay
from tactomo.scans import ChannelScan, DualScan, PortRead
from tactomo_protocol import Channel, ScanFlag
from waiting import PATIENCE_S, wait_until

BOTH = (Channel.MAGNITUDE, Channel.STRUCTURE)


def nothing() -> None:
    pass


class Frames:
    """In the place of imaging: keeps what it is given; `go` lets it take the next."""

    def __init__(self) -> None:
        self.counters: list[int] = []
        self.go = threading.Event()
        self.taken_ns = 0
        self.taring = SimpleNamespace(start=nothing, check=nothing, close=nothing)
        self.calibration = SimpleNamespace(meet=lambda _: None)

    def has_reference(self, _: Channel) -> bool:
        return True

    def process(self, dual: DualScan, *_: Any) -> None:
        assert self.go.wait(PATIENCE_S)
        self.counters.append(dual.counter)

    def share_processor(self, dropped: int) -> None:
        pass

    def tell_status(self) -> None:
        pass


def started(frames: Any, *, lossless: bool = False, replay: Replay | None = None) -> Pipeline:
    ports = 1 if replay is None else 2
    lossless = lossless or (replay is not None and replay.is_lossless)
    pipeline = Pipeline(
        frames, BOTH, ports, 10**8, lossless, replay, lambda: None, lambda *_, **__: None
    )
    pipeline.start()
    return pipeline


def scan(channel: Channel, counter: int, clock_ns: int, port: int = 0) -> ChannelScan:
    times = (0, clock_ns, clock_ns)
    return ChannelScan(channel, counter, 100 * counter, ScanFlag(0), np.zeros(1), *times, 0, port)


def dual(counter: int) -> PortRead:
    return PortRead(0, counter, tuple(scan(channel, counter, counter) for channel in BOTH))


def test_what_overflows_is_counted_as_received_and_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "QUEUED_DELIVERIES", 3)
    frames = Frames()
    pipeline = started(frames)
    pipeline.deliver(dual(0))
    wait_until(lambda: pipeline.turns > 1, "the first frame")
    for counter in range(1, 11):
        pipeline.deliver(dual(counter))
    assert pipeline.dropped == 7
    assert pipeline.received == dict.fromkeys(BOTH, 11)
    tally = pipeline.tally()
    assert tally["received"] == sum(tally.values()) - tally["received"] == 22
    frames.go.set()
    wait_until(lambda: pipeline.tally()["waiting"] == 0, "all of them")
    pipeline.stop()
    assert len(frames.counters) + pipeline.dropped == 11


def test_an_unpaced_replay_waits_for_the_slower_port() -> None:
    frames = Frames()
    frames.go.set()
    replay = Replay([], None, is_paced=False, playback=Playback(0, 0, 0, 0), protocol="tactomo")
    pipeline = started(frames, replay=replay)
    for port, channel in enumerate(BOTH):  # one is seconds ahead of the other
        for counter in range(5):
            at_ns = counter * 10**9
            pipeline.deliver(PortRead(port, at_ns, (scan(channel, counter, at_ns, port),)))
    for port in (0, 1):
        pipeline.deliver(PortRead(port, 0, (), has_ended=True))
    assert pipeline.finished.wait(PATIENCE_S)
    pipeline.stop()
    assert frames.counters == list(range(5))
    assert pipeline.incomplete == 0

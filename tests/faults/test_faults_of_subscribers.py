"""What subscribers and strangers may do without harm to anybody else."""

from __future__ import annotations

import os
import signal
import socket as posix
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np
import pytest
import zmq
from daemon_process import SENSOR, DaemonProcess
from ears import listening, percentiles
from fixture_types import Figure, Listen, Play, StartProcess
from pty_skin import Scenes, still
from tactomo_client import request
from tactomo_client.messages import decode_message, topic
from waiting import wait_until

STOPPED_S = 20.0
SUBSCRIBERS = 200

# Prints, for each map: sequence, age on arrival in milliseconds, frames missed so far.
SUBSCRIBER = """
import sys
from tactomo_client import subscribe
with subscribe("skin", address=sys.argv[1]) as frames:
    for frame in frames:
        print(frame.sequence, frame.age_s * 1e3, frames.missed, flush=True)
"""


@pytest.fixture
def subscriber() -> Iterator[Callable[[DaemonProcess], subprocess.Popen[str]]]:
    """A client in a process of its own, as users have it."""
    processes: list[subprocess.Popen[str]] = []

    def begin(daemon: DaemonProcess) -> subprocess.Popen[str]:
        processes.append(
            subprocess.Popen(
                [sys.executable, "-c", SUBSCRIBER, daemon.stream], stdout=subprocess.PIPE, text=True
            )
        )
        return processes[-1]

    yield begin
    for process in processes:
        process.kill()
        process.communicate()


@pytest.mark.faults
@pytest.mark.fault(
    "A subscriber stopped by SIGSTOP for 20 s, beside a healthy one",
    "the healthy subscriber's latency stays; memory bounded; the stopped subscriber then gets "
    "current frames, and `sequence` shows the missed frames",
    "maps at 100/s, 3 MB/s, to two processes of the Python client",
)
def test_a_stopped_subscriber(
    tared: StartProcess,
    scenes: Scenes,
    play: Play,
    listen: Listen,
    figure: Figure,
    subscriber: Callable[[DaemonProcess], subprocess.Popen[str]],
) -> None:
    daemon = tared()
    stopped = subscriber(daemon)
    assert stopped.stdout is not None
    ears = listen(daemon, "map")
    play(still(scenes.rest), 100.0)
    stopped.stdout.readline()
    ears.wait(lambda _: True, "a map")
    time.sleep(5.0)
    before, rss_mb = len(ears.heard), daemon.rss_mb
    stopped.send_signal(signal.SIGSTOP)
    time.sleep(STOPPED_S)
    during, grown_mb = len(ears.heard), daemon.rss_mb - rss_mb
    stopped.send_signal(signal.SIGCONT)
    continued_s = time.monotonic()
    for line in stopped.stdout:
        _, age_ms, missed = line.split()
        if int(missed) > 0 and float(age_ms) < 100:
            break
    current_s = time.monotonic() - continued_s
    healthy = [heard.age_ms for heard in ears.heard[:before]]
    beside = [heard.age_ms for heard in ears.heard[before:during]]
    sequences = np.diff([heard.fields["sequence"] for heard in ears.heard])
    figure(
        f"healthy one: {percentiles(healthy)} before, {percentiles(beside)} beside it, none "
        f"missed; memory {grown_mb:+.1f} MB; "
        f"the stopped one current {current_s:.2f} s after SIGCONT, knows of {missed} missed"
    )
    assert (sequences == 1).all()
    assert np.median(beside) < 2 * np.median(healthy) + 2
    assert grown_mb < 30
    assert current_s < 2.0


@pytest.mark.faults
@pytest.mark.fault(
    f"{SUBSCRIBERS} subscribers",
    "all get every frame; memory grows by less than 100 MB",
    "maps at 20/s to 200 sockets, 120 MB/s in all; age on arrival at the last socket",
)
def test_many_subscribers(
    tared: StartProcess, scenes: Scenes, play: Play, listen: Listen, figure: Figure
) -> None:
    daemon = tared()
    rss_mb = daemon.rss_mb
    sockets = [listening(daemon.stream, topic(SENSOR, "map")) for _ in range(SUBSCRIBERS)]
    ears = listen(daemon, "contacts")
    wait_until(lambda: daemon.status()["subscribers"] == SUBSCRIBERS + 1, "all of them")
    playing = play(still(scenes.rest), 20.0)
    time.sleep(1.0)
    last_ms, got = [], np.zeros(SUBSCRIBERS, int)
    first: list[int] = []
    for _ in range(200):
        for index, socket in enumerate(sockets):
            assert socket.poll(5000), "a frame"
            data = socket.recv()
            got[index] += 1
        fields = decode_message(data).fields
        first.append(fields["sequence"])
        last_ms.append((time.monotonic_ns() - fields["acquired_monotonic_ns"]) * 1e-6)
    grown_mb = daemon.rss_mb - rss_mb
    playing.stop()
    published = [heard.published_age_ms for heard in ears.heard]
    for socket in sockets:
        socket.close()
    figure(
        f"published: {percentiles(published)}; arrived at the last: {percentiles(last_ms[20:])}; "
        f"memory {grown_mb:+.0f} MB"
    )
    assert (np.diff(first) == 1).all()
    assert grown_mb < 100


@pytest.mark.faults
@pytest.mark.fault(
    "A subscriber that subscribes and unsubscribes 10,000 times",
    "frames continue for other subscribers; memory, threads and descriptors constant; the count"
    " is right afterwards",
    "one socket as fast as it can, then 500 connections opened and closed",
)
def test_a_fickle_subscriber(
    tared: StartProcess, scenes: Scenes, play: Play, listen: Listen, figure: Figure
) -> None:
    daemon = tared()
    ears = listen(daemon)
    play(still(scenes.rest), 50.0)
    ears.wait(lambda _: True, "a frame")
    before = daemon.threads, daemon.descriptors, daemon.rss_mb
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    socket = context.socket(zmq.SUB)
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.SNDHWM, 0)
    socket.connect(daemon.stream)
    begin_s = time.monotonic()
    for number in range(10_000):
        prefix = topic(SENSOR, ("map", "status", "contacts")[number % 3])
        socket.setsockopt(zmq.SUBSCRIBE, prefix)
        socket.setsockopt(zmq.UNSUBSCRIBE, prefix)
    for _ in range(500):
        with context.socket(zmq.SUB) as other:
            other.setsockopt(zmq.LINGER, 0)
            other.setsockopt(zmq.SUBSCRIBE, b"")
            other.connect(daemon.stream)
    socket.setsockopt(zmq.SUBSCRIBE, b"last")
    wait_until(lambda: daemon.status()["subscribers"] == 2, "the count to be right")
    took_s = time.monotonic() - begin_s
    socket.close()
    context.term()
    wait_until(lambda: daemon.status()["subscribers"] == 1, "the count to be right again")
    wait_until(lambda: daemon.descriptors <= before[1], "the descriptors")
    gap_s = np.diff([heard.arrived_ns * 1e-9 for heard in ears.heard]).max()
    figure(
        f"in {took_s:.1f} s; longest gap between frames {gap_s * 1e3:.0f} ms; threads {before[0]} "
        f"and {daemon.threads}, descriptors {before[1]} and {daemon.descriptors}, memory "
        f"{daemon.rss_mb - before[2]:+.1f} MB"
    )
    assert daemon.threads == before[0]
    assert daemon.rss_mb - before[2] < 30
    assert gap_s < 0.5


def rubbish(rng: np.random.Generator) -> Iterator[list[bytes]]:
    """Messages of one part or more that are no requests, and some that nearly are."""
    yield [b""]
    yield [b"", b""]
    yield [b"\xc1"]
    yield [os.urandom(60_000)]
    yield [msgpack.packb({"schema": 1, "command": "tare" * 10_000})]
    yield [msgpack.packb({"schema": 1, "command": "set_budget", "arguments": {"budget_ms": [1]}})]
    yield [msgpack.packb([[[[[]]]]])]
    while True:
        yield [rng.bytes(int(rng.integers(0, 2000))) for _ in range(int(rng.integers(1, 5)))]


@pytest.mark.slow
@pytest.mark.fault(
    "The control socket and the stream fed garbage",
    "frames continue; requests are answered; memory constant",
    "2,000 messages of random parts and random bytes to the control socket, random subscriptions "
    "to the stream, and random bytes instead of ZeroMQ to both ports",
)
def test_garbage_on_the_sockets(
    tared: StartProcess, scenes: Scenes, play: Play, listen: Listen, figure: Figure
) -> None:
    daemon = tared()
    ears = listen(daemon)
    play(still(scenes.rest), 50.0)
    ears.wait(lambda _: True, "a frame")
    rss_mb, rng = daemon.rss_mb, np.random.default_rng(4)
    messages = rubbish(rng)
    dealer: Any = zmq.Context.instance().socket(zmq.DEALER)
    dealer.setsockopt(zmq.LINGER, 0)
    dealer.connect(daemon.control)
    xsub: Any = zmq.Context.instance().socket(zmq.XSUB)
    xsub.setsockopt(zmq.LINGER, 0)
    xsub.connect(daemon.stream)
    slowest_s = 0.0
    for number in range(2000):
        dealer.send_multipart(next(messages))
        xsub.send(rng.bytes(int(rng.integers(0, 3000))))
        if number % 100 == 0:
            for address in (daemon.control, daemon.stream):
                host, _, port = address.removeprefix("tcp://").rpartition(":")
                with posix.create_connection((host, int(port))) as raw:
                    raw.sendall(rng.bytes(5000))
            begin_s = time.monotonic()
            request("status", daemon.control, 5.0)
            slowest_s = max(slowest_s, time.monotonic() - begin_s)
    dealer.close()
    xsub.close()
    gap_s = np.diff([heard.arrived_ns * 1e-9 for heard in ears.heard]).max()
    figure(
        f"slowest answer meanwhile {slowest_s * 1e3:.0f} ms, longest gap between frames "
        f"{gap_s * 1e3:.0f} ms, memory {daemon.rss_mb - rss_mb:+.1f} MB"
    )
    assert daemon.is_running
    assert gap_s < 0.5
    assert daemon.rss_mb - rss_mb < 30

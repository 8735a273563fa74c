"""What is measured rather than broken: latency under load, idle processor time, a million scans."""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest
import zmq
from daemon_process import SENSOR
from ears import percentiles
from fixture_types import Figure, Listen, Play, StartProcess
from pty_skin import Playing, PtySkin, Scenes, Volts, moving, still
from stream_rules import Subscriber
from tactomo_client.messages import decode_message, topic
from waiting import wait_until

SETTLE_S = 3.0
IDLE_S = 60.0
IDLE_CPU = 0.03
SOAK_SCANS = 1_000_000
CONTACT_EVERY, CONTACT_FOR = 1000, 10
"""Of so many dual scans, so many in a row show a contact that moves."""
MEMORY_MB = 10.0
LATENCY_S = 100.0
THIRD = next(
    (
        folder / "tactomo-third"
        for folder in (Path("/sys/fs/cgroup/cpu"), Path("/sys/fs/cgroup"))
        if (folder / "cgroup.procs").exists()
    ),
    Path("/absent"),
)
"""Where control groups are: those of version 1, or of version 2."""

UNDER = {
    "usual priority": (),
    "nice -5": ("nice", "-n", "-5"),
    "SCHED_RR": ("chrt", "--rr", "10"),
    "a third of a core": ("sh", "-c", 'echo $$ > "$0/cgroup.procs" && exec "$@"', str(THIRD)),
}
SCENES = ("nothing pressed", "one still contact", "one sliding contact")
CASES = [
    *(
        (scene, rate, loops, "usual priority")
        for scene in SCENES
        for rate in (20, 100, 200)
        for loops in (0, 2)
    ),
    ("nothing pressed", 100, 2, "nice -5"),
    ("nothing pressed", 100, 2, "SCHED_RR"),
    ("nothing pressed", 100, 4, "usual priority"),
    ("one sliding contact", 20, 2, "nice -5"),
    ("two moving contacts", 10, 0, "usual priority"),
    *((scene, 20, 0, "a third of a core") for scene in SCENES),
    ("nothing pressed", 100, 0, "a third of a core"),
]


@pytest.mark.faults
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("scene", "rate", "loops", "under"), CASES)
@pytest.mark.measure(
    "Latency: {scene}, {rate}/s; {loops} busy loops, the daemon at {under}",
    "no promise",
    "see above",
)
def test_latency(
    tared: StartProcess,
    scenes: Scenes,
    play: Play,
    listen: Listen,
    figure: Figure,
    busy: Callable[[int], None],
    scale: float,
    scene: str,
    rate: int,
    loops: int,
    under: str,
) -> None:
    if UNDER[under] and os.geteuid() != 0:
        pytest.skip("only root may raise a priority, or bound a processor")
    with a_third_of_a_core() if under == "a third of a core" else nullcontext():
        daemon = tared(under=UNDER[under])
        busy(loops)
        ears = listen(daemon)
        volts = {
            "nothing pressed": lambda: still(scenes.rest),
            "one still contact": lambda: still(scenes.one[0]),
            "one sliding contact": lambda: moving(scenes.sliding(rate)),
            "two moving contacts": lambda: moving(scenes.two),
        }[scene]()
        playing = play(volts, rate)
        wait_until(daemon.knows_the_clocks, "the device's clock to be known", step_s=0.5)
        first, begin_s = len(ears.heard), time.monotonic()
        begin_cpu_s, dropped = daemon.cpu_s, daemon.status()["dropped_scans"]
        seconds = max(5.0, LATENCY_S * scale)
        wait_until(lambda: time.monotonic() - begin_s > seconds, "the time", 800.0, 0.1)
        heard = ears.heard[first:]
        cpu_ms = (daemon.cpu_s - begin_cpu_s) / len(heard) * 1e3
        dropped = daemon.status()["dropped_scans"] - dropped
        playing.stop()
        memory_mb = daemon.rss_mb
        daemon.kill()
    tiers = Counter(h.fields["tier"] for h in heard).most_common()
    figure(
        f"over {seconds:.0f} s: read {percentiles([h.read_age_ms for h in heard])}; published "
        f"{percentiles([h.published_age_ms for h in heard])}; arrived "
        f"{percentiles([h.age_ms for h in heard])}; {len(heard)} frames "
        f"({', '.join(f'{tier} {count}' for tier, count in tiers)}), {dropped} dropped; "
        f"{cpu_ms:.1f} ms of processor time a frame; {memory_mb:.0f} MB"
    )


@contextmanager
def a_third_of_a_core() -> Iterator[None]:
    """A group of processes that gets 2 ms of every 6: a core at a third of its clock."""
    try:
        THIRD.mkdir(exist_ok=True)
        if (THIRD / "cpu.max").exists():
            (THIRD / "cpu.max").write_text("2000 6000")
        else:
            (THIRD / "cpu.cfs_period_us").write_text("6000")
            (THIRD / "cpu.cfs_quota_us").write_text("2000")
    except OSError as error:
        pytest.skip(f"no group of processes can be bounded here: {error}")
    try:
        yield
    finally:
        THIRD.rmdir()


@pytest.mark.faults
@pytest.mark.parametrize("rate", [5, 20])
@pytest.mark.measure(
    "Processor time at {rate} Hz with nothing pressed",
    "below 3 % of a core at 5 Hz",
    "user and system time of the whole process over 60 s, one subscriber to contacts",
)
def test_idle_processor_time(
    tared: StartProcess,
    scenes: Scenes,
    play: Play,
    listen: Listen,
    figure: Figure,
    scale: float,
    rate: int,
) -> None:
    daemon = tared()
    listen(daemon)
    play(still(scenes.rest), rate)
    time.sleep(SETTLE_S)
    begin_cpu_s, begin_s = daemon.cpu_s, time.monotonic()
    time.sleep(max(5.0, IDLE_S * scale))
    share = (daemon.cpu_s - begin_cpu_s) / (time.monotonic() - begin_s)
    figure(f"{share:.2%} of a core")
    assert rate > 5 or share < IDLE_CPU


def soak_scene(scenes: Scenes, scans: int) -> Iterator[Volts]:
    """Mostly the bare skin, now and then a contact that moves."""
    path = moving(scenes.one)
    for number in range(scans):
        yield next(path) if number % CONTACT_EVERY < CONTACT_FOR else scenes.rest


class Newest:
    """A subscriber that keeps the newest message alone, however many there are."""

    def __init__(self, address: str) -> None:
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.SUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.CONFLATE, 1)
        self._socket.setsockopt(zmq.SUBSCRIBE, topic(SENSOR, "contacts"))
        self._socket.connect(address)

    def take(self) -> tuple[int, int]:
        """Return how many frames have been published and the newest one's counter."""
        assert self._socket.poll(60_000), "a frame"
        fields = decode_message(self._socket.recv()).fields
        return fields["sequence"], fields["scan_counter"]

    def close(self) -> None:
        self._socket.close()


def published_until(newest: Newest, counter: int) -> int:
    """Wait for the frame of a dual scan; return how many were published up to it."""
    return next(count for count, at in iter(newest.take, None) if at == counter)


def wait_for_sent(playing: Playing, scans: int) -> None:
    wait_until(lambda: len(playing.sent) >= scans, f"{scans} scans to be sent", 3600.0, 0.1)


@pytest.mark.faults
@pytest.mark.timeout(7200)
@pytest.mark.measure(
    "Soak: a million dual scans at full speed",
    "from 10 % on, memory constant (within 10 MB), threads and descriptors the same; every dual"
    " scan is published or counted as dropped; every message conforms to STREAM.md",
    "lossless over two pseudo-terminals; of each 1000 dual scans, 10 in a row have a moving "
    "contact",
)
def test_soak(
    tared: StartProcess, skin: PtySkin, scenes: Scenes, play: Play, figure: Figure, scale: float
) -> None:
    daemon = tared(lossless=True)
    newest = Newest(daemon.stream)
    subscriber = Subscriber(daemon.stream, may_miss=True)
    wait_until(lambda: daemon.status()["subscribers"] == 2, "the subscriptions")
    play(iter([scenes.rest]), None).join()
    before = published_until(newest, skin.counter - 1)
    dropped = daemon.status()["dropped_scans"]
    scans = max(5_000, round(SOAK_SCANS * scale))
    begin_s = time.monotonic()
    playing = play(soak_scene(scenes, scans), None)
    rss_mb, held = [], set()  # while nobody asks: a question's connection is a descriptor
    for tenth in range(1, 11):
        wait_for_sent(playing, scans * tenth // 10)
        rss_mb.append(daemon.rss_mb)
        # The fewest of some: whoever looks at /proc has a descriptor for that moment.
        held.add((daemon.threads, min(daemon.descriptors for _ in range(10))))
        print(
            f"  soak: {len(playing.sent)} dual scans, {time.monotonic() - begin_s:.0f} s, "
            f"{rss_mb[-1]:.1f} MB, {daemon.threads} threads, {daemon.descriptors} descriptors",
            file=sys.__stderr__,
            flush=True,
        )
    playing.join()
    published = published_until(newest, skin.counter - 1) - before
    took_s = time.monotonic() - begin_s
    status = daemon.status()
    newest.close()
    subscriber.close()
    dropped = status["dropped_scans"] - dropped
    threads = ", then ".join(f"{count} and {files}" for count, files in sorted(held))
    figure(
        f"{scans} sent = {published} published + {dropped} dropped in {took_s / 60:.1f} min "
        f"({scans / took_s:.0f}/s); memory {rss_mb[0]:.1f} MB at 10 %, {rss_mb[4]:.1f} at 50 %, "
        f"{rss_mb[9]:.1f} at 100 %; threads and descriptors {threads}; "
        f"{sum(subscriber.messages.values())} messages read, "
        f"{len(subscriber.faults)} against the page"
    )
    assert not subscriber.faults
    assert published + dropped == scans
    assert max(rss_mb) - rss_mb[0] < MEMORY_MB
    assert len(held) == 1

"""Faults between the skin and the daemon: cables, noise, devices of no use."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from daemon_process import DaemonProcess
from ears import Ears
from fixture_types import Figure, Listen, Play, StartProcess
from pty_skin import PtySkin, Scenes, still
from tactomo_client.messages import array_from_wire
from tactomo_protocol import Channel, encode
from waiting import wait_until

BACK_S = 1.0


def seconds_to_the_next_frame(ears: Ears, counter: int, begin_s: float) -> float:
    """Wait for a frame of both channels, of a dual scan after number `counter`."""
    frame = ears.wait(
        lambda heard: heard.fields["scan_counter"] > counter and not heard.fields["flags"],
        "a frame of both channels",
        max(0, len(ears.heard) - 5),
    )
    return frame.arrived_ns * 1e-9 - begin_s


def wait_until_lost(daemon: DaemonProcess) -> None:
    wait_until(
        lambda: not any(port["connected"] for port in daemon.status()["ports"]), "both ports' loss"
    )


def unplug_and_replug(times: int, daemon: DaemonProcess, skin: PtySkin, ears: Ears) -> list[float]:
    """Pull all cables and put them back; returns how long the frames took to come again."""
    out_s = np.random.default_rng(0).uniform(0.05, 0.5, times)
    took_s = []
    for pause_s in out_s:
        skin.unplug()
        wait_until_lost(daemon)
        time.sleep(pause_s)
        begin_s = time.monotonic()
        skin.plug()
        took_s.append(seconds_to_the_next_frame(ears, skin.counter, begin_s))
    return took_s


@pytest.mark.faults
@pytest.mark.timeout(600)
@pytest.mark.fault(
    "Both cables pulled and put back 100 times",
    "frames within 1 s; threads and descriptors as before",
    "both pseudo-terminals closed for 0.05 to 0.5 s and opened again under the same names, at "
    "20 dual scans/s",
)
def test_unplugged_and_replugged(
    tared: StartProcess, skin: PtySkin, scenes: Scenes, play: Play, listen: Listen, figure: Figure
) -> None:
    daemon = tared()
    ears = listen(daemon)
    play(still(scenes.rest))
    unplug_and_replug(3, daemon, skin, ears)
    before = daemon.threads, daemon.descriptors, daemon.rss_mb
    took_s = unplug_and_replug(100, daemon, skin, ears)
    after = daemon.threads, daemon.descriptors, daemon.rss_mb
    figure(
        f"median {np.median(took_s):.2f} s, worst {max(took_s):.2f} s; threads {before[0]} and "
        f"{after[0]}, descriptors {before[1]} and {after[1]}, memory {after[2] - before[2]:+.1f} MB"
    )
    assert max(took_s) < BACK_S
    assert after[:2] == before[:2]
    assert after[2] - before[2] < 10


class Corrupter:
    """Damages what a skin sends: a share of all bytes, in runs of `length`."""

    def __init__(self, skin: PtySkin, share: float, length: int) -> None:
        self.damaged: dict[int, set[Channel]] = {}
        self._rng = np.random.default_rng(2)
        self._start_share = share / length
        self._length = length
        self._skin = skin

    def say(self, volts: Any) -> int:
        """Send the next dual scan, damaged where chance has it."""
        skin = self._skin
        counter = skin.counter
        skin.counter += 1
        skin.attend()
        for channel, values in volts.items():
            data = encode(skin.scan(channel, counter, values))
            sent = self._damage(data)
            if sent != data:
                self.damaged.setdefault(counter, set()).add(channel)
            skin.send(skin.lines[channel], sent)
        return counter

    def _damage(self, data: bytes) -> bytes:
        hit = np.zeros(len(data), bool)
        for begin in np.flatnonzero(self._rng.random(len(data)) < self._start_share):
            hit[begin : begin + self._length] = True
        noise = self._rng.integers(0, 256, len(data), dtype=np.uint8)
        return np.where(hit, noise, np.frombuffer(data, np.uint8)).astype(np.uint8).tobytes()


@pytest.mark.parametrize(
    ("share", "length", "how"),
    [
        pytest.param(0.01, 50, "in runs of 50", marks=pytest.mark.faults),
        pytest.param(0.01, 1, "one here, one there", marks=pytest.mark.faults),
        pytest.param(0.5, 100, "in runs of 100", marks=pytest.mark.slow),
    ],
)
@pytest.mark.fault(
    "{share:.0%} of all bytes corrupted, {how}",
    "frames contain only intact scans, with the voltages sent; every intact scan is used or "
    "counted as dropped; frames of both channels within 1 s of the end",
    "500 dual scans at 100/s, with random bytes in place of sent bytes",
)
def test_corrupted_bytes(
    tared: StartProcess,
    skin: PtySkin,
    scenes: Scenes,
    listen: Listen,
    play: Play,
    figure: Figure,
    share: float,
    length: int,
    how: str,
) -> None:
    daemon = tared()
    ears = listen(daemon, "scan", "contacts")
    wait_until(lambda: daemon.status()["subscribers"] == 2, "the subscriptions")
    before = daemon.status()
    packets = sum(port["packets"] for port in before["ports"])
    sent: dict[tuple[int, Channel], Any] = {}
    plain, corrupter = skin.scan, Corrupter(skin, share, length)

    def scan(channel: Channel, counter: int, volts: Any) -> Any:
        made = plain(channel, counter, volts)
        sent[counter, channel] = made.volts(skin.hello(skin.lines[channel]).volts_per_count)
        return made

    skin.scan = scan  # type: ignore[method-assign]
    first = skin.counter
    for volts in [scenes.rest] * 500:
        corrupter.say(volts)
        time.sleep(0.01)
    last = skin.counter - 1
    time.sleep(0.3)
    begin_s = time.monotonic()
    play(still(scenes.rest))
    complete = ears.wait(
        lambda h: (
            h.kind == "contacts" and h.fields["scan_counter"] > last and not h.fields["flags"]
        ),
        "a frame without flags",
    )
    back_s = complete.arrived_ns * 1e-9 - begin_s
    status = daemon.status()
    published = [h for h in ears.of("scan") if first <= h.fields["scan_counter"] <= last]
    intact = {key for key in sent if first <= key[0] <= last} - {
        (counter, channel)
        for counter, channels in corrupter.damaged.items()
        for channel in channels
    }
    used = {
        (heard.fields["scan_counter"], channel)
        for heard in published
        for channel in Channel
        if heard.fields[channel] is not None
    }
    corrupt = sum(port["corrupt"] for port in status["ports"])
    dropped = status["dropped_scans"] - before["dropped_scans"]
    figure(
        f"{len(intact)} of 1000 scans intact, of {len({counter for counter, _ in intact})} dual "
        f"scans = {len(published)} published + {dropped} dropped; {corrupt} damaged packets "
        f"counted; whole again after {back_s:.2f} s"
    )
    for heard in published:
        for channel in Channel:
            volts = heard.fields[channel]
            if volts is not None:
                expected = sent[heard.fields["scan_counter"], channel]
                assert np.array_equal(array_from_wire(volts), expected)
    assert used <= intact
    assert len(published) + dropped == len({counter for counter, _ in intact})
    assert corrupt >= 1000 - len(intact)
    assert sum(port["packets"] for port in status["ports"]) - packets >= len(intact)
    assert back_s < BACK_S


@pytest.mark.faults
@pytest.mark.fault(
    "10 MB of noise on one of two ports",
    "frames of the other channel continue; memory constant; both channels within 1 s of the end",
    "random bytes as fast as they are read, the other port at 20 scans/s",
)
def test_a_burst_of_noise(
    tared: StartProcess, skin: PtySkin, scenes: Scenes, listen: Listen, play: Play, figure: Figure
) -> None:
    daemon = tared()
    ears = listen(daemon)
    rss_mb = daemon.rss_mb
    line = skin.lines[Channel.STRUCTURE]
    only = {Channel.MAGNITUDE: scenes.rest[Channel.MAGNITUDE]}
    playing = play(still(only))
    noise = np.random.default_rng(3).bytes(1_000_000)
    begin_s = time.monotonic()
    for _ in range(10):
        skin.send(line, noise)
    took_s = time.monotonic() - begin_s
    meanwhile = len(ears.heard)
    grown_mb = daemon.rss_mb - rss_mb
    playing.stop()
    last, end_s = skin.counter - 1, time.monotonic()
    play(still(scenes.rest))
    back = ears.wait(
        lambda h: h.fields["scan_counter"] > last and not h.fields["flags"], "both channels"
    )
    back_s = back.arrived_ns * 1e-9 - end_s
    figure(
        f"read in {took_s:.1f} s ({10 / took_s:.0f} MB/s), {meanwhile} frames meanwhile, memory "
        f"{grown_mb:+.1f} MB, both channels after {back_s:.2f} s"
    )
    assert meanwhile >= 0.7 * took_s * 20 - 3
    assert grown_mb < 20
    assert back_s < BACK_S


@pytest.mark.faults
@pytest.mark.parametrize(
    ("what", "event"), [("nothing", "device_silent"), ("noise at 2 kB/s", "device_garbled")]
)
@pytest.mark.fault(
    "A device whose port stays open but sends {what} for 10 s",
    "event {event} after 3 s; the daemon asks the device again and reopens the port; frames "
    "within 1 s of the device's return",
    "both ports, 20 dual scans/s before and after",
)
def test_a_device_of_no_use(
    tared: StartProcess,
    skin: PtySkin,
    scenes: Scenes,
    listen: Listen,
    play: Play,
    figure: Figure,
    what: str,
    event: str,
) -> None:
    daemon = tared()
    ears = listen(daemon)
    noise = np.random.default_rng(5)
    begin_s = time.monotonic()
    while time.monotonic() < begin_s + 10.0:
        for line in skin.each if event == "device_garbled" else []:
            skin.send(line, noise.bytes(100))
        time.sleep(0.05)
    last, speaks_s = skin.counter - 1, time.monotonic()
    play(still(scenes.rest))
    back_s = seconds_to_the_next_frame(ears, last, speaks_s)
    status = daemon.status()
    reopened = [port["reopened"] for port in status["ports"]]
    figure(f"ports opened anew {reopened} times; frames after {back_s:.2f} s")
    assert daemon.told(event)[0]["next_step"]
    assert min(reopened) >= 1
    assert back_s < BACK_S

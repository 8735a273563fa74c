"""What the computer does to the daemon: kills it, fills its disk, sets its clock, loses files."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import tactomo_models
from daemon_process import DaemonProcess
from ears import Ears, Heard
from pty_skin import Playing, Scenes, moving, still
from tactomo.recordings.recording import open_recording
from tactomo_protocol import Decoder, Scan
from waiting import wait_until

Start = Callable[..., DaemonProcess]
Play = Callable[..., Playing]
Listen = Callable[..., Ears]
Figure = Callable[[str], None]

KILLS = 10
DAY_S = 86_400
FAKETIME = "/usr/lib/{}-linux-gnu/faketime/libfaketimeMT.so.1"


def counters(path: Path) -> set[int]:
    """Return the counters of all dual scans of which a recording holds every scan."""
    recording = open_recording(path)
    found: list[set[int]] = []
    for port in range(len(recording.origin.ports)):
        decoder = Decoder()
        packets = (p for chunk in recording.chunks(port) for p in decoder.feed(chunk.data))
        found.append({packet.counter for packet in packets if isinstance(packet, Scan)})
    return set.intersection(*found)


@pytest.mark.faults
@pytest.mark.fault(
    "SIGKILL while recording, {loops} busy loops",
    "the file opens; at most the last 0.25 s are lost",
    f"{KILLS} daemons killed at a random moment, a contact that moves, 100 dual scans/s",
)
@pytest.mark.parametrize("loops", [0, 4])
def test_killed_while_recording(
    tared: Start,
    scenes: Scenes,
    play: Play,
    busy: Callable[[int], None],
    figure: Figure,
    tmp_path: Path,
    loops: int,
) -> None:
    lost_s = []
    busy(loops)
    for number in range(KILLS):
        path = tmp_path / f"killed-{number}.mcap"
        daemon = tared(recording={"sync_s": 0.3})  # else none comes before the end
        daemon.ask("record_start", path=path.name)
        playing = play(moving(scenes.one), 100.0)
        time.sleep(0.5 + np.random.default_rng(number).uniform(0, 0.5))
        killed_ns = time.monotonic_ns()
        daemon.kill()
        playing.stop()
        sent = {c: at for c, at in playing.sent.items() if at < killed_ns}
        kept = counters(path) & sent.keys()
        last = max(kept)
        assert kept >= {counter for counter in sent if counter <= last}
        lost_s.append((killed_ns - sent[last]) * 1e-9)
    figure(f"lost {np.median(lost_s):.2f} s (median), {max(lost_s):.2f} s (worst)")
    assert max(lost_s) < 0.25 + 0.05  # what was on its way from the pseudo-terminal


@pytest.fixture
def small_disk(tmp_path: Path, as_root: None) -> Iterator[Path]:
    """A disk of 5 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=5m", "tmpfs", folder])
    if mounted.returncode:
        pytest.skip("a tmpfs cannot be mounted here")
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


@pytest.mark.faults
@pytest.mark.fault(
    "A disk of 5 MB, full after seconds",
    "the recording ends with an event, frames continue at the same rate, and the written part "
    "opens; the recording resumes when there is room",
    "a tmpfs of 5 MB with another file of 2 MB on it, deleted later; maps recorded at 100/s",
)
def test_a_full_disk(
    tared: Start,
    scenes: Scenes,
    play: Play,
    listen: Listen,
    figure: Figure,
    small_disk: Path,
) -> None:
    other = small_disk / "other"
    other.write_bytes(os.urandom(2_000_000))
    daemon = tared(recording={"folder": str(small_disk), "at_start": True, "maps": True})
    ears = listen(daemon)
    playing = play(still(scenes.rest), 100.0)
    wait_until(lambda: daemon.told("recording_failed"), "the event")
    full, sent = len(ears.heard), len(playing.sent)
    time.sleep(2.0)
    frames, sent = len(ears.heard) - full, len(playing.sent) - sent
    kept = [len(counters(path)) for path in small_disk.glob("*.mcap")]
    other.unlink()
    freed_s = time.monotonic()
    wait_until(lambda: daemon.told("recording_resumed"), "the recording to go on")
    resumed_s = time.monotonic() - freed_s
    gap_s = np.diff([heard.arrived_ns * 1e-9 for heard in ears.heard]).max()
    figure(
        f"{frames} frames of {sent} in the 2 s after it, longest gap {gap_s * 1e3:.0f} ms; "
        f"{sum(kept)} dual scans kept; recording again {resumed_s:.1f} s after there was room"
    )
    assert frames > 0.9 * sent - 5
    assert gap_s < 0.5
    assert min(kept) > 0
    assert daemon.told("recording_failed")[0]["next_step"]


def wait_for_wall_clock(ears: Ears, ahead_s: float) -> None:
    """Wait for a frame by whose wall clock it is `ahead_s` later than here."""

    def is_set(heard: Heard) -> bool:
        wall_clock_s = float(heard.fields["acquired_realtime_ns"] * 1e-9)
        return abs(wall_clock_s - time.time() - ahead_s) < 60

    ears.wait(is_set, f"a wall clock {ahead_s:g} s ahead")


@pytest.mark.faults
@pytest.mark.fault(
    "The wall clock set back by a day, then forward by two",
    "frames continue; ages, rates and latencies stay right; the recording stays readable",
    "libfaketime under the daemon alone, realtime only; 50 dual scans/s",
)
def test_the_wall_clock_is_set(
    tared: Start, scenes: Scenes, play: Play, listen: Listen, figure: Figure, tmp_path: Path
) -> None:
    library = FAKETIME.format(os.uname().machine)
    if not Path(library).exists():
        pytest.skip("needs libfaketime (Debian: apt install libfaketime)")
    clock, path = tmp_path / "clock", tmp_path / "clock.mcap"
    clock.write_text("+0")
    daemon = tared(
        environment={
            "LD_PRELOAD": library,
            "FAKETIME_TIMESTAMP_FILE": str(clock),
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
            "FAKETIME_CACHE_DURATION": "1",
        }
    )
    ears = listen(daemon)
    daemon.ask("record_start", path=path.name)
    begin_s, playing = time.monotonic(), play(still(scenes.rest), 50.0)
    for offset in ("-1d", "+1d"):
        time.sleep(1.0)
        clock.write_text(offset)
        wait_for_wall_clock(ears, DAY_S * int(offset[:2]))
        time.sleep(1.0)
    daemon.ask("record_stop")
    ages_ms = [heard.age_ms for heard in ears.heard]
    gap_s = np.diff([heard.arrived_ns * 1e-9 for heard in ears.heard]).max()
    status = daemon.status()
    recorded = counters(path)
    sent_hz = playing.stop() / (time.monotonic() - begin_s)
    duration_s = open_recording(path).summary.duration_s
    figure(
        f"longest gap {gap_s * 1e3:.0f} ms, ages {min(ages_ms):.1f} to {max(ages_ms):.1f} ms, "
        f"{status['rates']['frames_hz']:.1f} frames/s in the status; {len(recorded)} dual scans, "
        f"{duration_s:.1f} s in the recording"
    )
    assert gap_s < 0.3
    assert min(ages_ms) >= 0
    assert max(ages_ms) < 500
    assert status["rates"]["frames_hz"] == pytest.approx(sent_hz, rel=0.3)
    assert duration_s < 60


@pytest.mark.faults
@pytest.mark.fault(
    "The network files vanish",
    "nothing changes until a restart; then the physics searches without a network, and frames "
    "say so",
    "all .onnx files deleted from a copy of the models' package, then the daemon restarted",
)
def test_the_networks_vanish(
    tared: Start, scenes: Scenes, play: Play, listen: Listen, figure: Figure, tmp_path: Path
) -> None:
    copy = tmp_path / "models" / "tactomo_models"
    copy.parent.mkdir()
    shutil.copytree(Path(tactomo_models.__file__).parent, copy)
    there = {"PYTHONPATH": f"{copy.parent}:{os.environ.get('PYTHONPATH', '')}"}
    said = []
    for restart in (False, True):
        daemon = tared(environment=there)
        ears = listen(daemon, "contacts")
        if not restart:
            shipped = list((copy / "methods" / "networks").glob("*.onnx"))
            assert shipped
            for network in shipped:
                network.unlink()
        playing = play(moving(scenes.one), 10.0)
        first = ears.wait(lambda h: h.fields["contacts"], "a contact")
        ears.wait(lambda h: h.fields["contacts"], "more of it", 20)
        playing.stop()
        said.append(first.fields["tier_reason"].partition(",")[0])
        assert not daemon.told("reconstruction_failed")
        assert daemon.stop() < 2.0
    figure(f"first frame with a contact: {said[0]} while it runs, {said[1]} after the restart")
    assert said == ["proposed", "cold start"]

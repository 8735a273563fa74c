"""What the computer does to the daemon: kills it, fills its disk, sets its clock, loses files."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tactomo_models
from fixture_types import Figure, Listen, Play, StartProcess
from pty_skin import PtySkin, Scenes, moving, still
from tactomo.recordings.recording import open_recording
from tactomo_protocol import Decoder, Scan
from waiting import wait_until

KILLS = 10


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
    tared: StartProcess,
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


@pytest.mark.faults
@pytest.mark.fault(
    "SIGKILL while recording under a press, then a restart",
    "the same addresses; the contact is shown by the reference of before, and flagged until the "
    "skin was at rest; nothing claims to be recorded; the file opens",
    "a contact that moves, 20 dual scans/s, before and after",
)
def test_killed_under_a_press_and_started_again(
    tared: StartProcess,
    start: StartProcess,
    skin: PtySkin,
    scenes: Scenes,
    play: Play,
    listen: Listen,
    figure: Figure,
    tmp_path: Path,
) -> None:
    addresses = {name: f"ipc://{tmp_path}/{name}" for name in ("stream", "control")}
    daemon = tared(**addresses)
    daemon.ask("record_start", path="killed.mcap")
    pressing = play(moving(scenes.one))
    time.sleep(1.0)
    daemon.kill()
    began_s = time.monotonic()
    again = start(skin.paths, **addresses)
    ears = listen(again)
    first = ears.wait(lambda h: h.fields["contacts"], "the contact that is still there")
    figure(f"shown again {time.monotonic() - began_s:.1f} s after the kill")
    assert first.fields["flags"] == ["reference_disputed"]
    status = again.status()
    assert (status["recording"], status["recorder"]["files"]) == (None, 0)
    pressing.stop()
    play(still(scenes.rest))
    wait_until(lambda: again.told("reference_confirmed"), "a skin at rest")
    ears.wait(lambda h: not h.fields["contacts"] and not h.fields["flags"], "no flag")
    assert counters(tmp_path / "killed.mcap")


@pytest.mark.faults
@pytest.mark.fault(
    "The network files vanish",
    "nothing changes until a restart; then the physics searches without a network, and frames "
    "say so",
    "all .onnx files deleted from a copy of the models' package, then the daemon restarted",
)
def test_the_networks_vanish(
    tared: StartProcess, scenes: Scenes, play: Play, listen: Listen, figure: Figure, tmp_path: Path
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

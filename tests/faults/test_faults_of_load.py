"""Too much to do: scans that come too fast, a daemon that is stopped for a while or told to end."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_process import DaemonProcess
from ears import percentiles
from fixture_types import Figure, Listen, Play, StartProcess
from pty_skin import PtySkin, Scenes, moving, still
from tactomo.recordings.recording import open_recording
from waiting import wait_until

STOPPED_S = 5.0
OVERLOAD_S = 15.0


def at_rest(daemon: DaemonProcess) -> dict[str, Any]:
    """Return the status once nothing has come, and nothing was published, for 2 s."""
    seen: list[tuple[int, int, int]] = []

    def is_at_rest() -> bool:
        status = daemon.status()
        packets = sum(port["packets"] for port in status["ports"])
        seen.append((packets, status["dropped_scans"], status["acquired_monotonic_ns"]))
        return len(seen) > 20 and len(set(seen[-20:])) == 1

    wait_until(is_at_rest, "the daemon to come to rest", step_s=0.1)
    return daemon.status()


@pytest.mark.faults
@pytest.mark.fault(
    "Scans at 10 times the rate that can be reconstructed",
    "the newest scan is used; each dual scan is published or counted as dropped; at "
    "publication, no frame is older than two reconstructions (p99)",
    "two contacts that jump with each dual scan, for 15 s, at ten times the rate at which the "
    "daemon publishes when flooded",
)
def test_ten_times_too_fast(
    tared: StartProcess, skin: PtySkin, scenes: Scenes, play: Play, listen: Listen, figure: Figure
) -> None:
    daemon = tared()
    flood = play(moving(scenes.two[::7]), 300.0)
    time.sleep(4.0)
    possible_hz = daemon.status()["rates"]["frames_hz"]
    flood.stop()
    before = at_rest(daemon)
    ears = listen(daemon)
    wait_until(lambda: daemon.status()["subscribers"] == 1, "the subscription")
    begin_s = time.monotonic()
    playing = play(moving(scenes.two[::7]), 10 * possible_hz)
    time.sleep(OVERLOAD_S)
    sent = playing.stop()
    rate_hz = sent / (time.monotonic() - begin_s)
    after = at_rest(daemon)
    dropped = after["dropped_scans"] - before["dropped_scans"]
    frame_ms = after["stage_ms"]["reconstruct"]
    ages_ms = [heard.published_age_ms for heard in ears.heard]
    figure(
        f"{possible_hz:.0f}/s possible, {rate_hz:.0f}/s sent: {sent} = {len(ears.heard)} "
        f"published + {dropped} dropped; a reconstruction p50 {frame_ms['p50']:.0f} ms, of the "
        f"last 256 two beyond {frame_ms['p99']:.0f} ms; age {percentiles(ages_ms)}"
    )
    assert len(ears.heard) + dropped == sent
    assert ears.heard[-1].fields["scan_counter"] == skin.counter - 1
    assert np.percentile(ages_ms, 99) < 2 * frame_ms["p99"] + 10


@pytest.mark.faults
@pytest.mark.fault(
    "The daemon is stopped for 5 s and continued (SIGSTOP, as a suspended virtual machine)",
    "no frame states an age that is more than 0.1 s too low; fresh frames within 1 s",
    "20 dual scans/s throughout, the device's clock known; each frame's date compared with the "
    "time of sending",
)
def test_the_daemon_is_stopped_for_a_while(
    tared: StartProcess, scenes: Scenes, play: Play, listen: Listen, figure: Figure
) -> None:
    daemon = tared()
    ears = listen(daemon)
    playing = play(still(scenes.rest))
    wait_until(daemon.knows_the_clocks, "the device's clock to be known", step_s=0.5)
    daemon.signal(signal.SIGSTOP)
    time.sleep(STOPPED_S)
    continued_s = time.monotonic()
    before = len(ears.heard)
    daemon.signal(signal.SIGCONT)
    time.sleep(2.0)
    playing.stop()
    after = ears.heard[before:]
    too_young_s = [
        (heard.fields["acquired_monotonic_ns"] - playing.sent[heard.fields["scan_counter"]]) * 1e-9
        for heard in after
    ]
    fresh = next(heard for heard in after if heard.age_ms < 100)
    wrong = [young for young in too_young_s if young > 0.1]
    figure(
        f"frames again after {fresh.arrived_ns * 1e-9 - continued_s:.2f} s; {len(wrong)} of "
        f"{len(after)} frames too young, none by more than {max(too_young_s) * 1e3:.0f} ms"
    )
    assert not wrong
    assert fresh.arrived_ns * 1e-9 - continued_s < 1.0


@pytest.mark.slow
@pytest.mark.fault(
    "SIGTERM under full load",
    "ends within 2 s, with exit status 0 and the recording complete",
    "two contacts that jump at 300 dual scans/s, recording with maps, a subscriber to all",
)
def test_sigterm_under_full_load(
    tared: StartProcess, scenes: Scenes, play: Play, listen: Listen, figure: Figure, tmp_path: Path
) -> None:
    path = tmp_path / "load.mcap"
    daemon = tared(recording={"file": str(path), "maps": True})
    listen(daemon, "map", "contacts", "scan", "status", "event")
    playing = play(moving(scenes.two[::7]), 300.0)
    time.sleep(3.0)
    took_s = daemon.stop()
    playing.stop()
    figure(f"{took_s:.2f} s")
    assert took_s < 2.0
    assert open_recording(path).summary.is_complete

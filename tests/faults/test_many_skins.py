"""How many skins a computer serves: what ten of one robot take of it."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from ears import Ears
from fixture_types import Figure
from processes import children_of
from pty_skin import Scenes, moving
from robot import Robot

SKINS = tuple(f"skin{number}" for number in range(10))
RATE_HZ = 20.0
SECONDS = 60.0
SETTLE_S = 8.0
CORES = 2


@pytest.fixture
def robot(tmp_path: Path, scenes: Scenes) -> Iterator[Robot]:
    made = Robot(tmp_path, scenes.rest, SKINS)
    yield made
    made.close()


def cpu_s(pid: int) -> float:
    """Processor time that a process has used, seconds."""
    tasks = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(task.read_text().split()[0]) for task in tasks) * 1e-9


def memory_mb(pid: int) -> float:
    """Memory of a process, what it shares with others counted in part."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    (pss,) = (line for line in lines if line.startswith("Pss:"))
    return int(pss.split()[1]) / 1024


@pytest.mark.faults
@pytest.mark.timeout(900)
@pytest.mark.parametrize("touched", [0, 1, 10])
@pytest.mark.measure(
    "Ten skins of one robot, 20/s each; a contact slides on {touched} of them",
    "every scan is counted",
    "one `tactomo daemon` of ten skins for 60 s × `--scale`, a subscriber to each; shared "
    "memory counted once",
)
def test_ten_skins(
    robot: Robot, scenes: Scenes, figure: Figure, scale: float, touched: int
) -> None:
    robot.wait_ready()
    for name in SKINS:
        robot.wait(name, lambda status: status["reference"])
    path = scenes.sliding(RATE_HZ)
    for name in SKINS[:touched]:
        robot.playing[name].stop()
        robot.play(name, moving(path), RATE_HZ)
    time.sleep(SETTLE_S)
    ears = [Ears(robot.stream[name], name) for name in SKINS]
    pids = [robot.process.popen.pid, *children_of(robot.process.popen.pid)]
    before = {pid: cpu_s(pid) for pid in pids}
    dropped = sum(robot.status(name)["dropped_scans"] for name in SKINS)
    begin_s = time.monotonic()
    time.sleep(max(10.0, SECONDS * scale))
    took_s = time.monotonic() - begin_s
    used = {pid: cpu_s(pid) - before[pid] for pid in pids}
    frames = [message for each in ears for message in list(each.heard)]
    dropped = sum(robot.status(name)["dropped_scans"] for name in SKINS) - dropped
    memory = [memory_mb(pid) for pid in pids]
    for each in ears:
        each.close()
    tiers = Counter(message.fields["tier"] for message in frames).most_common()
    a_frame_s = sum(used.values()) / len(frames)
    figure(
        f"{sum(used.values()) / took_s:.2f} cores, {a_frame_s * 1e3:.2f} ms a frame: "
        f"{CORES} cores make {CORES / a_frame_s:.0f} frames/s; "
        f"{len(frames) / took_s:.0f} frames/s ({', '.join(f'{t} {n}' for t, n in tiers)}), "
        f"{dropped} dropped; {sum(memory):.0f} MB, {min(memory[1:]):.0f} to "
        f"{max(memory[1:]):.0f} a skin; load of the computer {os.getloadavg()[0]:.0f}"
    )
    for name in SKINS:
        robot.stop_and_count(name)
        tally = robot.status(name)["scan_tally"]
        assert tally.pop("received") == sum(tally.values())

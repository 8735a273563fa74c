"""`tactomo daemon` with several skins in one configuration: a process each, on real ports."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_process import DaemonProcess
from processes import children_of, is_running
from pty_skin import Volts, moving, still
from robot import Robot
from tactomo_client import subscribe
from tactomo_models import (
    Press,
    SensorDescription,
    SkinSimulator,
    load_description,
    load_or_build_artifact,
)
from waiting import PATIENCE_S, wait_until

NAMES = ("left", "right")
STEPS = 12
"""Of the path on which a contact jumps: each is far from the one before."""
SHARED_MB = 66.0
"""Of 74, the even sheet's Green's function, which is the file's pages, not among them; where each
loads a network of its own it is 58, where nothing is shared 0."""


@pytest.fixture(scope="session")
def rest() -> Volts:
    description = load_description("paper_square")
    load_or_build_artifact(description)
    return SkinSimulator(description, 4e-3).voltages(())


@pytest.fixture
def start(tmp_path: Path, rest: Volts) -> Iterator[Callable[..., Robot]]:
    robots: list[Robot] = []

    def begin(**config: Any) -> Robot:
        robots.append(Robot(tmp_path, rest, config.pop("names", NAMES), **config))
        return robots[-1]

    yield begin
    for robot in robots:
        robot.close()


def pressed(description: SensorDescription) -> list[Volts]:
    """Voltages of two contacts at the steps of a path on which they jump."""
    skin = SkinSimulator(description, 4e-3)
    angles = [5 * 2 * np.pi * step / STEPS for step in range(STEPS)]
    places = [(0.035 * float(np.cos(a)), 0.035 * float(np.sin(a))) for a in angles]
    return [skin.voltages((Press(x, y, 180.0), Press(-x, -y, 170.0))) for x, y in places]


def shared_mb(pid: int) -> float:
    """Memory that a process has written to, or its parent before the fork, and still shares."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    (line,) = (each for each in lines if each.startswith("Shared_Dirty:"))
    return int(line.split()[1]) / 1024


@pytest.mark.slow
def test_each_skin_is_served_and_found_by_its_name(start: Callable[..., Robot]) -> None:
    robot = start()
    robot.wait_ready()
    for name in NAMES:
        with subscribe(name, address=robot.stream[name]) as frames:
            assert frames.wait(PATIENCE_S) is not None
        status = robot.status(name)
        assert status["sensor"] == name
        assert status["process"]["pid"] in children_of(robot.process.popen.pid)
        assert shared_mb(status["process"]["pid"]) > SHARED_MB
    told = subprocess.run(
        [
            sys.executable,
            "-m",
            "tactomo.cli",
            "status",
            "-s",
            "right",
            "--address",
            robot.stream["right"],
            "--json",
        ],
        capture_output=True,
        check=True,
        timeout=PATIENCE_S,
    )
    assert json.loads(told.stdout)["sensor"] == "right"


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGTERM,
        pytest.param(signal.SIGINT, marks=pytest.mark.slow),
        pytest.param(signal.SIGKILL, marks=pytest.mark.slow),
    ],
)
def test_all_of_them_end_with_the_command(start: Callable[..., Robot], number: int) -> None:
    robot = start()
    robot.wait_ready()
    children = children_of(robot.process.popen.pid)
    assert len(children) == len(NAMES)
    robot.process.signal(number)
    assert robot.process.popen.wait(PATIENCE_S) == (0 if number != signal.SIGKILL else -number)
    wait_until(lambda: not any(map(is_running, children)), "the children's end")


@pytest.mark.slow
def test_one_that_dies_is_started_again_and_the_other_goes_on(start: Callable[..., Robot]) -> None:
    robot = start()
    robot.wait_ready()
    before = {name: robot.status(name) for name in NAMES}
    subprocess.run(["kill", "-9", str(before["left"]["process"]["pid"])], check=True)
    wait_until(lambda: len(robot.ready("left")) == 2, "the daemon's second start")
    assert robot.process.told("skin_ended")[0]["sensor"] == "left"
    assert robot.status("left")["session"] != before["left"]["session"]
    assert robot.status("right")["session"] == before["right"]["session"]


@pytest.mark.slow
def test_busy_skins_degrade_and_starve_no_still_one(
    start: Callable[..., Robot], rest: Volts
) -> None:
    """Three skins on which contacts jump and loops on every core; the fourth skin rests."""
    busy = ("one", "two", "three")
    robot = start(names=(*busy, "still"))
    robot.wait_ready()
    for name in (*busy, "still"):
        robot.wait(name, lambda status: status["reference"])
    received = {name: robot.stop_and_count(name) for name in (*busy, "still")}
    loops = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"])
        for _ in range(os.cpu_count() or 1)
    ]
    try:
        robot.play("still", still(rest), 20.0)
        for name in busy:
            robot.play(name, moving(pressed(load_description("paper_square"))), 100.0)
        before = robot.status("still")
        for name in busy:
            robot.wait(name, lambda status: "processor_shared" in status["events"]["counts"])
        # Long enough that one moment without the processor does not decide.
        robot.wait("still", lambda status: status["frames"] > before["frames"] + 150)
        after = robot.status("still")
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()
    made = after["frames"] - before["frames"]
    assert made > 4 * (after["dropped_scans"] - before["dropped_scans"])
    for name, before_it in received.items():
        assert robot.stop_and_count(name) - before_it == 2 * len(robot.playing[name].sent)
        tally = robot.status(name)["scan_tally"]
        assert tally.pop("received") == sum(tally.values())


@pytest.mark.slow
def test_one_that_hangs_is_killed_and_started_again(start: Callable[..., Robot]) -> None:
    robot = start()
    robot.wait_ready()
    subprocess.run(["kill", "-STOP", str(robot.status("left")["process"]["pid"])], check=True)
    wait_until(lambda: len(robot.ready("left")) == 2, "the daemon's second start")
    assert robot.process.told("skin_hangs")[0]["sensor"] == "left"


@pytest.mark.slow
def test_where_none_can_start_the_command_fails_with_the_reasons(tmp_path: Path) -> None:
    skins = {name: {"ports": [f"/absent/{name}"]} for name in NAMES}
    process = DaemonProcess(tmp_path, [], ready=False, skins=skins)
    assert process.popen.wait(PATIENCE_S) == 1
    failures = process.told("failed")
    assert {event["sensor"] for event in failures} == set(NAMES)
    assert all(f"/absent/{event['sensor']}" in event["detail"] for event in failures)
    assert not any("exception" in event for event in process.log())

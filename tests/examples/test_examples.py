"""The programs in examples/: each runs from its own text, is short, and prints what it promises."""

from __future__ import annotations

import os
import re
import runpy
import subprocess
import sys
import time
from collections.abc import Callable
from ctypes.util import find_library
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tactomo_client.appearance  # not by the example, under its own clock
from noisy_skin import Skin
from recorded_grasp import write_grasp
from tactomo_client import Contact, Frame, Subscription, subscribe
from tactomo_client.fake import FakeSensor
from tactomo_models import Press, Reconstructor, SkinSimulator, load_description
from waiting import wait_until
from whole_system import repository

EXAMPLES = repository() / "examples"
PROGRAMS = sorted(EXAMPLES.glob("*.py"))
Run = Callable[..., str]
Script = list[tuple[list[Contact], list[str]]]
"""Frames: contacts and flags of each."""


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run an example in an empty folder, in this process, and return what it prints."""
    monkeypatch.chdir(tmp_path)

    def go(name: str, *arguments: object) -> str:
        path = EXAMPLES / name
        monkeypatch.setattr("sys.argv", [str(path), *map(str, arguments)])
        runpy.run_path(str(path), run_name="__main__")
        return capsys.readouterr().out

    return go


def test_programs_are_listed_where_a_reader_looks() -> None:
    names = {program.name for program in PROGRAMS}
    assert len(names) == 7
    for page in ("docs/python.md", "docs/gallery.md"):
        listed = re.findall(r"examples/(\w+\.py)", (repository() / page).read_text("utf-8"))
        assert set(listed) == names, page


@pytest.mark.slow
def test_presses_are_simulated_found_and_plotted(run: Run, tmp_path: Path) -> None:
    found = re.findall(r"(-?[\d.]+) +(-?[\d.]+) mm +(\d+) kPa", run("simulate_reconstruct_plot.py"))
    places = {(round(float(x)), round(float(y))): float(kpa) for x, y, kpa in found}
    assert places == {
        (-30, 20): pytest.approx(180, rel=0.05),
        (30, -20): pytest.approx(220, rel=0.05),
    }
    assert (tmp_path / "presses.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_simulated_gripper_feels_the_ball_that_it_rolls(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    if find_library("EGL") is None:
        pytest.skip("needs EGL to render")
    done = subprocess.run(
        [sys.executable, EXAMPLES / "mujoco_grasp.py"],
        cwd=tmp_path,
        env={**os.environ, "MUJOCO_GL": "egl"},
        capture_output=True,
        text=True,
        check=False,
    )
    said = done.stdout
    assert done.returncode == 0, done.stderr
    truth = [float(newtons) for newtons in re.findall(r"([\d.]+) N press", said)]
    felt = [[float(n) for n in each] for each in re.findall(r"(\d+) N at (.*), (.*) mm", said)]
    assert len(truth) == len(felt) == 5
    for pressed_n, (felt_n, _, y_mm) in zip(truth, felt, strict=True):
        assert felt_n == pytest.approx(pressed_n, rel=0.2)
        assert y_mm == pytest.approx(10, abs=1)
    assert [x_mm for _, x_mm, _ in felt] == pytest.approx([-30, -30, -11, 9, 29], abs=2)
    assert (tmp_path / "grasp.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_sensor_of_ones_own_finds_its_press(run: Run) -> None:
    said = run("own_sensor.py")
    (found,) = re.findall(r"40 voltages: a press at (-?[\d.]+), (-?[\d.]+) mm", said)
    assert [float(number) for number in found] == pytest.approx([20, -10], abs=1)


def test_a_laplace_prior_finds_a_press_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is told too high and too small, but the change over all of it is right."""
    monkeypatch.syspath_prepend(EXAMPLES)
    sensor = load_description("graded_square")
    skin = Skin(SkinSimulator(sensor, unevenness=0.03))
    made = Reconstructor(sensor, method="laplace_prior:LaplacePrior")
    made.set_reference(skin.reference())
    frame = made.reconstruct(skin.scan(Press(0.02, -0.01, 100.0, 0.018))["magnitude"], None)
    assert not frame.failure, frame.failure
    [contact] = frame.contacts
    assert np.hypot(contact.x_m - 0.02, contact.y_m + 0.01) < 1.5e-3
    assert frame.map is not None
    assert sensor.magnitude is not None
    response = sensor.magnitude.response
    told = np.interp(100.0, response.pressure_kpa, response.relative_change)
    cell_m2 = (sensor.map_x_m[1] - sensor.map_x_m[0]) ** 2
    assert frame.map.sum() * cell_m2 == pytest.approx(told * np.pi * 0.018**2, rel=0.1)


def test_a_recording_is_summed_up_by_contact(run: Run, tmp_path: Path) -> None:
    lines = run("read_recording.py", write_grasp(tmp_path / "grasp.mcap")).splitlines()
    assert re.fullmatch(r"left: [\d.]+ s, whole", lines[0])
    assert lines[1:] == [
        "contact 1: 1.00 to 3.45 s, 174 kPa",
        "contact 2: 2.00 to 3.45 s, too light",
    ]


class EnoughError(Exception):
    """Ends a program that would go on for ever."""


def touch(pressure_kpa: float | None, max_kpa: float | None) -> list[Contact]:
    """A contact on the fake sensor."""
    return [Contact(1, 10.0, -5.0, 700.0, None, None, pressure_kpa, max_kpa=max_kpa)]


def steady(contacts: list[Contact], *flags: str, frames: int = 25) -> Script:
    """The same frame, again and again."""
    return [(contacts, list(flags))] * frames


@pytest.mark.slow
def test_the_robot_stops_once_for_each_cause_and_at_nothing_less() -> None:
    light, hard = steady(touch(None, 134.0)), steady(touch(151.0, 155.0))
    shrug = steady([], "misfit_high", frames=3)  # a short doubt
    calm = steady([]) + light + steady(touch(145.0, 149.0)) + shrug + light
    to_and_fro = 15 * (light[:1] + hard[:1])
    assert said_by_the_robot(
        [
            *(*calm, *hard, *to_and_fro, *light, *steady([], "misfit_high", "not_converged")),
            *(*light, *steady(touch(None, None)), *light, *steady(touch(145.0, 151.0)), *light),
        ]
    ) == [
        "moves",
        "stops: contact 1: 151 kPa",
        "moves",
        "stops: not to be trusted: misfit_high, not_converged",
        "moves",
        "stops: contact 1: pressed",
        "moves",
        "stops: contact 1: 145 kPa",
        "moves",
        "stops: no fresh frame",
    ]


def said_by_the_robot(script: Script) -> list[str]:
    """What the program says while frames come, 50 a second by its own clock, and then none.

    Its clock stands still until a frame has arrived: none is late on a busy computer.
    """
    said: list[str] = []
    turns = 0  # of its loop, a millisecond each
    frames: list[Subscription[Frame]] = []

    def note(text: str, **_: object) -> None:
        said.append(text)
        if text.endswith("no fresh frame"):
            raise EnoughError

    def sleep(seconds: float) -> None:
        nonlocal turns
        assert seconds == 0.001
        number, is_between = divmod(turns, 20)
        turns += 1
        if is_between:
            return
        if number >= len(script):
            wait_until(lambda: frames[0].is_stale, "the last frame to grow old")
            return
        contacts, flags = script[number]
        is_last = number == len(script) - 1
        ahead_ns = 0 if is_last else 10**12
        sensor.publish(contacts, flags=flags, acquired_monotonic_ns=time.monotonic_ns() + ahead_ns)
        wait_until(lambda: (at := frames[0].latest()) is not None and at.sequence == number + 1)

    def follow(*arguments: Any, **options: Any) -> Subscription[Frame]:
        options["stale_after_s"] *= 10  # a busy computer may take its own 0.2 s over a turn
        frames.append(subscribe(*arguments, **options))
        sensor.wait_for_subscriber()
        return frames[0]

    program = EXAMPLES / "stop_robot.py"
    with FakeSensor("skin") as sensor, pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", [str(program), "skin", sensor.address])
        patch.setattr(tactomo_client, "subscribe", follow)
        its_clock = SimpleNamespace(monotonic=lambda: 0.001 * turns, sleep=sleep)
        patch.setitem(sys.modules, "time", its_clock)
        with pytest.raises(EnoughError):
            runpy.run_path(str(program), {"print": note}, run_name="__main__")
    return said

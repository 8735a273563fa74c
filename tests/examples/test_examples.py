"""The programs in examples/: each runs from its own text, is short, and prints what it promises."""

from __future__ import annotations

import ast
import re
import runpy
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from recorded_grasp import write_grasp
from tactomo_client import Contact
from tactomo_client.fake import FakeSensor
from whole_system import repository

EXAMPLES = repository() / "examples"
PROGRAMS = sorted(EXAMPLES.glob("*.py"))
Run = Callable[..., str]


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


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda p: p.name)
def test_a_program_is_short_and_says_how_it_is_run(program: Path) -> None:
    text = program.read_text("utf-8")
    assert len(text.splitlines()) <= 40
    told = ast.get_docstring(ast.parse(text)) or ""
    assert re.search(rf"^(Run|    tactomo).*{program.stem}", told, re.M)


def test_five_programs_are_listed_where_a_reader_looks() -> None:
    names = {program.name for program in PROGRAMS}
    assert len(names) == 5
    assert (
        set(re.findall(r"examples/(\w+\.py)", (repository() / "docs/python.md").read_text()))
        == names
    )


def test_presses_are_simulated_found_and_plotted(run: Run, tmp_path: Path) -> None:
    found = re.findall(r"(-?[\d.]+) +(-?[\d.]+) mm +(\d+) kPa", run("simulate_reconstruct_plot.py"))
    places = {(round(float(x)), round(float(y))): float(kpa) for x, y, kpa in found}
    assert places == {
        (-30, 20): pytest.approx(180, rel=0.05),
        (30, -20): pytest.approx(220, rel=0.05),
    }
    assert (tmp_path / "presses.png").read_bytes().startswith(b"\x89PNG")


def test_a_sensor_of_ones_own_finds_its_press(run: Run) -> None:
    said = run("own_sensor.py")
    (found,) = re.findall(r"40 voltages: a press at (-?[\d.]+), (-?[\d.]+) mm", said)
    assert [float(number) for number in found] == pytest.approx([20, -10], abs=1)


def test_a_recording_is_summed_up_by_contact(run: Run, tmp_path: Path) -> None:
    lines = run("read_recording.py", write_grasp(tmp_path / "grasp.mcap")).splitlines()
    assert re.fullmatch(r"left: [\d.]+ s, whole", lines[0])
    assert lines[1:] == [
        "contact 1: 1.00 to 3.45 s, 174 kPa",
        "contact 2: 2.00 to 3.45 s, too light",
    ]


def press(pressure_kpa: float) -> Contact:
    """A contact on the fake sensor."""
    return Contact(1, 10.0, -5.0, 700.0, 0.2, 0.01, pressure_kpa, pressure_range="within")


@pytest.mark.parametrize(
    ("flags", "pressure_kpa", "reason"),
    [
        ([], 151.0, "contact 1: 151 kPa"),
        (["misfit_high"], 20.0, "not to be trusted: misfit_high"),
        (None, 0.0, "no frame within half a second"),
    ],
)
def test_the_robot_stops(
    run: Run, flags: list[str] | None, pressure_kpa: float, reason: str
) -> None:
    with FakeSensor("skin") as sensor:

        def publish() -> None:
            sensor.wait_for_subscriber()
            for _ in range(5):
                sensor.publish([press(149.0)])
            if flags is not None:
                sensor.publish([press(pressure_kpa)], flags=flags)

        publisher = threading.Thread(target=publish)
        publisher.start()
        said = run("stop_robot.py", "skin", sensor.address)
        publisher.join()
    assert said == f"moving\nstopped: {reason}\n"

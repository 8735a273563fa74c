"""docs/python.md as somebody who reads that page alone follows it: every block of code."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from newcomer import Newcomer
from page import Page
from recorded_grasp import write_grasp
from tactomo_lab.scenes.measures import correlation
from waiting import wait_until
from whole_system import repository

PAGE = Page("docs/python.md")
FILES = ("own_method.py", "float_board.py")
RUN_AT_ONCE = ("Arrays in", "What a frame says", "Methods")
METHOD, PROTOCOL = "A method of your own", "A device protocol of your own"
SMALLER = {"--count 8": "--count 1", "--method tikhonov --count 2": "--count 1"}


@pytest.fixture
def newcomer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Newcomer:
    """Somebody in an empty folder, with the page's files in it."""
    for name in FILES:
        (tmp_path / name).write_text(PAGE.file(name))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return Newcomer(tmp_path, SMALLER)


def run(code: str, names: dict[str, Any]) -> None:
    """Run a block of the page in the names of those before it."""
    exec(compile(code, "docs/python.md", "exec"), names)


def test_the_method_is_the_example() -> None:
    assert PAGE.file("own_method.py") == (repository() / "examples/own_method.py").read_text()


@pytest.mark.slow
def test_arrays_become_maps_and_an_own_method_does_the_same(
    newcomer: Newcomer, capsys: pytest.CaptureFixture[str]
) -> None:
    names: dict[str, Any] = {"__name__": "__main__"}
    for heading in RUN_AT_ONCE:
        for code in PAGE.blocks("python", heading):
            run(code, names)
    (x_mm, y_mm, kpa) = re.findall(r"([\d.]+), (-[\d.]+) mm: (\d+) kPa", capsys.readouterr().out)[0]
    assert (float(x_mm), float(y_mm)) == pytest.approx((20, -10), abs=0.5)
    assert float(kpa) == pytest.approx(190, rel=0.05)
    saved, tried = PAGE.blocks("python", METHOD)
    assert saved == PAGE.file("own_method.py")
    run(tried, names)
    assert names["frame"].tier == "StructurePrior"
    assert len(names["frame"].contacts) == 1
    reconstruct, evaluate = PAGE.commands(METHOD)[:2]
    newcomer.run(reconstruct)
    with np.load("maps.npz") as maps:
        assert correlation(maps["map"][0], names["frame"].map) > 0.95
        assert not maps["flags"].any()
    assert "own_method:StructurePrior" in newcomer.run(evaluate)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_an_own_method_is_charted(newcomer: Newcomer) -> None:
    newcomer.run(PAGE.commands(METHOD)[2])
    assert Path("chart.png").exists()


@pytest.mark.slow
def test_an_own_method_is_seen_on_the_live_stream(newcomer: Newcomer) -> None:
    demo, press, watch, other, own = PAGE.commands(METHOD)[3:]
    (live,) = PAGE.blocks("python", "Follow")
    with newcomer:
        newcomer.run(demo)
        newcomer.run(press)
        seen = newcomer.wait_for(watch, "StructurePrior")
        assert " mm " in seen
        for name, at in (('subscribe("skin"', "stream"), ("Daemon(", "control")):
            comma = ", address=" if at == "stream" else ""
            live = live.replace(name, f"{name}{comma}{newcomer.addresses[at]!r}")
        said: list[str] = []
        wait_until(  # not stale, as it may be for a moment on a busy computer
            lambda: said[-1].endswith("running\n"),
            meanwhile=lambda: said.append(newcomer.python(live)),
        )
        assert said[-1].startswith("own_method:StructurePrior ")
        newcomer.run(other)
        assert " tikhonov " in newcomer.wait_for(watch, " tikhonov ")
        newcomer.run(own)


@pytest.mark.slow
def test_an_own_protocol_is_read(newcomer: Newcomer) -> None:
    twin, daemon, press, status = PAGE.commands(PROTOCOL)
    with newcomer:
        newcomer.run(twin)
        newcomer.run(daemon)
        newcomer.run(press)
        assert "float-board" in newcomer.wait_for(status, "running")


def test_a_recording_is_read(newcomer: Newcomer, capsys: pytest.CaptureFixture[str]) -> None:
    write_grasp(newcomer.folder / "grasp.mcap")
    (code,) = PAGE.blocks("python", "Read")
    run(code, {})
    assert capsys.readouterr().out.startswith("left 4.0 s\n20 1 -30.0 -20.0 150.0\n")

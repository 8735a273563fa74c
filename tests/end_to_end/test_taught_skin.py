"""A skin whose electrodes sit off their places: taught at the terminal, its contacts are right.

The twin's electrodes are two millimetres farther apart than the description says, and its sheet is
glued onto the robot with folds, which no voltage tells. The session is at a terminal, the daemon
reads the twin's serial ports, and goes by what was taught as soon as it is kept.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from handmade_skin import on_sheet
from tactomo_client import Frame
from terminal import Terminal
from whole_system import WatchedTwin, paper_twin

NAME = "palm"
PRESSES = 21
RADIUS_MM, KPA = 10, 200
HELD_OUT_MM = ((-35.0, 20.0), (12.0, -41.0), (33.0, 33.0), (-8.0, 5.0), (28.0, -12.0))


class Bench(WatchedTwin):
    """The skin under one press, and a daemon that looks at it."""

    def frame(self, x_mm: float, y_mm: float) -> Frame:
        """Press one place of the robot alone; returns a frame of a scan that was taken since."""
        x_mm, y_mm = on_sheet(np.array([x_mm, y_mm])).tolist()
        self.clear()
        before = self.press(x_mm=x_mm, y_mm=y_mm, radius_mm=RADIUS_MM, pressure_kpa=KPA)
        with self.frames() as frames:
            seen = (f for f in frames if f.scan_counter > before + 4 and len(f.contacts) == 1)
            return next(frame for frame in seen if frame.tier == "fit")

    def errors_mm(self) -> tuple[list[float], list[bool]]:
        """Of presses that nothing is taught by, and whether they are placed by what was taught."""
        contacts = [self.frame(*place).contacts[0] for place in HELD_OUT_MM]
        places = np.array([(c.x_mm, c.y_mm) for c in contacts])
        errors = np.linalg.norm(places - HELD_OUT_MM, axis=1)
        return errors.tolist(), [c.taught for c in contacts]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """Of a twin that was made by hand."""
    with paper_twin(tmp_path, ("pitch_m = 0.036", "pitch_m = 0.038")) as twin:
        bench = Bench(twin, tmp_path, NAME)
        yield bench
        bench.close()


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_a_guided_session_makes_places_right(bench: Bench) -> None:
    untaught, is_taught = bench.errors_mm()
    assert not any(is_taught)
    address = ("--address", bench.daemon.stream)
    with Terminal("teach", "live", "--sensor", NAME, *address) as terminal:
        terminal.wait_for("Take everything off the skin")
        terminal.enter("")
        terminal.wait_for("something presses")
        bench.clear()
        with bench.frames() as frames:
            next(frame for frame in frames if frame.tier == "quiet")
        terminal.enter("")
        for number in range(1, PRESSES + 1):
            said = terminal.wait_for("mm, hold, and Enter")
            place = re.search(r"Press \(([-\d.]+), ([-\d.]+)\) mm", said)
            assert place
            bench.frame(float(place[1]), float(place[2]))
            terminal.enter("")
            terminal.wait_for(f".presses.npz: {number}")
        terminal.enter("here")
        terminal.wait_for("two numbers")
        terminal.enter("undo")
        terminal.wait_for(f".presses.npz: {PRESSES - 1}")
        terminal.enter("done")
        assert terminal.wait() == 0, terminal.shown
    assert f"palm: {PRESSES - 1} presses of" in terminal.shown
    assert "in force now: the daemon of palm goes by it" in terminal.shown
    assert bench.daemon.status()["description"]["taught"]["presses"] == PRESSES - 1
    taught, is_taught = bench.errors_mm()
    assert all(is_taught)
    assert np.median(taught) < 0.7 * np.median(untaught), (taught, untaught)


@pytest.mark.slow
def test_what_no_press_can_be_is_not_taken(bench: Bench) -> None:
    with Terminal("teach", "live", "--sensor", NAME, "--address", bench.daemon.stream) as terminal:
        terminal.wait_for("Take everything off the skin")
        terminal.enter("")
        for answer, reply in (
            ("1250 -30", "(1250, -30) mm is off the skin"),
            ("nan 3", "(nan, 3) mm is off the skin"),
            ("12.5 -30 -8", "-8 N presses nothing"),
            ("12,5 30", "two numbers"),
        ):
            terminal.wait_for("mm, hold, and Enter")
            terminal.enter(answer)
            terminal.wait_for(reply)
        terminal.enter("done")
        assert terminal.wait() == 1
    assert "there are no presses" in terminal.shown

"""A skin whose electrodes sit off their places: taught at the terminal, its contacts are right.

The twin's electrodes are two millimetres farther apart than the description says, and its sheet is
glued onto the robot with folds, which no voltage tells. The session is at a terminal, the daemon
reads the twin's serial ports, and goes by what was taught as soon as it is kept.
"""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_process import DaemonProcess
from handmade_skin import on_sheet
from tactomo_client import Frame, subscribe
from tactomo_client import request as ask
from terminal import Terminal
from waiting import PATIENCE_S, wait_until
from whole_system import twin_of

NAME = "palm"
PRESSES = 21
RADIUS_MM, KPA = 10, 200
HELD_OUT_MM = ((-35.0, 20.0), (12.0, -41.0), (33.0, 33.0), (-8.0, 5.0), (28.0, -12.0))


@pytest.fixture
def twin(tmp_path: Path) -> Iterator[dict[str, list[str]]]:
    """A twin that was made by hand."""
    shipped = resources.files("tactomo_models.sensor.shipped").joinpath("paper_square.toml")
    text = shipped.read_text("utf-8")
    assert text.count("pitch_m = 0.036") == 1
    sensor = tmp_path / "by_hand.toml"
    sensor.write_text(text.replace("pitch_m = 0.036", "pitch_m = 0.038"))
    with twin_of(sensor, tmp_path / "ports") as said:
        yield said


class Bench:
    """The skin under one press, and a daemon that looks at it."""

    def __init__(self, twin: dict[str, list[str]], folder: Path) -> None:
        self._control = str(twin["control"])
        self.daemon = DaemonProcess(folder, twin["ports"], name=NAME)
        wait_until(lambda: self.daemon.status()["state"] == "running", "a reference")

    def press(self, x_mm: float, y_mm: float) -> Frame:
        """Press one place of the robot alone; returns a frame of a scan that was taken since."""
        sheet_mm = on_sheet(np.array([x_mm, y_mm]))
        where: dict[str, Any] = {
            "x_mm": float(sheet_mm[0]),
            "y_mm": float(sheet_mm[1]),
            "radius_mm": RADIUS_MM,
            "pressure_kpa": KPA,
        }
        ask("clear", self._control, PATIENCE_S)
        ask("press", self._control, PATIENCE_S, **where)
        before = ask("status", self._control, PATIENCE_S)["counter"]
        with subscribe(NAME, address=self.daemon.stream, timeout_s=PATIENCE_S) as frames:
            seen = (f for f in frames if f.scan_counter > before + 4 and len(f.contacts) == 1)
            return next(frame for frame in seen if frame.tier == "fit")

    def errors_mm(self) -> tuple[list[float], list[bool]]:
        """Of presses that nothing is taught by, and whether they are placed by what was taught."""
        contacts = [self.press(*place).contacts[0] for place in HELD_OUT_MM]
        places = np.array([(c.x_mm, c.y_mm) for c in contacts])
        errors = np.linalg.norm(places - HELD_OUT_MM, axis=1)
        return errors.tolist(), [c.taught for c in contacts]

    def clear(self) -> None:
        ask("clear", self._control, PATIENCE_S)
        with subscribe(NAME, address=self.daemon.stream, timeout_s=PATIENCE_S) as frames:
            next(frame for frame in frames if frame.tier == "quiet")

    def close(self) -> None:
        self.daemon.popen.send_signal(signal.SIGINT)
        self.daemon.popen.wait(PATIENCE_S)


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_a_guided_session_makes_places_right(
    twin: dict[str, list[str]], tmp_path: Path, request: Any
) -> None:
    bench = Bench(twin, tmp_path)
    request.addfinalizer(bench.close)
    untaught, is_taught = bench.errors_mm()
    assert not any(is_taught)
    address = ("--address", bench.daemon.stream)
    with Terminal("teach", "live", "--sensor", NAME, *address) as terminal:
        terminal.wait_for("Take everything off the skin")
        terminal.enter("")
        terminal.wait_for("something presses")
        bench.clear()
        terminal.enter("")
        for number in range(1, PRESSES + 1):
            said = terminal.wait_for("mm, hold, and Enter")
            place = re.search(r"Press \(([-\d.]+), ([-\d.]+)\) mm", said)
            assert place
            bench.press(float(place[1]), float(place[2]))
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

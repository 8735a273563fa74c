"""A skin that answers otherwise than its description says: calibrated, its pressures are right.

The twin's sheet needs a fifth more pressure for the same change. The load cell is the truth; the
session is at a terminal, the daemon reads the twin's serial ports, contacts come by the stream. It
goes by the new calibration as soon as that is kept, and so does a replay of what is recorded then.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from tactomo_client import Contact
from tactomo_client.recording import open_recording
from tactomo_models.sensor.description_file import shipped_text
from terminal import Terminal
from whole_system import ANYWHERE, WatchedTwin, paper_twin, tactomo

NAME = "palm"
STIFFER = 1.2
DIAMETER_MM = 30.0
AREA_MM2 = math.pi / 4 * DIAMETER_MM**2
LEVELS_KPA = (110, 165, 190, 220, 250, 235, 205, 175)
HELD_OUT_KPA = (180, 200, 230)


class Bench(WatchedTwin):
    """The skin under a press of known force, and a daemon that looks at it."""

    def contact(self, kpa: float) -> Contact:
        """What the daemon says of a press that it has had time to look at."""
        before = self.press(x_mm=5.0, y_mm=-8.0, radius_mm=15, pressure_kpa=kpa)
        with self.frames() as frames:
            seen = 0
            for frame in frames:
                # By the network alone where others take the processor for a while.
                is_fit = len(frame.contacts) == 1 and frame.tier == "fit"
                seen += frame.scan_counter > before + 2 and is_fit
                if is_fit and seen > 12:
                    return frame.contacts[0]
        raise AssertionError


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """Of a twin whose response table lies at higher pressures than the description's."""
    table = re.search(r"\npressure_kpa *= \[(.*?)\]", shipped_text("paper_square"))
    assert table
    higher = ", ".join(str(STIFFER * float(kpa)) for kpa in table[1].split(","))
    with paper_twin(tmp_path, (table[1], higher)) as twin:
        bench = Bench(twin, tmp_path, NAME)
        yield bench
        bench.clear()
        bench.close()


@pytest.mark.slow
def test_a_guided_session_doubts_kilograms(bench: Bench) -> None:
    bench.contact(220)
    options = ("--sensor", NAME, "--address", bench.daemon.stream, "--diameter-mm", "30")
    with Terminal("calibrate", "live", *options) as terminal:
        for answer, is_doubted in ((0.220 * AREA_MM2 / 9.81, True), (0.220 * AREA_MM2, False)):
            terminal.wait_for("Reading 1, going")
            terminal.enter("")
            terminal.wait_for("Load cell in N")
            terminal.enter(f"{answer:.2f}")
            said = terminal.wait_for("Still wanted")
            assert ("reading in newtons" in said) == is_doubted
            terminal.enter("undo")


@pytest.mark.slow
def test_a_guided_session_makes_pressures_right(bench: Bench, tmp_path: Path) -> None:
    wrong = bench.contact(200)
    assert wrong.pressure_kpa is not None
    assert wrong.pressure_sigma_kpa is not None
    too_low = (wrong.pressure_kpa - 200 / STIFFER) / wrong.pressure_sigma_kpa
    assert abs(too_low) < 4.5, "the description's table"
    assert wrong.pressure_kpa < 190
    bench.clear()
    address = ("--address", bench.daemon.stream)
    with Terminal("calibrate", "live", "--sensor", NAME, *address) as terminal:
        terminal.wait_for("Diameter of the indenter in mm")
        terminal.enter(str(DIAMETER_MM))
        for number, kpa in enumerate(LEVELS_KPA, start=1):
            terminal.wait_for(f"Reading {number}, going")
            bench.contact(kpa)  # what the daemon sees while one's hand goes to the keyboard
            force_n = kpa * 1e-3 * AREA_MM2  # by the load cell
            terminal.enter("")
            terminal.wait_for("still: |Δσ|/σ₀")
            terminal.wait_for("Load cell in N")
            terminal.enter(f"{force_n:.2f}")
            terminal.wait_for(f"{kpa} kPa, taken")
        said = terminal.wait_for("Reading 9")
        # The lightest reading that should answer lies within its uncertainty of nothing, or not.
        assert re.search("Still wanted: [34] more that the channel answers to", said)
        recording = tmp_path / "recalibrated.mcap"
        bench.daemon.ask("record_start", path=recording.name, maps=True)
        terminal.enter("done")
        assert terminal.wait() == 0, terminal.shown
    assert f"palm: {len(LEVELS_KPA)} readings" in terminal.shown
    assert "in force now: the daemon of palm goes by it" in terminal.shown

    calibration = bench.daemon.status()["description"]["calibration"]
    assert calibration["readings"] == len(LEVELS_KPA)
    assert calibration["device_ids"]
    errors, of_force = [], []
    for kpa in HELD_OUT_KPA:
        found = bench.contact(kpa)
        assert found.pressure_kpa is not None
        if found.pressure_range == "above":
            assert found.pressure_kpa < kpa
            pytest.xfail("an indenter is not known to be flat, and a peak beyond the table is open")
        assert found.pressure_range == "within"
        assert found.pressure_sigma_kpa is not None
        if found.pressure_sigma_kpa >= 20:
            assert abs(found.pressure_kpa - kpa) < 3 * found.pressure_sigma_kpa
            pytest.xfail("an indenter is not known to be flat, and whether it falls off is open")
        errors.append((found.pressure_kpa - kpa) / found.pressure_sigma_kpa)
        assert found.force_n is not None
        of_force.append(found.force_n / (kpa * 1e-3 * AREA_MM2) - 1)
    assert max(map(abs, errors)) < 4.5, errors  # of three, by chance, one run in fifty thousand
    bench.daemon.ask("record_stop")
    # What is two standard uncertainties above nothing counts as something: by chance, one in forty.
    light = [bench.contact(kpa) for kpa in range(70, 101, 5)]
    below = [contact for contact in light if contact.pressure_range == "below"]
    assert len(below) >= 4, light  # of seven; by chance, all but one run in seventy thousand
    assert all(contact.pressure_kpa is None for contact in below)
    hard = bench.contact(300)
    assert hard.pressure_range == "above"
    assert hard.pressure_kpa is not None
    assert 0.8 * max(HELD_OUT_KPA) < hard.pressure_kpa < max(LEVELS_KPA) + 0.1
    live, again = pressures(recording), replayed(recording, tmp_path / "again.mcap")
    shared = live.keys() & again.keys()  # at an end a frame may lack its mark, or a mark its frame
    assert len(shared) >= len(live) - 2
    assert {each: again[each] for each in shared} == {each: live[each] for each in shared}
    assert max(map(abs, of_force)) < 0.2, of_force
    if max(map(abs, of_force)) > 0.12:
        pytest.xfail("an indenter is not known to be flat, and a mean over kinds is off")


def replayed(recording: Path, again: Path) -> dict[int, list[float | None]]:
    """Replay a recording as a user would, and return what its contacts read then."""
    addresses = ("--stream", ANYWHERE, "--control", ANYWHERE)
    tactomo("replay", recording, "--speed", "max", "--record", again, *addresses)
    return pressures(again)


def pressures(recording: Path) -> dict[int, list[float | None]]:
    """What the contacts of each frame read, by its counter."""
    return {
        frame.scan_counter: [contact.pressure_kpa for contact in frame.contacts]
        for frame in open_recording(recording).frames("contacts")
    }

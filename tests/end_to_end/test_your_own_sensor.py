"""docs/your_own_sensor.md as a newcomer follows it: every command but those of training.

Those are in tests/training.
"""

from __future__ import annotations

import csv
import re
import tomllib
from pathlib import Path

import pytest
from newcomer import Newcomer
from page import Page
from tactomo_models import SensorDescription
from tactomo_models.sensor.outline import Pad

pytestmark = pytest.mark.slow

PAGE = Page("docs/your_own_sensor.md")
FILE = "my_sheet.toml"
SMALLER = {"--count 20": "--count 1", "--seconds 3": "--seconds 1"}
SHORTER = {"--seconds 5": "--seconds 1", "doctor ": "doctor --seconds 2 "}


@pytest.fixture
def newcomer(tmp_path: Path) -> Newcomer:
    for name in (FILE, "readings.csv"):
        (tmp_path / name).write_text(PAGE.file(name))
    return Newcomer(tmp_path, SMALLER | SHORTER)


def test_a_description_is_drawn_built_pressed_and_judged(newcomer: Newcomer) -> None:
    with newcomer:
        drawn, built, info = newcomer.follow(PAGE.commands("2") + PAGE.commands("3"))
        assert "scale 1 : 1" in drawn
        assert (newcomer.folder / "my_sheet.png").exists()
        assert "is up to date" in built  # drawing has built them
        assert "my_sheet" in info
        demo, press, watch, status, release = PAGE.commands("4")
        newcomer.run(demo)
        newcomer.run(press)
        seen = newcomer.wait_for(watch, " mm ")
        x_mm, y_mm = re.findall(r"\(([+-][\d.]+), ([+-][\d.]+)\) mm", seen)[-1]
        assert (float(x_mm), float(y_mm)) == pytest.approx((30, 20), abs=2)
        assert "auto; the newest frame by fit" in newcomer.wait_for(status, "newest frame by fit")
        newcomer.run(release)
        newcomer.stop()
        (judged,) = newcomer.follow(PAGE.commands("5"))
        assert "Simulated, not measured: my_sheet" in judged
        assert (newcomer.folder / "fit.png").exists()


def test_a_device_is_found_examined_tared_and_recorded(newcomer: Newcomer) -> None:
    with newcomer:
        newcomer.follow(PAGE.commands("7"))
        assert (newcomer.folder / "first.mcap").exists()
    (calibrated,) = newcomer.follow(PAGE.commands("8"))
    assert "answers from" in calibrated
    (install,) = PAGE.commands("9")
    assert "/etc/tactomo/palm.toml" in newcomer.run(install)


def test_a_bent_sheet_says_where_on_the_link_it_is_pressed(newcomer: Newcomer) -> None:
    sheet = newcomer.folder / FILE
    sheet.write_text(sheet.read_text() + "".join(PAGE.blocks("toml", "10")))
    info, demo, press, watch, *files = PAGE.commands("10")
    with newcomer:
        assert "cylinder on left_forearm_link" in newcomer.run(info)
        newcomer.run(demo)
        newcomer.run(press)
        newcomer.wait_for(watch, " mm ")
        newcomer.follow(files)
    with (newcomer.folder / "bent.csv").open(newline="") as table:
        last = list(csv.DictReader(table))[-1]
    place = [float(last[f"position_{axis}_m"]) for axis in "xyz"]
    assert place == pytest.approx((0.027, 0.027, 0.140), abs=1.5e-3)  # as the page says
    normal = [float(last[f"normal_{axis}"]) for axis in "xyz"]
    assert normal == pytest.approx((0.71, 0.71, 0), abs=0.04)
    assert last["mount_frame"] == "left_forearm_link"
    assert (newcomer.folder / "bent_bag" / "metadata.yaml").exists()


def test_a_load_cell_is_described_and_moved_by_a_press(newcomer: Newcomer) -> None:
    section = "A load cell beneath the sheet"
    copy, demo, press, watch = PAGE.commands(section)
    with newcomer:
        newcomer.run(copy)
        sheet = newcomer.folder / "my_cell.toml"
        sheet.write_text(sheet.read_text() + "\n" + "".join(PAGE.blocks("toml", section)))
        newcomer.run(demo)
        newcomer.run(press)
        newcomer.wait_for(watch, " mm ")


def test_a_sheet_of_another_outline_is_described_and_drawn(newcomer: Newcomer) -> None:
    section = "A sheet of another outline"
    with newcomer:
        newcomer.follow(PAGE.commands(section))
        assert (newcomer.folder / "my_palm.png").exists()
        text = (newcomer.folder / "my_palm.toml").read_text("utf-8")
        (keys,) = PAGE.blocks("toml", section)
        raw, shown = tomllib.loads(text), tomllib.loads(keys)
        raw["sheet"] |= shown["sheet"]
        raw["electrodes"] |= {"pad_radius_m": shown["electrodes"]["pad_radius_m"]}
        raw["electrodes"]["positions_m"] += shown["electrodes"]["positions_m"][2:]
        pads = SensorDescription.model_validate(raw).placed_electrodes
        assert sum(isinstance(each, Pad) for each in pads) == 1


def test_an_insole_goes_from_a_drawing_to_contacts_in_ros(newcomer: Newcomer) -> None:
    section = "An insole on a curved sole"
    drawing, surface, reader = PAGE.blocks("python", section)
    keys = PAGE.blocks("toml", section)
    draw = PAGE.commands(section)[:2]
    info, demo, press, watch, *files = PAGE.commands(section)[2:]
    with newcomer:
        newcomer.python(drawing)
        newcomer.follow(draw)
        newcomer.python(surface)
        sheet = newcomer.folder / "my_sole.toml"
        sheet.write_text(sheet.read_text() + "\n" + "".join(keys))
        described = newcomer.run(info)
        assert "surface on right_foot_link" in described
        assert "load_cell" in described
        newcomer.run(demo)
        newcomer.run(press)
        newcomer.wait_for(watch, " mm ")
        newcomer.follow(files)
        assert "right_foot_link" in newcomer.python(reader)
    with (newcomer.folder / "walk.csv").open(newline="") as table:
        last = list(csv.DictReader(table))[-1]
    place = [float(last[f"position_{axis}_m"]) for axis in "xyz"]
    assert place == pytest.approx((0, 0.098, 0.0135), abs=1.5e-3)  # as the page says
    assert float(last["force_n"]) == pytest.approx(90, rel=0.05)

"""`tactomo export --lerobot`: LeRobot itself reads what was recorded, number by number."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixture_types import Run
from recorded_grasp import (
    FIRST_PRESSED,
    FRAMES,
    LIGHT_FROM,
    MONOTONIC_NS,
    PERIOD_NS,
    SENSOR,
    START_NS,
    contacts_of,
    images_of,
    write_grasp,
)
from tactomo_client.schema import table_row
from tactomo_client.touch import CONTACT_COLUMNS

pytestmark = pytest.mark.peers
pytest.importorskip("lerobot", reason="make test-peers installs LeRobot")

TOUCH = f"observation.tactile.{SENSOR}"
FPS = 20
AGE_S = 0.007


def opened(folder: Path) -> Any:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset(f"tactomo/{folder.name}", root=folder)


def stored(folder: Path) -> Any:
    """The table itself, whose numbers LeRobot gives out in 32 bits."""
    import pandas

    return pandas.concat(map(pandas.read_parquet, sorted((folder / "data").rglob("*.parquet"))))


def stacked(cells: Iterable[Any]) -> Any:
    return np.array([np.stack(list(cell)) for cell in cells])


def write_steps(path: Path, times_s: Iterable[float], clock: str = "monotonic_s") -> list[float]:
    times = list(times_s)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([clock, "episode", "joint_1", "joint_2", "action.joint_1"])
        for number, time_s in enumerate(times):
            writer.writerow([repr(time_s), int(number >= 40), number, -number, 0.5 * number])
    return times


def test_maps_and_contacts_are_the_recorded_ones(tactomo: Run, tmp_path: Path) -> None:
    write_grasp(tmp_path / "grasp.mcap")
    result = tactomo(
        "export", "grasp.mcap", "set", "--lerobot", "--fps", FPS, "--task", "hold", status=0
    )
    assert "80 steps" in result.stdout
    dataset = opened(tmp_path / "set")
    assert (dataset.num_frames, dataset.num_episodes, dataset.fps) == (FRAMES, 1, FPS)
    assert dataset[0]["task"] == "hold"
    for number in (3, 30, 50):
        images = images_of(number)
        row = dataset[number]
        for name, key in (("pressure_kpa", "pressure_kpa"), ("magnitude", "map")):
            image = images[key]
            expected = np.zeros((51, 51), np.float32) if image is None else np.nan_to_num(image)
            np.testing.assert_array_equal(row[f"{TOUCH}.{name}"].numpy(), expected)
        pressure = images["pressure_kpa"]
        known = np.zeros((51, 51)) if pressure is None else np.isfinite(pressure)
        np.testing.assert_array_equal(row[f"{TOUCH}.known"].numpy(), known)
    table = stored(tmp_path / "set")
    contacts = stacked(table[f"{TOUCH}.contacts"])
    is_number = stacked(table[f"{TOUCH}.contacts_known"])
    for number in (FIRST_PRESSED, LIGHT_FROM + 5):
        for slot, contact in enumerate(contacts_of(number)):
            for column, name in enumerate(CONTACT_COLUMNS):
                value = table_row(contact)[name]
                if name == "pressure_range":
                    value = {"within": 1, "below": 2}[value]
                assert is_number[number, slot, column] == (value is not None)
                assert contacts[number, slot, column] == (value or 0.0)  # to the last bit
        assert not is_number[number, len(contacts_of(number)) :].any()
    statistics = dataset.meta.stats
    for name in ("pressure_kpa", "contacts"):
        assert np.isfinite(statistics[f"{TOUCH}.{name}"]["std"]).all()
    assert not list((tmp_path / "set").rglob("*.mp4"))


def test_steps_of_a_robot_have_what_it_could_have_known(tactomo: Run, tmp_path: Path) -> None:
    """A frame is there for others 7 ms after it was acquired; until then they have the last."""
    write_grasp(tmp_path / "grasp.mcap")
    start_s = MONOTONIC_NS * 1e-9
    times = write_steps(
        tmp_path / "steps.csv", [start_s + n / 30 for n in range(100) if n not in (50, 51)]
    )
    result = tactomo("export", "grasp.mcap", "set", "--lerobot", "--robot", "steps.csv", status=0)
    assert "2 steps are missing in the robot's log at 30 a second" in result.stderr
    assert "steps repeat the frame of the step before" in result.stderr
    assert "1 steps have no frame younger than 0.5 s" in result.stderr  # the very first
    dataset = opened(tmp_path / "set")
    assert (dataset.num_frames, dataset.num_episodes, dataset.fps) == (98, 2, 30)
    for number in (0, 1, 39, 40, 49, 50, 97):
        row = dataset[number]
        assert row["observation.state"].tolist() == [number, -number]
        assert row["action"].item() == 0.5 * number
        assert row["episode_index"].item() == int(number >= 40)
        begin = times[40 if number >= 40 else 0]
        assert row["observation.time_s"].item() == pytest.approx(times[number] - begin, abs=1e-5)
        newest = int((times[number] - start_s - AGE_S) // (PERIOD_NS * 1e-9) + 1e-9)
        age_s = times[number] - start_s - newest * PERIOD_NS * 1e-9
        if number == 0:
            assert row[f"{TOUCH}.has_frame"].item() == 0
            continue
        assert row[f"{TOUCH}.age_s"].item() == pytest.approx(age_s, abs=1e-5)
        image = images_of(newest)["pressure_kpa"]
        expected = np.zeros((51, 51)) if image is None else np.nan_to_num(image)
        np.testing.assert_array_equal(row[f"{TOUCH}.pressure_kpa"].numpy(), expected)


def test_dropped_frames_leave_gaps_and_are_counted(tactomo: Run, tmp_path: Path) -> None:
    """A second without frames: for half of it the last one stands, with its age; then nothing."""
    write_grasp(tmp_path / "grasp.mcap", [n for n in range(FRAMES) if not 30 <= n < 50])
    result = tactomo("export", "grasp.mcap", "set", "--lerobot", "--fps", FPS, status=0)
    assert "20 frames were published that the recording does not hold" in result.stderr
    assert "steps have no frame younger than 0.5 s" in result.stderr
    table = stored(tmp_path / "set")
    has_frame = table[f"{TOUCH}.has_frame"].to_numpy()
    assert len(table) == FRAMES
    assert has_frame[:39].all()
    assert not has_frame[40:49].any()
    assert has_frame[51:].all()
    assert not stacked(table[f"{TOUCH}.pressure_kpa"][40:49]).any()
    assert not stacked(table[f"{TOUCH}.known"][40:49]).any()
    assert table[f"{TOUCH}.age_s"].max() < 0.51


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        ("time\n1\n", "has no column monotonic_s or realtime_s"),
        ("monotonic_s,x\n5,1\n5.1\n", "line 3: not 2 numbers"),
        ("monotonic_s,x\nnone,1\n5,1\n", "line 2: not 2 numbers"),
        ("monotonic_s,x\n5,1\n5.1,nan\n", "line 3: not 2 numbers"),
        ("monotonic_s,x\n5,1\n5.1,1\n5.05,1\n", "line 4: monotonic_s is not later"),
        ("monotonic_s\n5\n", "less than a step a second"),
    ],
)
def test_a_log_that_cannot_be_right_is_refused(
    tactomo: Run, tmp_path: Path, lines: str, says: str
) -> None:
    write_grasp(tmp_path / "grasp.mcap")
    (tmp_path / "steps.csv").write_text(lines)
    result = tactomo("export", "grasp.mcap", "set", "--lerobot", "--robot", "steps.csv", status=1)
    assert says in result.stderr.replace("\n", " ")
    assert not (tmp_path / "set").exists()


def test_a_wall_clock_that_was_set_does_not_align(tactomo: Run, tmp_path: Path) -> None:
    def set_back(number: int) -> dict[str, Any]:
        hour = 3_600_000_000_000 if number >= 30 else 0
        return {"acquired_realtime_ns": START_NS + number * PERIOD_NS - hour}

    write_grasp(tmp_path / "grasp.mcap", change=set_back)
    begin_s = START_NS * 1e-9
    write_steps(tmp_path / "steps.csv", [begin_s + n / 20 for n in range(100)], "realtime_s")
    arguments = ("export", "grasp.mcap", "set", "--lerobot", "--robot", "steps.csv")
    result = tactomo(*arguments, status=1)
    assert "-3600.000 s" in result.stderr
    tactomo(*arguments, "--to", 1.4, status=0)  # before it, it does
    row = opened(tmp_path / "set")[22]
    np.testing.assert_array_equal(
        row[f"{TOUCH}.pressure_kpa"].numpy(), images_of(21)["pressure_kpa"]
    )

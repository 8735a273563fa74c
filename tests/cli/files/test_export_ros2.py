"""`tactomo export --ros2`: what a reader of bags that is not ours finds is what was recorded."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixture_types import Run
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray
from recorded_grasp import FRAMES, PERIOD_NS, SENSOR, START_NS, contacts_of, images_of, write_grasp

PRESSED = 50
FLAGGED = 33
AGE_NS = 7_000_000
NUMPY_TYPES = {2: "u1", 6: "<u4", 7: "<f4", 8: "<f8"}  # of sensor_msgs/PointField


def read(bag: Path) -> dict[str, list[tuple[int, Any]]]:
    """Read every message of a bag with its time in there, by topic."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with (bag / f"{bag.name}.mcap").open("rb") as file:
        for each in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            topic = found.setdefault(each.channel.topic, [])
            topic.append((each.message.log_time, each.decoded_message))
    return found


def stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


def points(cloud: Any) -> NDArray[Any]:
    kind = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [NUMPY_TYPES[field.datatype] for field in cloud.fields],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    assert cloud.row_step == cloud.width * cloud.point_step
    return np.frombuffer(bytes(cloud.data), kind).reshape(cloud.height, cloud.width)


def values(diagnostics: Any) -> dict[str, str]:
    return {each.key: each.value for each in diagnostics.status[0].values}


@pytest.fixture
def exported(tactomo: Run, tmp_path: Path) -> Path:
    write_grasp(tmp_path / "grasp.mcap")
    tactomo("export", "grasp.mcap", "bag", "--ros2", status=0)
    return tmp_path / "bag"


def test_maps_are_the_recorded_ones_and_say_what_is_known(exported: Path) -> None:
    maps = read(exported)[f"/{SENSOR}/map"]
    by_frame = {(stamp_ns(cloud) - START_NS) // PERIOD_NS: cloud for _, cloud in maps}
    assert sorted(by_frame) == list(range(5, FRAMES))  # before the tare there are none
    nodes = points(by_frame[PRESSED])
    assert nodes.shape == (51, 51)
    assert by_frame[PRESSED].header.frame_id == SENSOR
    images = images_of(PRESSED)
    np.testing.assert_array_equal(nodes["pressure_kpa"], images["pressure_kpa"])
    np.testing.assert_array_equal(nodes["magnitude"], images["map"])
    np.testing.assert_array_equal(nodes["structure"], images["structure"])
    np.testing.assert_allclose(nodes["x"][7], np.linspace(-0.075, 0.075, 51), atol=1e-7)
    np.testing.assert_allclose(nodes["y"][:, 7], np.linspace(-0.075, 0.075, 51), atol=1e-7)
    # A node says whether its pressure is known, and how well.
    light = np.isnan(nodes["pressure_kpa"])
    assert light.any()
    np.testing.assert_array_equal(nodes["valid"], ~light)
    assert not by_frame[PRESSED].is_dense
    hard = nodes["pressure_kpa"] > 0
    assert set(nodes["sigma_kpa"][hard]) == {np.float32(2.5)}
    assert np.isnan(nodes["sigma_kpa"][~hard]).all()
    assert not points(by_frame[FLAGGED])["valid"].any()  # it may miss touches


def test_contacts_have_frames_and_covariances_and_messages_their_ages(exported: Path) -> None:
    found = read(exported)
    at = START_NS + PRESSED * PERIOD_NS

    def of_frame(topic: str) -> list[Any]:
        return [message for _, message in found[topic] if stamp_ns(message) == at]

    expected = contacts_of(PRESSED)
    wrenches, poses = of_frame(f"/{SENSOR}/contact_wrenches"), of_frame(f"/{SENSOR}/contact_poses")
    frames = [f"{SENSOR}/contact_{contact.id}" for contact in expected]
    assert [wrench.header.frame_id for wrench in wrenches] == frames
    assert wrenches[0].wrench.force.z == -(expected[0].force_n or 0.0)  # into the sheet
    assert math.isnan(wrenches[1].wrench.force.z)  # touched too lightly to be measured: not 0 N
    assert [pose.pose.pose.position.x for pose in poses] == [c.x_mm * 1e-3 for c in expected]
    covariance = np.reshape(poses[0].pose.covariance, (6, 6))
    assert np.diag(covariance)[:3] == pytest.approx([0.2e-3**2, 0.3e-3**2, 0.0])
    assert math.isnan(poses[1].pose.covariance[0])  # this one's is not known
    transforms = next(tf.transforms for _, tf in found["/tf"] if stamp_ns(tf.transforms[0]) == at)
    assert [each.child_frame_id for each in transforms] == frames
    assert transforms[1].transform.translation.y == 0.04
    (cloud,) = of_frame(f"/{SENSOR}/contacts")
    rows = points(cloud)[0]
    assert list(rows["id"]) == [1, 2]
    assert list(rows["pressure_range"]) == [1, 2]  # within, below
    assert rows["pressure_kpa"][0] == expected[0].pressure_kpa  # to the last bit
    assert math.isnan(rows["pressure_kpa"][1])
    clouds = found[f"/{SENSOR}/contacts"]  # nothing pressed is said, and not left out
    assert [cloud.width for _, cloud in clouds] == [len(contacts_of(n)) for n in range(FRAMES)]
    # A message's time in the bag is when it was published, its stamp when it was acquired.
    diagnostics = found["/diagnostics"]
    assert [stamp_ns(m) for _, m in diagnostics] == [
        START_NS + n * PERIOD_NS for n in range(FRAMES)
    ]
    assert {time_ns - stamp_ns(message) for time_ns, message in diagnostics} == {AGE_NS}
    assert values(diagnostics[0][1])["age_s"] == "0.007"
    levels = [message.status[0].level for _, message in diagnostics]
    assert [n for n, level in enumerate(levels) if level != 0] == [FLAGGED, FLAGGED + 1]
    assert diagnostics[FLAGGED][1].status[0].message == "misfit_high"
    assert "storage_identifier: mcap\n  " in (exported / "metadata.yaml").read_text()


def test_a_clock_that_jumps_and_lost_frames_are_named(tactomo: Run, tmp_path: Path) -> None:
    def change(number: int) -> dict[str, Any]:
        realtime_ns = START_NS + number * PERIOD_NS - (3_600_000_000_000 if number >= 30 else 0)
        if number < 60:
            return {"acquired_realtime_ns": realtime_ns}
        return {"session": "again", "acquired_monotonic_ns": (number - 60) * PERIOD_NS}

    numbers = [n for n in range(FRAMES) if n not in (10, 11, 45)]
    write_grasp(tmp_path / "odd.mcap", numbers, change)
    result = tactomo("export", "odd.mcap", "bag", "--ros2", status=0)
    for line in (
        "3 frames were published that the recording does not hold (the first at 0.600 s)",
        "1 steps of the wall clock, the first by -3600.000 s",
        "1 restarts of the daemon",
        "5 frames have no map",
        "2 frames where a press may be missing: misfit_high 2",
    ):
        assert line in result.stderr
    assert f"{len(numbers)} frames" in result.stdout
    stamps = [stamp_ns(message) for _, message in read(tmp_path / "bag")["/diagnostics"]]
    assert stamps == [START_NS + n * PERIOD_NS for n in numbers]  # no hour back, nothing filled in


@pytest.mark.parametrize(
    ("arguments", "status", "says"),
    [
        (["grasp.mcap", "bag.mcap", "--ros2"], 2, "name bag"),
        (["grasp.mcap", "there", "--ros2", "--force"], 1, "there exists already"),
        (["grasp.mcap", "bag"], 2, "--ros2"),
    ],
)
def test_what_goes_wrong_is_told(
    tactomo: Run, tmp_path: Path, arguments: list[str], status: int, says: str
) -> None:
    write_grasp(tmp_path / "grasp.mcap")
    (tmp_path / "there").mkdir()
    result = tactomo("export", *arguments, status=status)
    assert says in result.stderr.replace("\n", " ")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["grasp.mcap", "there"]


@pytest.mark.parametrize(("sensor", "topic"), [("left-arm.2", "left_arm_2"), ("2_", "s2")])
def test_topics_have_names_that_ros_takes(sensor: str, topic: str) -> None:
    from tactomo_ros2.messages import topic_name

    assert topic_name(sensor) == topic

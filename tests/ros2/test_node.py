"""The node of clients/ros2, in ROS 2 itself: rclpy and Fast DDS, on this computer alone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from recorded_grasp import SENSOR, contacts_of, images_of, write_grasp
from tactomo_client.fake import FakeSensor
from waiting import PATIENCE_S, wait_until

pytestmark = pytest.mark.peers
rclpy = pytest.importorskip("rclpy", reason="make test-peers installs ROS 2")

NODE = Path(__file__).parents[2] / "clients/ros2/node"
PRESSED = 50
QUIET = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "73"}


@pytest.fixture
def listener(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Any]:
    for name, value in {**QUIET, "ROS_LOG_DIR": str(tmp_path)}.items():
        monkeypatch.setenv(name, value)
    rclpy.init()
    node = rclpy.create_node("listener")
    yield node
    node.destroy_node()
    rclpy.shutdown()


def start(*parameters: str) -> subprocess.Popen[str]:
    words = [word for parameter in parameters for word in ("-p", parameter)]
    command = (sys.executable, "-c", "import tactomo_node; tactomo_node.main()", "--ros-args")
    environment = os.environ | {"PYTHONPATH": str(NODE)}
    # `tf` is off because the wheels of ROS that are used here leave tf2_msgs out.
    return subprocess.Popen(
        [*command, *words, "-p", "tf:=false"], env=environment, stderr=subprocess.PIPE, text=True
    )


def test_ros_receives_what_the_skin_feels(listener: Any) -> None:
    from geometry_msgs.msg import WrenchStamped
    from sensor_msgs.msg import PointCloud2

    wrenches: list[Any] = []
    clouds: list[Any] = []
    listener.create_subscription(WrenchStamped, "/left/contact_wrenches", wrenches.append, 10)
    listener.create_subscription(PointCloud2, "/left/map", clouds.append, 10)
    with FakeSensor("left") as sensor:
        node = start("sensor:=left", f"stream:={sensor.address}")
        images: dict[str, Any] = images_of(PRESSED)

        def meanwhile() -> None:
            sensor.publish(contacts_of(PRESSED), **images)
            rclpy.spin_once(listener, timeout_sec=0.05)

        try:
            wait_until(lambda: len(wrenches) > 1 and clouds, meanwhile=meanwhile)
            forces = {each.header.frame_id: each.wrench.force.z for each in wrenches}
            assert forces["left/contact_1"] == -(contacts_of(PRESSED)[0].force_n or 0.0)
            assert (clouds[0].height, clouds[0].width) == (51, 51)
        finally:
            node.send_signal(signal.SIGINT)
            node.communicate(timeout=PATIENCE_S)
        assert node.returncode == 0


def test_what_cannot_be_is_told_without_a_traceback(listener: Any) -> None:
    node = start("sensor:=left", "stream:=nonsense")
    _, errors = node.communicate(timeout=PATIENCE_S)
    assert node.returncode == 1
    assert "nonsense" in errors
    assert "Traceback" not in errors


def test_ros_reads_the_bags(tactomo: Any, tmp_path: Path) -> None:
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import PointCloud2

    types = (PointCloud2, WrenchStamped, PoseWithCovarianceStamped, DiagnosticArray)
    by_name = {kind.__name__: kind for kind in types}
    write_grasp(tmp_path / "grasp.mcap")
    tactomo("export", "grasp.mcap", "bag", "--ros2", status=0)
    counts = dict.fromkeys(by_name, 0)
    with (tmp_path / "bag/bag.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            name = schema.name.rpartition("/")[2] if schema else ""
            if name in by_name:
                read = deserialize_message(message.data, by_name[name])
                counts[name] += 1
                if channel.topic == f"/{SENSOR}/map":
                    assert len(read.data) == read.row_step * read.height
    assert all(counts.values())

"""What a node publishes of a running sensor, without ROS."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tactomo.imaging.frames import description_fields
from tactomo_client import Contact, subscribe
from tactomo_client.fake import FakeSensor
from tactomo_models import load_description
from tactomo_ros2.live import run
from tactomo_ros2.messages import TYPES, RosMessage
from variants import variant

HUMS = {"severity": "error", "what": "it hums", "next_step": "oil it"}
CREAKS = {"severity": "warning", "what": "it creaks", "next_step": "leave it"}


@pytest.mark.parametrize(
    ("issues", "level", "words"),
    [([], 0, "running"), ([CREAKS], 1, "it creaks"), ([HUMS, CREAKS], 2, "it hums; it creaks")],
)
def test_what_the_daemon_finds_wrong_is_a_diagnostic(
    issues: list[dict[str, str]], level: int, words: str
) -> None:
    said: list[RosMessage] = []
    with (
        FakeSensor("left") as sensor,
        subscribe("left", kind=("map", "status"), address=sensor.address) as skin,
    ):
        sensor.wait_for_subscriber()
        sensor.wait_for_subscriber()
        sensor.publish_message("status", {"state": "running", "issues": issues})
        run(skin, said.append, lambda: bool(said))
    told: Any = TYPES.deserialize_cdr(said[0].cdr, said[0].type)
    (status,) = told.status
    assert (status.name, status.level, status.message) == ("tactomo: left: daemon", level, words)
    steps = {each.key: each.value for each in status.values}
    assert steps == {issue["what"]: issue["next_step"] for issue in issues}


def test_a_mounted_sheet_is_in_its_links_frame() -> None:
    """On a cylinder of 50 mm about z, a contact a quarter round it, 10 mm up."""
    contact = Contact(
        *(3, 78.5, 10.0, 700.0, 0.1, 0.01, 170.0, 1.0, 2.0),
        force_n=8.0,
        position_m=(0.0, 0.05, 0.01),
        normal=(0.0, 1.0, 0.0),
        frame="arm",
    )
    mount = {"frame": "arm", "cylinder": {"radius_m": 0.05}}
    sheet = description_fields(variant(load_description("paper_square"), mount=mount))
    said: dict[str, RosMessage] = {}
    with (
        FakeSensor("left") as sensor,
        subscribe("left", kind=("map", "status"), address=sensor.address) as skin,
    ):
        sensor.wait_for_subscriber()
        sensor.wait_for_subscriber()
        status = {"state": "running", "issues": [], "description": sheet}
        sensor.publish_message("status", status)
        sensor.publish([contact], map=np.zeros((51, 51), np.float32))
        run(skin, lambda message: said.update({message.topic: message}), lambda: "/tf" in said)
    told: dict[str, Any] = {
        topic: TYPES.deserialize_cdr(message.cdr, message.type) for topic, message in said.items()
    }
    pose = told["/left/contact_poses"]
    at, q = pose.pose.pose.position, pose.pose.pose.orientation
    assert (pose.header.frame_id, at.x, at.y, at.z) == ("arm", 0.0, 0.05, 0.01)
    out = (2 * (q.x * q.z + q.y * q.w), 2 * (q.y * q.z - q.x * q.w), 1 - 2 * (q.x**2 + q.y**2))
    assert out == pytest.approx((0, 1, 0), abs=1e-9)  # its z is the normal
    covariance = np.reshape(pose.pose.covariance, (6, 6))[:3, :3]
    assert np.diag(covariance) == pytest.approx([4e-6, 0.0, 4e-6])
    (transform,) = told["/tf"].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("arm", "left/contact_3")
    wrench = told["/left/contact_wrenches"]
    assert (wrench.header.frame_id, wrench.wrench.force.z) == ("left/contact_3", -8.0)
    for topic in ("/left/map", "/left/contacts"):
        cloud = told[topic]
        assert cloud.header.frame_id == "arm"
        xyz = np.reshape(cloud.data, (-1, cloud.point_step))[:, :12].copy().view("<f4")
        assert np.hypot(xyz[:, 0], xyz[:, 1]) == pytest.approx(0.05, rel=0.01)
    assert {"position_x_m", "normal_z"} < {field.name for field in told["/left/contacts"].fields}
